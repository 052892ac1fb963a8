from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import BaseModel, ValidationError

from semloc_logs.errors import SettingsError
from semloc_logs.settings import Resolved, Settings, load


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "settings.yaml"
    path.write_text("fusion:\n  voxel_size: 0.2\n  hit: 0.7\n  miss: 0.3\nquery:\n  frames: 3\n")
    return path


def test_defaults_file_environment_assignments_in_this_order(file: Path) -> None:
    environment = {
        "SEMLOC_FUSION__HIT": "0.8",
        "SEMLOC_FUSION__MISS": "0.35",
        "PATH": "/bin",
        "SEMLOC_HOME": "x",
    }
    loaded = load(file, {"fusion.miss": "0.45", "labels.source": "uniform"}, environment)
    f = loaded.fusion
    assert (f.clamp, f.voxel_size, f.hit, f.miss) == ((-2.0, 3.5), 0.2, 0.8, 0.45)
    assert loaded.query.frames == 3
    assert loaded.labels.source == "uniform"
    assert load() == Settings()


def test_the_process_environment_is_not_looked_at_unasked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SEMLOC_FUSION__VOXEL_SIZE", "0.1")
    assert Settings().fusion.voxel_size == 0.30
    assert load().fusion.voxel_size == 0.30


@pytest.mark.parametrize(
    ("key", "named"),
    [
        ("voxel_size", "voxel_size"),
        ("fusion.voxelsize", r"fusion\.voxelsize"),
        ("bogus.frames", "bogus"),
        ("query.frames.more", r"query\.frames"),
        ("closures.kappa.x.y", r"closures\.kappa"),
        ("", "Unknown setting ''"),
    ],
)
def test_unknown_keys_are_refused_by_name_from_assignments(key: str, named: str) -> None:
    with pytest.raises(SettingsError, match=named):
        load(assignments={key: "1"})


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("bogus: 1\n", "bogus"),
        ("fusion:\n  voxelsize: 1\n", "fusion.voxelsize"),
        ("training:\n  seeds: 1\n", "training.seeds"),
        ("1: 2\n", "1"),
        ("fusion: 3\n", "fusion"),
        ("fusion: [1, 2]\n", "fusion"),
    ],
)
def test_unknown_keys_are_refused_by_name_from_files(text: str, key: str, tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    with pytest.raises(SettingsError, match=f"'{key}'"):
        load(path)


def test_unknown_keys_are_refused_by_name_from_the_environment() -> None:
    with pytest.raises(SettingsError, match=r"fusion\.voxelsize"):
        load(environment={"SEMLOC_FUSION__VOXELSIZE": "1"})


def test_every_section_refuses_unknown_keys() -> None:
    sections = [name for name, value in Settings() if isinstance(value, BaseModel)]
    assert len(sections) == 9
    for section in sections:
        with pytest.raises(SettingsError, match=rf"{section}\.no_such_key"):
            load(assignments={f"{section}.no_such_key": "1"})


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("fusion.voxel_size", "0"),
        ("fusion.voxel_size", ".nan"),
        ("fusion.voxel_size", "wide"),
        ("fusion.max_range", "-1"),
        ("fusion.max_range", ".inf"),
        ("fusion.max_range", "400"),  # more than 1000 voxels: a sweep is carved in a dense grid
        ("fusion.keyframe_resolution", "0"),
        ("fusion.submap_length", "0"),
        ("fusion.submap_overlap", "1"),
        ("fusion.hit", "0.01"),  # rounds to nothing
        ("fusion.clamp", "[-7, 3]"),  # does not fit the int8 that it is kept in
        ("fusion.clamp", "[-2, 7]"),
        ("fusion.clamp", "[3.5, -2]"),
        ("labels.source", "guess"),
        ("descriptor.stride", "5"),
        ("query.frames", "0"),
        ("query.every", "0"),
        ("closures.min_probability", "1.5"),
        ("closures.min_probability", "[1"),
        ("closures.min_probability", "2001-99-99"),
        ("closures.min_probability", "!!int ''"),
    ],
)
def test_impossible_values_are_refused_by_name(key: str, value: str) -> None:
    with pytest.raises(SettingsError, match=key.rsplit(".", 1)[1]):
        load(assignments={key: value})


@pytest.mark.parametrize(
    "content",
    [
        b"fusion: [",
        b"\xff\xfe\x00",
        b"- a\n- b\n",
        b"just text",
        b"fusion: 2001-99-99",
        b"[" * 5000,
    ],
)
def test_files_that_are_no_settings_are_refused_by_name(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "odd.yaml"
    path.write_bytes(content)
    with pytest.raises(SettingsError, match=r"odd\.yaml"):
        load(path)
    with pytest.raises(SettingsError, match="missing"):
        load(tmp_path / "missing.yaml")


def test_files_without_end_are_refused() -> None:
    with pytest.raises(SettingsError, match="larger than a megabyte"):
        load(Path("/dev/zero"))


@pytest.mark.parametrize("text", ["", "# nothing\n", "fusion:\nquery:\n"])
def test_empty_files_and_sections_are_the_defaults(text: str, tmp_path: Path) -> None:
    path = tmp_path / "empty.yaml"
    path.write_text(text)
    assert load(path) == Settings()
    assert load(path, {"fusion.voxel_size": "0.1"}).fusion.voxel_size == 0.1


def test_dump_and_load(tmp_path: Path) -> None:
    path = tmp_path / "dumped.yaml"
    changed = {
        "fusion.voxel_size": "0.05",
        "fusion.clamp": "[-1, 2]",
        "descriptor.weights": "a/b.safetensors",
        "query.length": "12.5",
    }
    for settings in (Settings(), load(assignments=changed), load(assignments=changed).resolved()):
        path.write_text(settings.dump())
        assert load(path).model_dump() == settings.model_dump()


def test_lengths_follow_the_voxel_size() -> None:
    street = Settings().resolved()
    room = load(assignments={"fusion.voxel_size": "0.05"}).resolved()
    assert street.fusion.max_range == 50
    assert street.query.every == 2
    assert street.closures.exclude_distance == 50
    for section in ("fusion", "query", "closures"):
        for name in type(getattr(street, section)).model_fields:
            wide = getattr(getattr(street, section), name)
            small = getattr(getattr(room, section), name)
            before = getattr(getattr(Settings(), section), name)
            if before is None and name != "length":
                assert small == pytest.approx(wide / 6), name
            elif name != "voxel_size":
                assert small == wide == before, name
    assert room.query.length is None  # not set: a query has query.frames keyframes
    assert room.resolved() == room
    kept = load(
        assignments={"fusion.voxel_size": "0.05", "fusion.max_range": "20", "fusion.min_range": "0"}
    ).resolved()
    assert (kept.fusion.max_range, kept.fusion.min_range) == (20, 0)


def test_fingerprints_are_of_the_named_sections_only() -> None:
    a = Settings()
    b = load(assignments={"query.frames": "7"})
    assert a.fingerprint("fusion", "labels") == b.fingerprint("fusion", "labels")
    assert a.fingerprint("fusion", "query") != b.fingerprint("fusion", "query")
    assert a.fingerprint("fusion") == load().fingerprint("fusion")


def test_resolved_settings_hold_every_length_and_stay_as_they_are() -> None:
    resolved = load(assignments={"fusion.voxel_size": "0.1", "query.every": "3"}).resolved()
    assert resolved.query.every == 3
    assert resolved.fusion.submap_length == pytest.approx(100 / 3)
    assert resolved.resolved() is resolved
    assert Resolved.model_validate(resolved.model_dump()) == resolved
    assert hash(resolved) == hash(Resolved.model_validate(resolved.model_dump()))
    for section in (resolved.fusion, resolved.closures):
        assert None not in section.model_dump().values()
    with pytest.raises(ValidationError):
        Resolved.model_validate(Settings().model_dump())


def test_the_environment_is_read_by_load_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SEMLOC_FUSION__VOXEL_SIZE", "0.7")
    assert Settings().fusion.voxel_size == 0.3


def test_offsets_of_topics_may_have_dots_in_their_names() -> None:
    key = "logs.time_offset./front.left/points"
    settings = load(None, {key: "-0.4", "logs.time_offset./imu": "37"})
    assert settings.logs.time_offset == {"/front.left/points": -0.4, "/imu": 37.0}


@pytest.mark.parametrize("value", ["1e10", ".nan", ".inf", "late"])
def test_impossible_offsets_are_refused_by_name(value: str) -> None:
    with pytest.raises(SettingsError, match="time_offset"):
        load(None, {"logs.time_offset./imu": value})


def test_a_mounting_is_a_position_and_a_unit_quaternion() -> None:
    given = {"logs.mountings.lidar": "[0.8, 0, 1.7, 0, 0, 0.707, 0.707]"}
    assert load(None, given).logs.mountings["lidar"][:3] == (0.8, 0.0, 1.7)
    with pytest.raises(SettingsError, match=r"mountings\.lidar have to be a unit quaternion"):
        load(None, {"logs.mountings.lidar": "[0, 0, 1.7, 0, 0, 0, 2]"})
    with pytest.raises(SettingsError, match=r"logs\.mountings\.lidar"):
        load(None, {"logs.mountings.lidar": "[0, 0, 1.7]"})


@pytest.mark.parametrize(
    ("key", "meant"),
    [("fusion.voxelsize", "fusion.voxel_size"), ("fussion.hit", "fusion"), ("xyzzy", None)],
)
def test_a_key_that_is_spelled_wrong_is_suggested(key: str, meant: str | None) -> None:
    with pytest.raises(SettingsError) as caught:
        load(assignments={key: "1"})
    assert ("Did you mean" in str(caught.value)) == (meant is not None)
    assert meant is None or f"'{meant}'?" in str(caught.value)


def test_a_method_is_a_settings_file_that_others_change(tmp_path: Path) -> None:
    paper = load(method="paper")
    assert paper.training.method == "paper"
    assert (paper.training.batch, paper.training.dropout) == (32, 0.10)
    assert (paper.training.reconstruction_weight, paper.training.occupied_weight) == (10, 10)
    assert paper.training.contrastive_weight == 0
    assert (paper.plain.headings, paper.plain.neighbours) == (18, 5)
    assert (paper.plain.kappa, paper.plain.min_tau) == (3.0, 0.3)
    file = tmp_path / "own.yaml"
    file.write_text("training:\n  batch: 8\nplain:\n")
    changed = load(file, {"plain.kappa": "2"}, method="paper")
    assert (changed.training.batch, changed.training.method) == (8, "paper")
    assert changed.plain.kappa == 2.0
    with pytest.raises(SettingsError, match="there are paper"):
        load(method="papers")

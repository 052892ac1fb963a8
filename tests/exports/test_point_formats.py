"""Clouds read back by other readers: the same points, classes and colours that the tables hold."""

from __future__ import annotations

import sys
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.errors import SemlocError, WorkspaceError
from semloc_logs.exports import POINT_FORMATS, Selection, export
from semloc_logs.exports import point_formats as formats_module
from semloc_logs.exports.map_points import SessionPoints
from semloc_logs.labels.space import cityscapes
from semloc_logs.numerics.transforms import apply, yaw_transform
from semloc_logs.tables import contracts
from semloc_logs.tables.table import write_json, write_table
from semloc_logs.voxels.store import Keyframe, keep_keyframes, pose_columns
from semloc_logs.workspace import Workspace

METADATA = {"schema_version": 1}
VOXEL = 0.5
STAMP = 1_700_000_000 * 10**9  # 14 November 2023
Cloud = tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]  # xyz, train id, rgb


def make(
    work: Workspace, session_T_map: NDArray[np.float64], posed: bool = True
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Two tiles in row groups of 50 voxels, two keyframes; returns the centres in the map frame and
    classes, in the files' order.
    """
    rng = np.random.default_rng(1)
    folder = work.session("town")
    every = []
    labels = []
    for tile in (-1, 0):
        ijk = rng.integers(0, 256, (400, 3)) + np.array([256 * tile, 0, -100])
        ijk = ijk[np.argsort(ijk[:, 0])]
        label = rng.choice(np.array([0, 1, 2, 5, 8, 9, 13, 18, 255], np.uint8), 400)
        columns = {
            "ix": ijk[:, 0],
            "iy": ijk[:, 1],
            "iz": ijk[:, 2],
            "label": label,
            "occupancy": np.ones(400),
            "hits": np.ones(400, int),
        }
        write_table(
            folder.voxels / f"tile={tile}_0/part-0.parquet",
            contracts.table("voxels", columns),
            METADATA,
            row_group=50,
        )
        every.append((ijk + 0.5) * VOXEL)
        labels.append(label)
    poses = np.array(
        [yaw_transform(0.0, (0.0, 0.0, 0.0)), yaw_transform(np.pi / 2, (10.0, 0.0, 0.0))]
    )
    frames = {
        "stamp_ns": [STAMP, STAMP + 1],
        "keyframe": [0, 1],
        "log_time_ns": [STAMP, STAMP + 1],
        "topic": ["/points"] * 2,
        "posed": [posed] * 2,
        "distance": [0.0, 10.0],
        "ground_z": [0.0, 0.0],
        "points": [2, 1],
        **{f"{name}_{c}": np.zeros(2, np.float32) for name in ("origin", "view") for c in "xyz"},
        **pose_columns(poses),
    }
    write_table(folder.frames, contracts.table("frames", frames), METADATA)
    clouds = [
        Keyframe(np.array([[1, 2, 3], [4, 5, 6]], np.float32), np.array([0, 2], np.uint8)),
        Keyframe(np.array([[1, 2, 3]], np.float32), np.array([8], np.uint8)),
    ]
    folder.keyframes.mkdir()
    list(keep_keyframes(folder.keyframes, [1, 2], clouds, METADATA))
    write_json(
        folder.session_json,
        {"posed": posed, "session_T_map": session_T_map.tolist(), "voxel_size": VOXEL},
    )
    return np.concatenate(every), np.concatenate(labels)


def read_pcd(path: Path) -> Cloud:
    """PCD v0.7 by its specification."""
    head, _, body = path.read_bytes().partition(b"DATA binary\n")
    says = {
        line.split()[0]: line.split()[1:]
        for line in head.decode().splitlines()
        if not line.startswith("#")
    }
    assert list(says) == [
        "VERSION",
        "FIELDS",
        "SIZE",
        "TYPE",
        "COUNT",
        "WIDTH",
        "HEIGHT",
        "VIEWPOINT",
        "POINTS",
    ]
    assert (says["VERSION"], says["COUNT"], says["HEIGHT"]) == (["0.7"], ["1"] * 5, ["1"])
    kinds = [f"<{t.lower()}{s}" for t, s in zip(says["TYPE"], says["SIZE"], strict=True)]
    rows = np.frombuffer(body, list(zip(says["FIELDS"], kinds, strict=True)))
    assert len(rows) == int(says["POINTS"][0]) == int(says["WIDTH"][0])
    rgb = rows["rgb"].copy().view(np.uint32)
    assert says["TYPE"][-1] == "F"  # as PCL needs a field rgb
    return (
        np.stack([rows[c] for c in "xyz"], 1).astype(float),
        rows["label"].astype(int),
        np.stack([rgb >> 16, rgb >> 8 & 255, rgb & 255], 1).astype(int),
    )


def read_ply(path: Path) -> Cloud:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1"}
    rows = np.frombuffer(
        body,
        [
            (line.split()[2], kinds[line.split()[1]])
            for line in lines
            if line.startswith("property")
        ],
    )
    assert f"element vertex {len(rows)}" in lines
    return tuple(
        np.stack([rows[c] for c in names], 1).astype(t)
        for names, t in (("xyz", float), (("label",), int), (("red", "green", "blue"), int))
    )  # type: ignore[return-value]


def read_las(path: Path) -> Cloud:
    laspy = pytest.importorskip("laspy")
    las = laspy.read(path)
    assert (str(las.header.version), las.header.point_format.id, las.header.creation_date) == (
        "1.4",
        7,
        date(2023, 11, 14),
    )
    label = np.asarray(las.train_id).astype(int)
    expected = {0: 2, 1: 2, 9: 2, 8: 5, 2: 6, 255: 1, 5: 69, 13: 77, 18: 82}
    assert np.asarray(las.classification).tolist() == [expected[c] for c in label.tolist()]
    np.testing.assert_allclose(las.header.mins, las.xyz.min(0), atol=1e-6)
    rgb = np.stack([las.red, las.green, las.blue], 1).astype(int)
    assert (rgb % 257 == 0).all()
    return np.asarray(las.xyz), label, rgb // 257


def read_xyz(path: Path) -> Cloud:
    rows = np.loadtxt(path, ndmin=2)
    label = rows[:, 3].astype(int)
    return rows[:, :3], label, colours(label)


READERS = {"pcd": read_pcd, "ply": read_ply, "las": read_las, "laz": read_las, "xyz": read_xyz}


def colours(label: NDArray[Any]) -> NDArray[np.int64]:
    table = np.full((256, 3), 128)
    table[:19] = cityscapes().colours
    return np.asarray(table[label])


NEAR = yaw_transform(0.3, (100.0, -20.0, 5.0))
FAR = yaw_transform(0.3, (500_000.0, 5_400_000.0, 300.0))  # UTM


@pytest.mark.parametrize("frame", ["session", "map"])
@pytest.mark.parametrize("form", POINT_FORMATS)
def test_clouds_come_back(form: str, frame: Any, tmp_path: Path) -> None:
    centres, label = make(Workspace(tmp_path), NEAR)
    (path,) = export(Workspace(tmp_path), [], form, tmp_path / "out", Selection(frame=frame))
    assert path.name == f"town.{form}"
    xyz, label_read, rgb = READERS[form](path)
    assert label_read.ravel().tolist() == label.tolist()
    np.testing.assert_allclose(
        xyz,
        apply(NEAR, centres) if frame == "session" else centres,
        atol=6e-4 if form[:2] == "la" else 6e-5,
    )
    assert rgb.tolist() == colours(label).tolist()
    assert [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("form", POINT_FORMATS)
def test_only_what_lies_in_the_bounds(form: str, tmp_path: Path) -> None:
    centres, label = make(Workspace(tmp_path), NEAR)
    bounds = (40.0, -10.0, 90.0, 60.0)
    (path,) = export(
        Workspace(tmp_path), ["town"], form, tmp_path / "out", Selection(bounds=bounds)
    )
    placed = apply(NEAR, centres)
    inside = (
        (placed[:, 0] >= 40) & (placed[:, 0] < 90) & (placed[:, 1] >= -10) & (placed[:, 1] < 60)
    )
    assert 20 < inside.sum() < 400
    xyz, label_read, _ = READERS[form](path)
    np.testing.assert_allclose(xyz, placed[inside], atol=6e-4)
    assert label_read.ravel().tolist() == label[inside].tolist()


def test_bounds_skip_row_groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from semloc_logs.mapping.session_map import SessionMap

    make(Workspace(tmp_path), NEAR)
    points = SessionPoints(
        SessionMap(Workspace(tmp_path).session("town")), "voxels", "map", (10.0, -1e9, 14.0, 1e9)
    )
    read: list[bool] = []
    original = points._may_hold

    def noted(group: Any) -> bool:
        read.append(original(group))
        return read[-1]

    monkeypatch.setattr(points, "_may_hold", noted)
    assert points.count() == sum(len(label) for _, label in points.batches()) > 0
    # 16 row groups, each 50 columns of x wide
    assert (len(read) // 2, sum(read) // 2) in {(16, 1), (16, 2)}


@pytest.mark.parametrize("form", POINT_FORMATS)
def test_an_empty_box_is_a_file_without_points(form: str, tmp_path: Path) -> None:
    make(Workspace(tmp_path), NEAR)
    (path,) = export(
        Workspace(tmp_path),
        [],
        form,
        tmp_path / "out",
        Selection(bounds=(1e6, 1e6, 1e6 + 1, 1e6 + 1)),
    )
    if form == "xyz":
        assert path.read_text() == ""
    elif form in ("las", "laz"):
        assert pytest.importorskip("laspy").read(path).header.point_count == 0
    else:
        assert len(READERS[form](path)[0]) == 0


@pytest.mark.parametrize("form", ["ply", "las", "laz", "xyz"])
def test_far_from_the_origin_nothing_is_rounded(form: str, tmp_path: Path) -> None:
    centres, _ = make(Workspace(tmp_path), FAR)
    (path,) = export(Workspace(tmp_path), [], form, tmp_path / "out")
    np.testing.assert_allclose(READERS[form](path)[0], apply(FAR, centres), atol=6e-4)


def test_pcd_far_from_the_origin_is_refused_and_says_what_to_do(tmp_path: Path) -> None:
    make(Workspace(tmp_path), FAR)
    with pytest.raises(WorkspaceError, match=r"0\.5 m apart: use --frame map, or --format las"):
        export(Workspace(tmp_path), [], "pcd", tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())
    export(Workspace(tmp_path), [], "pcd", tmp_path / "out", Selection(frame="map"))


@pytest.mark.parametrize("form", POINT_FORMATS)
def test_points_of_keyframes(form: str, tmp_path: Path) -> None:
    make(Workspace(tmp_path), NEAR)
    (path,) = export(Workspace(tmp_path), [], form, tmp_path / "out", Selection("keyframes", "map"))
    assert path.name == f"town-keyframes.{form}"
    if form in ("las", "laz"):
        assert pytest.importorskip("laspy").read(path).classification.tolist() == [2, 6, 5]
    xyz, label, _ = READERS[form](path)
    # the second keyframe looks along y from x = 10
    np.testing.assert_allclose(xyz, [[1, 2, 3], [4, 5, 6], [8, 1, 3]], atol=6e-4)
    assert label.ravel().tolist() == [0, 2, 8]


def test_keyframes_without_poses_are_refused(tmp_path: Path) -> None:
    make(Workspace(tmp_path), NEAR, posed=False)
    with pytest.raises(WorkspaceError, match="no poses"):
        export(Workspace(tmp_path), [], "ply", tmp_path / "out", Selection("keyframes"))


@pytest.mark.parametrize(("form", "package"), [("las", "laspy"), ("laz", "lazrs")])
def test_a_missing_library_is_named_with_the_way_to_get_it(
    form: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(Workspace(tmp_path), NEAR)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(
        SemlocError,
        match=rf"{package}, which is not installed: run pip install 'semloc_logs\[las\]'",
    ):
        export(Workspace(tmp_path), [], form, tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())


def test_a_failed_export_leaves_the_older_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(Workspace(tmp_path), NEAR)
    (path,) = export(Workspace(tmp_path), [], "pcd", tmp_path / "out")
    before = path.read_bytes()
    monkeypatch.setattr(SessionPoints, "count", lambda _: 7)
    with pytest.raises(WorkspaceError, match="changed while it was exported"):
        export(Workspace(tmp_path), [], "pcd", tmp_path / "out", overwrite=True)
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == ["town.pcd"]


@pytest.mark.parametrize("form", POINT_FORMATS)
def test_the_same_map_gives_the_same_bytes(form: str, tmp_path: Path) -> None:
    make(Workspace(tmp_path), NEAR)
    paths = [export(Workspace(tmp_path), [], form, tmp_path / name)[0] for name in ("a", "b")]
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_a_damaged_tile_is_named(tmp_path: Path) -> None:
    make(Workspace(tmp_path), NEAR)
    tile = next(Workspace(tmp_path).session("town").voxels.rglob("*.parquet"))
    content = tile.read_bytes()
    for damaged in (b"", content[:100], content[:400] + bytes(400) + content[800:]):
        tile.write_bytes(damaged)
        with pytest.raises(WorkspaceError, match=r"part-0\.parquet cannot be read"):
            export(Workspace(tmp_path), [], "xyz", tmp_path / "out")


def test_asprs_classes_cover_every_byte() -> None:
    table = formats_module.asprs_classes()
    assert table.shape == (256,)
    assert (table >= 1).all()
    # users' classes are not shared
    assert len({int(table[c]) for c in range(19) if table[c] >= 64}) == 19 - 5


def test_the_command_exports_and_refuses_what_makes_no_sense(tmp_path: Path) -> None:
    from click.testing import CliRunner

    from semloc_logs.cli.main import program

    make(Workspace(tmp_path), NEAR)

    def run(*arguments: str) -> tuple[int, str]:
        done = CliRunner().invoke(
            program, ["export", "-w", str(tmp_path), *arguments], prog_name="semloc"
        )
        return done.exit_code, done.output

    assert run("--format", "xyz", "--bounds", "-50", "-50", "50", "50", "--frame", "map") == (
        0,
        f"{tmp_path}/export/town.xyz\n",
    )
    assert 0 < len((tmp_path / "export/town.xyz").read_text().splitlines()) < 800
    for wrong in (
        ("tum", "--frame", "map"),
        ("xyz", "--bounds", "1", "0", "1", "5"),
        ("xyz", "--bounds", "nan", "0", "1", "5"),
    ):
        code, output = run("--format", *wrong)
        assert code == 2, output

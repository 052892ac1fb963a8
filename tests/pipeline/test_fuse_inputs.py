"""What makes `fuse` work again: every input of a session, and nothing else."""

import json
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import semloc_logs
from semloc_logs.errors import WorkspaceError
from semloc_logs.logs.annotation.annotate import Results, annotate_in_place
from semloc_logs.logs.poses.mountings import Mountings, StaticTransform
from semloc_logs.logs.poses.trajectory_file import TrajectoryFile
from semloc_logs.mapping.session_fusion import FusedSession, FuseTask
from semloc_logs.settings import Logs, load
from semloc_logs.simulation.output.truth_file import write_truth
from semloc_logs.stages import fuse as fuse_stage
from semloc_logs.stages.inputs import SessionInput
from semloc_logs.tables.table import read_json, read_table
from semloc_logs.workspace import Workspace
from tests.pipeline.fusions import Fuse, log_of, was_done


def test_another_log_under_a_known_name_replaces_it_only_on_demand(
    fuse: Fuse, coarse: Workspace, drives: Any, tools: SimpleNamespace, tmp_path: Path
) -> None:
    log = Path(shutil.copyfile(drives["monday"].log, tmp_path / "monday.mcap"))
    assert not was_done(fuse([log])), "the same content under another path"
    shutil.copyfile(drives["wednesday"].log, log)
    before = tools.files(coarse.path)
    with pytest.raises(WorkspaceError, match=r"'monday' was made from another log .*--overwrite"):
        fuse([log])
    assert tools.files(coarse.path) == before
    assert was_done(fuse([log], overwrite=True))
    assert (
        read_table(coarse.session("monday").frames)["stamp_ns"][0].as_py()
        == drives["wednesday"].trajectory.stamps_ns[0]
    )
    assert not was_done(fuse([log]))


def test_a_log_that_is_touched_or_annotated_keeps_its_content(
    fuse: Fuse, drives: Any, tmp_path: Path
) -> None:
    log = Path(shutil.copyfile(drives["monday"].log, tmp_path / "monday.mcap"))
    os.utime(log, (1, 1))
    assert not was_done(fuse([log]))
    annotate_in_place(log, Results([], "monday", {}, {}))
    assert log.read_bytes() != drives["monday"].log.read_bytes()
    assert not was_done(fuse([log]))


def test_another_log_of_the_session_is_fused_on_demand(fuse: Fuse, drives: Any) -> None:
    both = [drives["monday"].log, drives["tuesday"].log]
    with pytest.raises(WorkspaceError, match="another log"):
        fuse(both)
    assert was_done(fuse(both, overwrite=True))
    assert not was_done(fuse(both))
    with pytest.raises(WorkspaceError, match="another log"):
        fuse(both[:1])


@pytest.mark.parametrize(
    "changed",
    [
        {"fusion__hit": "0.9"},
        {"fusion__submap_length": "70"},
        {"labels__source": "uniform"},
        {"labels__erode": "3"},
    ],
)
def test_settings_of_fusion_and_labels_are_inputs(
    fuse: Fuse, tools: SimpleNamespace, changed: dict[str, str]
) -> None:
    assert was_done(fuse(settings=tools.coarse_settings(**changed)))
    assert not was_done(fuse(settings=tools.coarse_settings(**changed)))


@pytest.mark.parametrize(
    "changed",
    [
        {"descriptor__stride": "4"},
        {"query__frames": "3"},
        {"closures__min_probability": "0.5"},
        {"training__seed": "7"},
    ],
)
def test_settings_of_later_stages_are_none(
    fuse: Fuse, tools: SimpleNamespace, changed: dict[str, str]
) -> None:
    assert not was_done(fuse(settings=tools.coarse_settings(**changed)))


def test_topics_are_inputs(fuse: Fuse) -> None:
    topics = {"lidar": "/lidar/points", "pose": "/odometry"}
    with pytest.raises(WorkspaceError, match="'monday' was made with other topics"):
        fuse(topics=topics)
    assert was_done(fuse(topics=topics, overwrite=True))
    assert not was_done(fuse(topics=dict(reversed(topics.items())))), "their order means nothing"
    with pytest.raises(WorkspaceError, match="other topics"):
        fuse(topics={"lidar": "/lidar/points"})


def test_the_version_is_an_input(fuse: Fuse, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(semloc_logs, "__version__", "999.0")
    assert was_done(fuse())


def test_the_file_of_poses_is_an_input(
    fuse: Fuse, coarse: Workspace, drives: Any, tmp_path: Path
) -> None:
    file = tmp_path / "poses.tum"
    twin = tmp_path / "twin.tum"
    monday = drives["monday"].trajectory
    write_truth(file, monday.stamps_ns, monday.world_T_base)
    with pytest.raises(WorkspaceError, match="'monday' was made with other poses"):
        fuse(poses=TrajectoryFile(file))
    assert was_done(fuse(poses=TrajectoryFile(file), overwrite=True))
    first = read_table(coarse.session("monday").trajectory)
    # in the world; in the frame of the odometry it is near 100
    assert first["t_x"][0].as_py() == pytest.approx(-9.0, abs=0.05)
    shutil.copyfile(file, twin)
    assert not was_done(fuse(poses=TrajectoryFile(twin))), "the same content under another path"
    lines = file.read_text().splitlines()
    file.write_text("\n".join(lines[1:]) + "\n")
    for other in (TrajectoryFile(file), TrajectoryFile(file, frame="lidar"), None):
        with pytest.raises(WorkspaceError, match="other poses"):
            fuse(poses=other)
        assert was_done(fuse(poses=other, overwrite=True))


def test_the_file_of_a_label_space_is_an_input(
    fuse: Fuse, coarse: Workspace, tools: SimpleNamespace, tmp_path: Path
) -> None:
    file = tmp_path / "space.yaml"
    settings = tools.coarse_settings(labels__space=str(file))

    def labels() -> set[int]:
        return set(
            read_table(coarse.session("monday").voxels / "tile=0_0/part-0.parquet")[
                "label"
            ].to_pylist()
        ) - {255}

    file.write_text("classes: {0: {name: street, to: road}, 2: {name: house, to: building}}\n")
    assert was_done(fuse(settings=settings))
    assert labels() == {0, 2}
    os.utime(file, (1, 1))
    assert not was_done(fuse(settings=settings))
    file.write_text("classes: {0: {name: street, to: road}, 2: {name: house, to: wall}}\n")
    assert was_done(fuse(settings=settings))
    assert labels() == {0, 3}


def test_the_files_of_a_label_model_are_inputs(
    fuse: Fuse, tools: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The model itself is not run: a stand-in writes what tells that a session is done."""

    def stand_in(task: FuseTask, **_: Any) -> FusedSession:
        content = {
            "fingerprint": task.fingerprint,
            "skipped": [],
            "problems": [],
            "keyframes": 0,
            "submaps": [],
            "voxels": 0,
            "logs": [],
        }
        task.folder.session_json.write_text(json.dumps(content))
        return FusedSession({**content, "label_source": "onnx"}, ())

    monkeypatch.setattr(fuse_stage, "fuse_session", stand_in)
    model = tmp_path / "model.onnx"
    spec = tmp_path / "spec.yaml"
    model.write_bytes(b"one model")
    spec.write_text("input: {size: [8, 8]}\nclasses: [building, car]\n")
    settings = tools.coarse_settings(
        labels__source="onnx", labels__model=str(model), labels__spec=str(spec)
    )
    assert was_done(fuse(settings=settings))
    os.utime(model, (1, 1))
    assert not was_done(fuse(settings=settings))
    model.write_bytes(b"another model")
    assert was_done(fuse(settings=settings))
    spec.write_text("input: {size: [8, 8]}\nclasses: [car, building]\n")
    assert was_done(fuse(settings=settings))
    assert not was_done(fuse(settings=settings))


def test_settings_of_reading_stay_with_their_session(
    fuse: Fuse, coarse: Workspace, tools: SimpleNamespace
) -> None:
    def recorded() -> str:
        content = read_json(coarse.session("monday").session_json)
        return str(content["settings"]["logs"]["up"])

    assert was_done(fuse(settings=tools.coarse_settings(logs__up="+z")))
    assert not was_done(fuse())  # no settings of reading: as before
    assert recorded() == "+z"
    assert was_done(fuse(settings=tools.coarse_settings(logs__up="0,0,2")))
    assert recorded() == "0,0,2"
    assert was_done(fuse(overwrite=True))
    assert recorded() == "auto"


def test_memory_is_not_a_setting_of_a_session() -> None:
    """How much may be used depends on the machine that reads the log now."""
    present = {"settings": {"logs": Logs(up="+z", memory=1 << 30).model_dump(mode="json")}}
    settings = load(assignments={"logs.memory": str(1 << 28)}).resolved()
    read = fuse_stage._as_read_before(present, settings)
    assert (read.logs.up, read.logs.memory) == ("+z", 1 << 28)


def test_a_log_borrows_transforms_from_those_of_other_sessions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it borrows is an input of the session."""
    calls: list[tuple[Any, ...]] = []
    lent = Mountings()

    def lend(paths: Any, others: Any, topics: Any, child: Any, memory: int) -> Mountings:
        calls.append((paths, others, child))
        return lent

    monkeypatch.setattr(fuse_stage, "lent_transforms", lend)
    a, b, c = (log_of(tmp_path, name).logs[0] for name in "abc")
    sessions = [SessionInput("ab", (a, b)), SessionInput("c", (c,))]
    work = Workspace(tmp_path / "work")

    def planned(**given: str) -> list[str]:
        settings = load(assignments={k.replace("__", "."): v for k, v in given.items()}).resolved()
        return [t.fingerprint for t in fuse_stage.plan_fuse(sessions, work, settings).tasks]

    first = planned()
    assert calls == [((a, b), [c], None), ((c,), [a, b], None)]
    calls.clear()
    planned(fusion__odometry="lidar")
    assert [child for _, _, child in calls] == ["base_link", "base_link"]
    transform = StaticTransform("base_link", "lidar", (0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0))
    lent = Mountings(lent=(transform,))
    assert not set(planned()) & set(first)
    write_truth(tmp_path / "poses.tum", np.array([0, 1]), np.array([np.eye(4), np.eye(4)]))
    for frame, expected in (("imu", "imu"), ("", "base_link")):
        calls.clear()
        sessions = [
            SessionInput("c", (c,), poses=TrajectoryFile(tmp_path / "poses.tum", None, frame))
        ]
        planned()
        assert calls == [((c,), [], expected)]

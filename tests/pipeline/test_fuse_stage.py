"""What makes `fuse` work again: every input, and nothing else; overwriting, and going on after an
interruption.
"""

import json
import logging
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import semloc_logs
from semloc_logs.engines import Serial
from semloc_logs.errors import (
    LogError,
    RemoteError,
    SemlocError,
    TemporaryError,
    TopicError,
    WorkspaceError,
)
from semloc_logs.logs.annotation.annotate import Results, annotate_in_place
from semloc_logs.logs.poses.mountings import Mountings, StaticTransform
from semloc_logs.logs.poses.trajectory_file import TrajectoryFile
from semloc_logs.logs.problems import Problem, ProblemKind
from semloc_logs.mapping import session_fusion
from semloc_logs.mapping.session_fusion import FusedSession, FuseTask
from semloc_logs.numerics.transforms import transform
from semloc_logs.settings import Logs, Resolved, Settings, load
from semloc_logs.simulation.output.truth_file import write_truth
from semloc_logs.stages import fuse as fuse_stage
from semloc_logs.stages.inputs import Redo, SessionInput
from semloc_logs.stages.report import Report
from semloc_logs.tables.table import read_json, read_table, write_json
from semloc_logs.workspace import Workspace

Fuse = Callable[..., Report]


@pytest.fixture
def fuse(tools: SimpleNamespace, drives: Any, coarse: Workspace) -> Fuse:
    """Fuses Monday into the workspace ``coarse``, where it was fused before, with whatever differs
    from then.
    """

    def again(
        logs: list[Path] | None = None,
        settings: Resolved | None = None,
        topics: dict[str, str] | None = None,
        poses: TrajectoryFile | None = None,
        overwrite: bool = False,
    ) -> Report:
        monday = tuple(logs or [drives["monday"].log])
        session = SessionInput("monday", monday, topics or {}, poses)
        settings = settings or tools.coarse_settings()
        return fuse_stage.fuse(
            [session], coarse, settings, Serial(), redo=Redo.of(overwrite=overwrite)
        )

    return again


def was_done(report: Report) -> bool:
    assert (report.done, report.kept) in ((["monday"], []), ([], ["monday"]))
    return bool(report.done == ["monday"])


def test_nothing_is_done_twice(fuse: Fuse, coarse: Workspace, tools: SimpleNamespace) -> None:
    before = tools.write_times(coarse.path)
    assert not was_done(fuse())
    assert tools.write_times(coarse.path) == before


@pytest.mark.parametrize("changes", [{}, {"fusion.keyframe_resolution": "0.2"}])
def test_session_json_is_read_once(
    fuse: Fuse, tools: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, changes: dict[str, str]
) -> None:
    read: list[Path] = []

    def recorded(path: Path) -> Any:
        read.append(path)
        return read_json(path)

    monkeypatch.setattr(fuse_stage, "read_json", recorded)
    done = was_done(fuse(settings=tools.coarse_settings(**changes)))
    assert done == bool(changes)
    assert [path.name for path in read] == ["session.json"]


def test_a_part_that_is_given_twice_is_named(
    drives: dict[str, Any], tools: SimpleNamespace, tmp_path: Path
) -> None:
    [monday] = tools.inputs(drives, "monday")
    log = monday.logs[0]
    copy = tmp_path / "copy.mcap"
    shutil.copy(log, copy)
    twice = replace(monday, logs=(log, copy, log))
    plan = fuse_stage.plan_fuse([twice], Workspace(tmp_path / "w"), tools.coarse_settings())
    assert plan.report.skipped == [
        f"Session monday: {copy} is the same as {log}: give each part once.",
        f"Session monday: {log} is given twice: give each part once.",
    ]
    assert (
        fuse_stage.plan_fuse(
            [monday], Workspace(tmp_path / "w"), tools.coarse_settings()
        ).report.skipped
        == []
    )


@pytest.mark.parametrize("damaged", ["", '{"name": "mon', "[]", "{}"])
def test_a_damaged_session_json_is_made_again(
    fuse: Fuse, coarse: Workspace, damaged: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = coarse.session("monday").session_json
    before = path.read_text()
    path.write_text(damaged)
    assert was_done(fuse())
    assert json.loads(path.read_text())["fingerprint"] == json.loads(before)["fingerprint"]
    if damaged != "{}":
        assert "The session is made again from its log." in caplog.text
        assert str(path) in caplog.text


def test_overwriting_does_it_again(fuse: Fuse, coarse: Workspace, tools: SimpleNamespace) -> None:
    tables = tools.files(coarse.path)
    times = tools.write_times(coarse.path)
    assert was_done(fuse(overwrite=True))
    # a map that is made again has no words yet
    assert tools.files(coarse.path) == {
        name: digest for name, digest in tables.items() if "monday/words" not in name
    }
    written = {name for name, time in tools.write_times(coarse.path).items() if time != times[name]}
    assert {
        "sessions/monday/session.json",
        "sessions/monday/frames.parquet",
        "sessions/monday/map.png",
    } <= written
    assert not [name for name in written if not name.startswith("sessions/monday/")]


# -- the logs


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


# -- settings, topics, version


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


# -- files beside the log


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


# -- failures and interruptions


def test_a_log_that_fails_does_not_end_the_others(
    tools: SimpleNamespace, drives: Any, tmp_path: Path
) -> None:
    (tmp_path / "empty.bag").touch()
    (tmp_path / "no.mcap").write_bytes(b"no log")
    work = Workspace(tmp_path / "work")
    no_log = SessionInput("no", (tmp_path / "no.mcap",))
    inputs = [no_log, *tools.inputs(drives, "monday")]
    report = fuse_stage.fuse(inputs, work, tools.coarse_settings(), Serial())
    assert report.done == ["monday"]
    assert len(report.failed) == 1
    assert [s.name for s in work.sessions()] == ["monday"]
    with pytest.raises(LogError):
        fuse_stage.fuse([no_log], work, tools.coarse_settings(), Serial())


def test_a_log_that_failed_is_read_again_when_it_or_the_settings_change_or_on_demand(
    tools: SimpleNamespace, drives: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "no.mcap"
    log.write_bytes(b"no log")
    work = Workspace(tmp_path / "work")
    read: list[str] = []
    fuse_session = session_fusion.fuse_session

    def counted(task: FuseTask, **options: Any) -> FusedSession:
        read.append(task.folder.name)
        return fuse_session(task, **options)

    monkeypatch.setattr(fuse_stage, "fuse_session", counted)

    def fuse_again(**options: Any) -> tuple[Report, int]:
        read.clear()
        settings = options.pop("settings", tools.coarse_settings())
        inputs = [SessionInput("no", (log,)), *tools.inputs(drives, "monday")]
        return fuse_stage.fuse(inputs, work, settings, Serial(), **options), read.count("no")

    first, reads = fuse_again()
    assert (first.done, len(first.failed), reads) == (["monday"], 1, 1)
    content = read_json(work.failure("no"))
    assert content["reason"] == first.failed[0]
    assert content["logs"] == [str(log)]
    second, reads = fuse_again()
    assert (second.kept, reads) == (["monday"], 0)
    assert second.failed == [f"{first.failed[0]} It failed before: --retry-failed reads it again."]
    assert fuse_again(redo=Redo.FAILED)[1] == 1
    log.write_bytes(b"still no log")
    assert fuse_again()[1] == 1
    assert fuse_again()[1] == 0
    assert fuse_again(settings=tools.coarse_settings(labels__source="uniform"))[1] == 1
    shutil.copyfile(drives["tuesday"].log, log)
    fused, _ = fuse_again()
    assert fused.done == ["no", "monday"]
    assert work.failures() == []


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_an_interrupted_session_is_done_again(
    share: float,
    fuse: Fuse,
    coarse: Workspace,
    tools: SimpleNamespace,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Interrupted after a share of its files, under other settings: the present session stays
    whole, with its words, until the new one is.
    """
    folder = coarse.session("monday")
    other = tools.coarse_settings(fusion__hit="0.9", fusion__keyframe_resolution="0.3")
    first = tools.files(folder.path)
    steps = tools.renames(monkeypatch, lambda: fuse(settings=other))
    second = tools.files(folder.path)
    assert steps > 5
    assert first.keys() - second.keys() == {n for n in first if n.startswith("words")}
    tools.renames(monkeypatch, fuse, round(share * (steps - 1)))
    assert tools.files(folder.path) == second
    assert [p.name for p in folder.path.parent.iterdir() if p.name.startswith(".")] == []
    assert was_done(fuse()), "the interrupted stage"
    assert tools.files(folder.path) == {n: d for n, d in first.items() if not n.startswith("words")}


def test_a_killed_replacement_is_put_back(
    fuse: Fuse, coarse: Workspace, tools: SimpleNamespace
) -> None:
    """Killed between the two renames: the session is away under another name."""
    before = tools.files(coarse.path)
    folder = coarse.session("monday").path
    folder.rename(folder.with_name(".monday.0badcafe.old.tmp"))
    half = folder.with_name(".monday.0badcafe.tmp")
    half.mkdir()
    (half / "session.json").write_text("{}")
    assert [s.name for s in coarse.sessions()] == ["tuesday"]
    assert not was_done(fuse())
    assert tools.files(coarse.path) == before


# -- what fusing makes of the known drives


@pytest.mark.parametrize("name", ["monday", "tuesday", "wednesday"])
def test_the_poses_of_a_session_are_the_true_ones(
    name: str, labelled: Workspace, drives: Any
) -> None:
    """The trajectory is in the session frame, keyframes are in the map frame; the true headings are
    40, 80 and 290 degrees.
    """
    drive = drives[name]
    folder = labelled.session(name)
    expected = {"monday": 40.0, "tuesday": 80.0, "wednesday": 290.0}[name]
    frames = read_table(folder.frames)
    session_T_map = np.array(read_json(folder.session_json)["session_T_map"])
    positions = np.column_stack([frames[f"t_{c}"].to_numpy() for c in "xyz"])
    turns = np.column_stack([frames[f"q_{c}"].to_numpy() for c in "xyzw"])
    for stamp, map_T_base in zip(
        frames["stamp_ns"].to_pylist(), transform(positions, turns), strict=True
    ):
        session_T_base = session_T_map @ map_T_base
        np.testing.assert_allclose(
            session_T_base, drive.session_T_world @ drive.world_T_base(stamp), atol=2e-3
        )
        heading = np.degrees(np.arctan2(session_T_base[1, 0], session_T_base[0, 0])) % 360
        assert heading == pytest.approx(expected, abs=1.0)
    np.testing.assert_allclose(
        session_T_map[:3, 3],
        (drive.session_T_world @ drive.world_T_base(frames["stamp_ns"][0].as_py()))[:3, 3],
        atol=2e-3,
    )


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


# -- with a fusion that takes no time


def log_of(folder: Path, name: str) -> SessionInput:
    log = folder / f"{name}.mcap"
    log.write_bytes(name.encode())
    return SessionInput(name, (log,))


@pytest.mark.parametrize(
    ("error", "raised"),
    [(TemporaryError, TemporaryError), (TopicError, TopicError), (RemoteError, LogError)],
)
def test_a_fault_that_is_not_the_logs_is_not_remembered(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: type[SemlocError],
    raised: type[SemlocError],
) -> None:
    """A server that is away, a topic that was named wrongly: the next run reads the log again."""

    def fails(task: FuseTask, **options: Any) -> FusedSession:
        raise error("It did not work.")

    monkeypatch.setattr(fuse_stage, "fuse_session", fails)
    work = Workspace(tmp_path / "work")
    settings = Settings().resolved()
    with pytest.raises(raised, match="It did not work") as caught:
        fuse_stage.fuse([log_of(tmp_path, "a")], work, settings, Serial())
    assert type(caught.value) is raised
    both = [log_of(tmp_path, name) for name in ("a", "b")]
    with pytest.raises(raised):
        fuse_stage.fuse(both, work, settings, Serial())
    assert work.failures() == []


def test_the_amount_is_the_seconds_of_all_logs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A log without messages has no start; failures of before are forgotten."""
    seconds: dict[str, list[int | None]] = {"a": [2, None], "b": [3]}

    def quick(task: FuseTask, **options: Any) -> FusedSession:
        logs = [
            {"start_ns": None if end is None else 0, "end_ns": None if end is None else end * 10**9}
            for end in seconds[task.folder.name]
        ]
        counts = {"keyframes": 0, "voxels": 0, "label_source": "log"}
        write_json(task.folder.session_json, counts)
        return FusedSession({"logs": logs, **counts}, ())

    monkeypatch.setattr(fuse_stage, "fuse_session", quick)
    work = Workspace(tmp_path / "work")
    write_json(work.failure("b"), {"reason": "It failed.", "fingerprint": ""})
    sessions = [log_of(tmp_path, name) for name in ("a", "b")]
    report = fuse_stage.fuse(sessions, work, Settings().resolved(), Serial())
    assert report.done == ["a", "b"]
    assert report.amount == 5.0
    assert work.failures() == []


def test_a_worker_with_a_disk_of_its_own_is_named(tmp_path: Path) -> None:
    elsewhere: Any = SimpleNamespace(
        jobs=1, map=lambda function, tasks: [FusedSession({}, ()) for _ in tasks]
    )
    work = Workspace(tmp_path / "work")
    with pytest.raises(WorkspaceError, match="on a disk of its own"):
        fuse_stage.fuse([log_of(tmp_path, "a")], work, Settings().resolved(), elsewhere)


def test_memory_is_not_a_setting_of_a_session() -> None:
    """How much may be used depends on the machine that reads the log now."""
    present = {"settings": {"logs": Logs(up="+z", memory=1 << 30).model_dump(mode="json")}}
    settings = load(assignments={"logs.memory": str(1 << 28)}).resolved()
    read = fuse_stage._as_read_before(present, settings)
    assert (read.logs.up, read.logs.memory) == ("+z", 1 << 28)


def quick_fusion(
    monkeypatch: pytest.MonkeyPatch, problems: tuple[Problem, ...] = ()
) -> Callable[..., Report]:
    """Fuses sessions without reading them: one whose name begins with "bad" fails, with "topic"
    lacks a topic.
    """

    def quick(task: FuseTask, **options: Any) -> FusedSession:
        name = task.folder.name
        if name.startswith("bad"):
            raise LogError(f"{name} cannot be read.")
        if name.startswith("topic"):
            raise TopicError(f"{name} lacks a topic.")
        counts = {"keyframes": 0, "voxels": 0, "label_source": "log"}
        recorded = {"fingerprint": task.fingerprint, "skipped": ["no fix"], **counts}
        write_json(task.folder.session_json, recorded)
        return FusedSession({"logs": [], **counts}, problems)

    monkeypatch.setattr(fuse_stage, "fuse_session", quick)

    def fuse(work: Workspace, *names: str, **options: Any) -> Report:
        sessions = [log_of(work.path.parent, name) for name in names]
        return fuse_stage.fuse(sessions, work, Settings().resolved(), Serial(), **options)

    return fuse


def test_only_logs_of_the_named_sessions_are_repaired_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    repaired: list[Path] = []
    monkeypatch.setattr(fuse_stage, "recover", repaired.append)
    fuse = quick_fusion(monkeypatch)
    report = fuse(Workspace(tmp_path / "work"), "a", "b", "c", names=["a", "c"])
    assert report.done == ["a", "c"]
    assert repaired == [tmp_path / "a.mcap", tmp_path / "c.mcap"]


def test_what_a_log_lost_is_told_each_time_and_its_other_problems_are_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    problems = (
        Problem("/gps", ProblemKind.POSE, "no fix", lost=True),
        Problem("/imu", ProblemKind.GRAVITY, "up is from the IMU", lost=False),
    )
    fuse = quick_fusion(monkeypatch, problems)
    work = Workspace(tmp_path / "work")
    assert fuse(work, "a").skipped == ["no fix"]
    assert "a: up is from the IMU" in caplog.text
    assert "a: no fix" not in caplog.text
    again = fuse(work, "a")
    assert (again.kept, again.skipped) == (["a"], ["no fix"])


def test_one_failure_is_raised_and_several_are_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    fuse = quick_fusion(monkeypatch)
    work = Workspace(tmp_path / "work")
    with pytest.raises(LogError, match="bad 1 cannot be read"):
        fuse(work, "bad 1")
    assert "bad 1 cannot be read" not in caplog.text
    with pytest.raises(LogError, match=r"It failed before.*bad 2 cannot be read"):
        fuse(work, "bad 1", "bad 2")
    assert "bad 2 cannot be read" not in caplog.text  # the only one that was read
    with pytest.raises(LogError, match="bad 3 cannot be read"):
        fuse(work, "bad 3", "bad 4")
    assert "bad 3: bad 3 cannot be read." in caplog.text
    # with a log that failed before it is more than a missing topic
    with pytest.raises(LogError) as caught:
        fuse(work, "bad 1", "topic")
    assert not isinstance(caught.value, TopicError)


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


def test_workers_in_another_folder_find_the_log_and_the_workspace(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log_of(tmp_path, "a")
    monkeypatch.chdir(tmp_path)
    session = SessionInput("a", (Path("a.mcap"),))
    [task] = fuse_stage.plan_fuse([session], Workspace(Path("w")), Settings().resolved()).tasks
    assert task.logs == (tmp_path / "a.mcap",)
    assert task.folder.path == Workspace(tmp_path / "w").session("a").path


def test_overwriting_includes_what_failed() -> None:
    options = [(True, True), (True, False), (False, True), (False, False)]
    chosen = [Redo.of(overwrite=o, retry_failed=r) for o, r in options]
    assert chosen == [Redo.EVERYTHING, Redo.EVERYTHING, Redo.FAILED, Redo.NOTHING]

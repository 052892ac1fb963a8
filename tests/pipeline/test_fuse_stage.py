"""What `fuse` does once, does again on demand, and reports; poses of the known drives."""

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from semloc_logs.engines import Serial
from semloc_logs.logs.problems import Problem, ProblemKind
from semloc_logs.mapping.session_fusion import FusedSession, FuseTask
from semloc_logs.numerics.transforms import transform
from semloc_logs.pictures import map_picture, times
from semloc_logs.progress import Progress, listening
from semloc_logs.settings import Settings, load
from semloc_logs.stages import fuse as fuse_stage
from semloc_logs.stages.inputs import Redo, SessionInput
from semloc_logs.tables.table import read_json, read_table, write_json
from semloc_logs.workspace import Workspace
from tests.pipeline.fusions import Fuse, log_of, quick_fusion, was_done


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


def test_the_amount_is_the_seconds_of_all_logs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A log without messages has no start; failures of before are forgotten."""
    seconds: dict[str, list[int | None]] = {"a": [2, None], "b": [3]}

    def quick(task: FuseTask, **options: Any) -> FusedSession:
        logs = [
            {"start_ns": None, "end_ns": None}
            if length is None
            else {"start_ns": 7 * 10**9, "end_ns": (7 + length) * 10**9}
            for length in seconds[task.folder.name]
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


def test_workers_in_another_folder_find_the_log_and_the_workspace(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log_of(tmp_path, "a")
    monkeypatch.chdir(tmp_path)
    session = SessionInput("a", (Path("a.mcap"),))
    [task] = fuse_stage.plan_fuse([session], Workspace(Path("w")), Settings().resolved()).tasks
    assert task.logs == (tmp_path / "a.mcap",)
    assert task.folder.path == Workspace(tmp_path / "w").session("a").path


def test_each_session_is_reported_when_it_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that failed counts, too."""
    fuse = quick_fusion(monkeypatch)
    events: list[Progress] = []
    with listening(events.append):
        fuse(Workspace(tmp_path / "work"), "a", "bad", "c")
    assert events == [Progress("fuse", "", done, 3, "sessions") for done in range(4)]


@pytest.mark.parametrize(("overwrite", "hit"), [(False, 0.8), (True, 0.9)])
def test_overwriting_gives_the_workspace_other_settings_of_maps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, overwrite: bool, hit: float
) -> None:
    quick_fusion(monkeypatch)
    work = Workspace(tmp_path / "work")
    for given, redo in (("0.8", Redo.NOTHING), ("0.9", Redo.of(overwrite=overwrite))):
        settings = load(assignments={"fusion.hit": given}).resolved()
        fuse_stage.fuse([log_of(tmp_path, "a")], work, settings, Serial(), redo=redo)
    assert read_json(work.settings)["settings"]["fusion"]["hit"] == hit


@pytest.mark.parametrize("posed", [True, False])
def test_a_map_is_drawn_with_its_drive_and_period(
    posed: bool, coarse: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without poses only the map is drawn."""
    drawn: list[Any] = []
    monkeypatch.setattr(map_picture, "draw_map", lambda *given: drawn.append(given))
    monkeypatch.setattr(times, "period_text", lambda first, last: f"{first} to {last}")
    folder = coarse.session("monday")
    content = read_json(folder.session_json) | {"posed": posed}
    fuse_stage._draw(folder, content)
    [(voxels, positions, caption, picture)] = drawn
    assert (voxels, picture) == (folder.voxels, folder.picture)
    frames = read_table(folder.frames)
    expected = np.column_stack([frames[f"t_{c}"].to_numpy() for c in "xyz"])
    np.testing.assert_allclose(positions, expected if posed else np.zeros((0, 3)))
    stamps = frames["stamp_ns"].to_pylist()
    assert caption == map_picture.Caption(
        "monday", content["label_source"], content["voxel_size"], f"{stamps[0]} to {stamps[-1]}"
    )

"""The public API does what the stages do, and gives back typed rows."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import semloc_logs as semloc
from semloc_logs.errors import LogError, SettingsError, WorkspaceError
from semloc_logs.frames import LidarFrame
from semloc_logs.numerics.transforms import apply
from semloc_logs.progress import Progress
from semloc_logs.workspace import Workspace as Folder


@pytest.fixture
def work(coarse: Folder, tools: SimpleNamespace) -> semloc.Workspace:
    return semloc.Workspace(coarse.path, settings=tools.coarse_settings())


def test_run_does_what_the_stages_do(
    drives: Any, coarse: Folder, tools: SimpleNamespace, tmp_path: Path
) -> None:
    events: list[Progress] = []
    other = semloc.Workspace(
        tmp_path / "other", settings=tools.coarse_settings(), progress=events.append
    )
    logs = [drives["monday"].log, drives["tuesday"].log]
    report = other.run(logs)
    assert report.closures == len(other.closures()) > 0
    assert other.sessions == ["monday", "tuesday"]
    tables, expected = tools.files(other.path), tools.files(coarse.path)
    differing = {name for name in expected if tables[name] != expected[name]}
    assert differing <= {"run.json"}
    assert {event.stage for event in events} >= {"describe", "close"}
    assert events[-1].finished
    assert other.run(logs).done == []


def test_closures_are_typed_rows(work: semloc.Workspace) -> None:
    closures = work.closures()
    table = pq.read_table(work.path / "closures.parquet")
    assert closures.to_arrow().equals(table)
    assert len(closures) == table.num_rows
    first, row = closures[0], table.to_pylist()[0]
    assert (first.query_session, first.target_stamp_ns) == (
        row["query_session"],
        row["target_stamp_ns"],
    )
    np.testing.assert_allclose(first.target_T_query[:3, 3], [row["t_x"], row["t_y"], row["t_z"]])
    np.testing.assert_array_equal(first.covariance.ravel(), row["covariance"])
    assert [c.probability for c in closures] == table["probability"].to_pylist()
    assert [c.words for c in closures[-2:]] == table["words"].to_pylist()[-2:]
    with pytest.raises(IndexError):
        closures[len(closures)]
    assert work.rejected().num_rows == pq.read_metadata(work.path / "rejected.parquet").num_rows


def test_a_session_gives_its_map_in_either_frame(work: semloc.Workspace) -> None:
    monday = work["monday"]
    assert monday.name == "monday"
    in_map, in_session = monday.voxels("map"), monday.voxels()
    assert in_map.column_names == ["x", "y", "z", "label"]
    centres = np.stack([in_map[axis].to_numpy() for axis in "xyz"], 1)
    index = centres / monday.info["voxel_size"] - 0.5
    np.testing.assert_allclose(index, np.round(index), atol=1e-6)
    session_T_map = np.array(monday.info["session_T_map"])
    moved = np.stack([in_session[axis].to_numpy() for axis in "xyz"], 1)
    np.testing.assert_allclose(moved, apply(session_T_map, centres), atol=1e-6)
    assert in_map.num_rows == monday.info["voxels"]
    assert monday.keyframes.num_rows == monday.info["keyframes"]
    assert monday.points().num_rows > in_map.num_rows
    assert monday.trajectory().column_names[:2] == ["stamp_ns", "t_x"]
    assert "tuesday" in work
    assert [session.name for session in work] == ["monday", "tuesday"]
    with pytest.raises(WorkspaceError, match=r"no session sunday \(it has monday, tuesday\)"):
        work["sunday"]


def test_a_session_may_have_several_logs_and_a_name(drives: Any, tmp_path: Path) -> None:
    work = semloc.Workspace(tmp_path / "w", settings={"fusion.keyframe_distance": 20})
    assert work.settings.fusion.keyframe_distance == 20
    assert work.fuse({"week": [drives["monday"].log]}).done == ["week"]
    with pytest.raises(TypeError, match="list of paths"):
        work.fuse("monday.mcap")
    with pytest.raises(ValueError, match="'a'"):
        work.fuse(["x/a.mcap", "y/a.bag"])
    with pytest.raises(WorkspaceError, match="run close first"):
        work.closures()


def test_settings_come_from_a_mapping_a_file_or_an_object(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text("fusion: {voxel_size: 0.05}\n")
    for given in ({"fusion.voxel_size": 0.05}, tmp_path / "s.yaml"):
        settings = semloc.Workspace(tmp_path, settings=given).settings
        assert settings.fusion.max_range == pytest.approx(50 / 6)
    assert semloc.Workspace(tmp_path, settings=semloc.Settings()).settings.fusion.max_range == 50
    with pytest.raises(SettingsError, match=r"fusion\.voxel_sise"):
        semloc.Workspace(tmp_path, settings={"fusion.voxel_sise": 0.05})


def test_a_log_opens_as_typed_frames(drives: Any, tmp_path: Path) -> None:
    with semloc.open_log(drives["monday"].log) as log:
        assert "/lidar/points" in [stream.topic for stream in log.streams]
        frame = next(f for f in log.frames() if isinstance(f, LidarFrame))
        assert len(frame.points) > 100
    with pytest.raises(LogError, match="does not exist"):
        semloc.open_log(tmp_path / "none.mcap")


def test_closures_are_annotated_and_judged(
    work: semloc.Workspace, drives: Any, tmp_path: Path
) -> None:
    made = work.annotate(drives["monday"].log, tmp_path / "out.mcap")
    assert made.path == tmp_path / "out.mcap"
    assert made.closures > 0
    truth = {
        drives[name].log.name: {
            "T_common_session": np.linalg.inv(drives[name].session_T_world).tolist()
        }
        for name in ("monday", "tuesday")
    }
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    result = semloc.evaluate(work, tmp_path / "truth.json")
    assert (result.correct, result.false) == (len(work.closures()), 0)


def test_an_expected_error_is_of_one_kind(tmp_path: Path) -> None:
    with pytest.raises(semloc.SemlocError, match="no session"):
        semloc.Workspace(tmp_path / "new")["monday"]


def test_importing_the_package_is_cheap() -> None:
    code = (
        "import sys, semloc_logs; print(sorted({'torch', 'numpy', 'pyarrow'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True)
    assert done.stdout == "[]\n"
    assert set(dir(semloc)) >= {"Workspace", "open_log", "evaluate"}
    with pytest.raises(AttributeError, match="no_such_thing"):
        semloc.no_such_thing  # noqa: B018

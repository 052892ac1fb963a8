"""The results that annotating writes, before they are messages: from tables to records and a
scene.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from semloc_logs.closures.closure_tables import read_closures
from semloc_logs.errors import SemlocError
from semloc_logs.exports.map_cloud import map_cloud
from semloc_logs.logs.annotation import tail_swap
from semloc_logs.logs.annotation.annotate import Results
from semloc_logs.logs.annotation.scene import Drive
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.stages import annotate as annotate_stage
from semloc_logs.stages.annotate import Annotation, AnnotationMode
from semloc_logs.tables.table import read_json, write_json
from semloc_logs.workspace import Workspace

Rows = list[dict[str, Any]]
Make = Callable[..., Results]


@pytest.fixture
def results_of(
    labelled: Workspace, tools: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Make:
    """``results_of(name, change, **edits)``: the results of a session's log with the rows of
    closures that ``change`` makes, and ``edits`` of the session.json of sessions.
    """

    def make(name: str, change: Callable[[Rows], Rows] = list, **edits: dict[str, Any]) -> Results:
        work = Workspace(tmp_path / f"work{len(list(tmp_path.iterdir()))}")
        shutil.copytree(labelled.path, work.path, ignore=shutil.ignore_patterns("optimized"))
        for session, edit in edits.items():
            path = work.session(session).session_json
            write_json(path, read_json(path) | edit)
        rows = change(read_closures(work.closures))
        monkeypatch.setattr(annotate_stage, "read_closures", lambda _: rows)
        own = SessionMap(work.session(name))
        return annotate_stage._results(work, own, tools.quick_settings(), common=False)

    return make


def placed(results: Results) -> dict[str, Any]:
    return {edge.child: edge.parent_T_child for edge in results.scene.fixed}


def drives_of(results: Results) -> dict[str, Drive]:
    return {drive.session: drive for drive in results.scene.drives}


@pytest.mark.parametrize("name", ["monday", "tuesday", "wednesday"])
def test_both_ends_are_at_their_true_positions(results_of: Make, drives: Any, name: str) -> None:
    """In this log's frame, whether it is the query or the target."""
    results = results_of(name)
    assert results.closures
    for closure in results.closures:
        is_query = closure.query_session == name
        ends = [
            (closure.query_session, closure.query_stamp_ns),
            (closure.target_session, closure.target_stamp_ns),
        ]
        (_, own_ns), (other, other_ns) = ends if is_query else ends[::-1]
        session_T_world = drives[name].session_T_world
        own = session_T_world @ drives[name].world_T_base(own_ns)
        there = session_T_world @ drives[other].world_T_base(other_ns)
        assert closure.session_position is not None
        assert closure.session_other is not None
        np.testing.assert_allclose(closure.session_position, own[:3, 3], atol=0.01)
        np.testing.assert_allclose(closure.session_other, there[:3, 3], atol=0.06)


def test_sessions_lie_where_the_most_probable_closure_puts_them(results_of: Make) -> None:
    """All the others are made 50 m wrong: nothing moves."""

    def change(rows: Rows) -> Rows:
        pairs: dict[tuple[str, str], Rows] = {}
        for row in rows:
            pairs.setdefault((row["query_session"], row["target_session"]), []).append(row)
        for number, of_pair in enumerate(pairs.values()):
            for k, row in enumerate(of_pair):
                row["probability"] = 0.995 - 1e-4 * k - 1e-3 * number
                row["t_x"] += 50.0 if k else 0.0
        assert max(map(len, pairs.values())) > 1
        return rows

    moved = placed(results_of("monday", change))
    right = placed(results_of("monday"))
    assert set(moved) == set(right) == {"semloc/monday", "semloc/tuesday", "semloc/wednesday"}
    for child, pose in moved.items():
        assert np.linalg.norm(pose[:3, 3] - right[child][:3, 3]) < 10.0


def test_a_session_without_poses_has_no_frame(results_of: Make) -> None:
    results = results_of("monday", tuesday={"posed": False})
    assert set(placed(results)) == {"semloc/monday", "semloc/wednesday"}
    assert set(drives_of(results)) == {"monday", "wednesday"}


def test_a_map_of_points_has_no_drive(results_of: Make) -> None:
    results = results_of("monday", tuesday={"logs": [{"format": "map"}]})
    assert "semloc/tuesday" in placed(results)
    assert set(drives_of(results)) == {"monday", "wednesday"}


def test_the_map_is_of_the_other_sessions(results_of: Make, labelled: Workspace) -> None:
    """Its own points are in the log already."""
    results = results_of("monday", lambda rows: [r for r in rows if "wednesday" not in r.values()])
    others = [(SessionMap(labelled.session("tuesday")), placed(results)["semloc/tuesday"])]
    expected = map_cloud(others, "odom")
    assert expected is not None
    assert results.scene.cloud is not None
    np.testing.assert_array_equal(results.scene.cloud.points, expected.points)


def test_a_log_without_closures_shows_its_own_map(results_of: Make) -> None:
    results = results_of("monday", lambda rows: [])
    assert results.closures == []
    assert set(drives_of(results)) == {"monday"}
    assert results.scene.cloud is not None
    assert len(results.scene.cloud.points) > 100


def test_a_vehicle_whose_topmost_frame_has_the_poses_gets_no_transform(results_of: Make) -> None:
    root = {"frame": "odom", "base_T_root": np.eye(4).tolist()}
    assert results_of("monday").scene.moving
    assert results_of("monday", monday={"vehicle_root": root}).scene.moving == []


def test_a_long_drive_is_thinned_over_its_whole_length(
    results_of: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = drives_of(results_of("monday"))["monday"].positions
    assert len(whole) > 4
    monkeypatch.setattr(annotate_stage, "MOST_POSITIONS", 3)
    some = drives_of(results_of("monday"))["monday"].positions
    step = -(-len(whole) // 3)
    np.testing.assert_array_equal(some, whole[::step])


def test_a_file_is_only_replaced_when_told_so(
    labelled: Workspace, drives: Any, tools: SimpleNamespace, tmp_path: Path
) -> None:
    output = tmp_path / "out.mcap"
    output.write_bytes(b"something")
    settings = tools.quick_settings()
    log = drives["monday"].log
    for mode in (AnnotationMode.COPY, AnnotationMode.SIDECAR):
        with pytest.raises(SemlocError, match="exists"):
            annotate_stage.annotate(log, labelled, settings, Annotation(mode, output))
        assert output.read_bytes() == b"something"
    annotation = Annotation(AnnotationMode.SIDECAR, output, overwrite=True)
    annotate_stage.annotate(log, labelled, settings, annotation)
    assert output.read_bytes() != b"something"


def test_a_log_that_was_being_annotated_is_repaired_first(
    labelled: Workspace,
    drives: Any,
    tools: SimpleNamespace,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Killed in the middle of its end: a copy needs a whole log."""
    log = Path(shutil.copyfile(drives["monday"].log, tmp_path / "monday.mcap"))
    whole = log.read_bytes()
    settings = tools.quick_settings()

    def killed(fd: int, offset: int, tail: bytes) -> None:
        os.pwrite(fd, tail[:100], offset)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(tail_swap, "_write_tail", killed)
        patch.setattr(tail_swap, "_undo", lambda *_: None)
        with pytest.raises(KeyboardInterrupt):
            annotate_stage.annotate(log, labelled, settings, Annotation(AnnotationMode.IN_PLACE))
    assert log.read_bytes() != whole
    annotation = Annotation(AnnotationMode.SIDECAR, tmp_path / "out.mcap")
    annotate_stage.annotate(log, labelled, settings, annotation)
    assert log.read_bytes() == whole
    assert sorted(p.name for p in tmp_path.iterdir()) == ["monday.mcap", "out.mcap"]

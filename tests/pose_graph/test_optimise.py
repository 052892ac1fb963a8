"""Drives around a block in one frame: known drift in, true poses out."""

import shutil
import sys
from typing import Any

import numpy as np
import pytest

from semloc_logs.errors import SemlocError
from semloc_logs.evaluation.trajectory_errors import trajectory_errors
from semloc_logs.numerics.transforms import inverse, yaw_transform
from semloc_logs.settings import load
from semloc_logs.stages.optimise import optimise
from semloc_logs.tables.table import read_json, read_metadata, read_table, write_json, write_table
from semloc_logs.voxels.store import poses_of

pytest.importorskip("gtsam")
SETTINGS = load().resolved()


def _solved(drives: Any, name: str) -> Any:
    return poses_of(read_table(drives.work.optimized_trajectory(name)))


def test_a_drive_without_drift_gives_its_frame_and_the_other_drive_comes_into_it(
    drives: Any, square_of: Any
) -> None:
    drives.add("a", square_of(1), 0.0, 1.0)
    drives.add("b", square_of(1) @ yaw_transform(0.0, (0.0, 2.0, 0.0)), 0.0, 1.0)
    drives.close([("b", k, "a", k, None) for k in range(20, 400, 40)])
    report = optimise(drives.work, SETTINGS)
    assert (report.sessions, report.closures, report.rejected, report.frames) == (2, 10, 0, 1)
    # a starts at the corner, so its map frame is the common frame of the truth
    np.testing.assert_allclose(_solved(drives, "a"), drives.true["a"], atol=1e-3)
    np.testing.assert_allclose(_solved(drives, "b"), drives.true["b"], atol=1e-3)


def test_two_laps_whose_ends_meet_take_the_drift_away(drives: Any, square_of: Any) -> None:
    drives.add("a", square_of(2), 0.01, 1.01)  # 8 degrees and 8 m after two laps
    drives.close([("a", 400 + k, "a", k, None) for k in range(0, 401, 20)])
    optimise(drives.work, SETTINGS)
    errors = trajectory_errors(drives.work, drives.truth_file)
    assert errors.ate_before_m is not None
    assert errors.ate_after_m is not None
    assert errors.ate_before_m > 2.0
    assert errors.ate_after_m < 0.5 * errors.ate_before_m
    solved = _solved(drives, "a")
    for k in range(0, 401, 20):  # the second lap lies on the first
        np.testing.assert_allclose(solved[k, :3, 3], solved[400 + k, :3, 3], atol=0.15)


def test_a_false_closure_is_refused_with_its_reason(drives: Any, square_of: Any) -> None:
    drives.add("a", square_of(1), 0.0, 1.0)
    drives.add("b", square_of(1), 0.005, 1.0)
    wrong = yaw_transform(0.0, (30.0, 0.0, 0.0))
    right = [("b", k, "a", k, None) for k in range(20, 400, 40)]
    drives.close([*right, ("b", 100, "a", 200, wrong)])
    report = optimise(drives.work, SETTINGS)
    assert report.rejected == 1
    table = read_table(drives.work.graph_closures)
    assert table["kept"].to_pylist() == [True] * 10 + [False]
    assert table["reason"].to_pylist()[-1].startswith("contradicts")
    # by 30 m
    assert table["error_m"].to_pylist()[-1] == pytest.approx(30.0, abs=0.5)


def test_sessions_without_a_closure_keep_a_frame_of_their_own(drives: Any, square_of: Any) -> None:
    for name in ("a", "b", "c"):
        drives.add(name, square_of(1), 0.0, 1.0)
    drives.close([("c", k, "a", k, None) for k in range(20, 400, 40)])
    assert optimise(drives.work, SETTINGS).frames == 2
    metadata = {n: read_metadata(drives.work.optimized_trajectory(n)) for n in ("a", "b", "c")}
    assert [metadata[n]["frame"] for n in ("a", "b", "c")] == ["a", "b", "a"]
    np.testing.assert_allclose(_solved(drives, "b"), drives.true["b"], atol=1e-6)


def test_relative_poses_are_kept_where_nothing_contradicts(drives: Any, square_of: Any) -> None:
    drives.add("a", square_of(1), 0.0, 1.0)
    drives.add("b", square_of(1), 0.01, 1.0)
    drives.close([("b", 200, "a", 200, None)])  # a single closure places b as it is
    optimise(drives.work, SETTINGS)
    a = _solved(drives, "a")
    b = _solved(drives, "b")
    np.testing.assert_allclose(inverse(a[200]) @ b[200], np.eye(4), atol=1e-3)
    recorded = poses_of(read_table(drives.work.session("b").trajectory))
    steps = inverse(recorded[:-1]) @ recorded[1:]
    np.testing.assert_allclose(inverse(b[:-1]) @ b[1:], steps, atol=1e-3)


def test_only_sessions_whose_closures_changed_are_solved_again(drives: Any, square_of: Any) -> None:
    for name in ("a", "b", "c", "d"):
        drives.add(name, square_of(1), 0.003, 1.0)
    first = [("b", k, "a", k, None) for k in range(20, 400, 40)]
    second = [("d", k, "c", k, None) for k in range(20, 400, 40)]
    drives.close([*first, *second])
    assert optimise(drives.work, SETTINGS).solved == ["a", "b", "c", "d"]
    files = [drives.work.graph_file, drives.work.graph_vertices, drives.work.graph_closures]
    files += [drives.work.optimized_trajectory(name) for name in ("a", "b", "c", "d")]
    before = [path.read_bytes() for path in files]
    assert optimise(drives.work, SETTINGS).solved == []
    assert [path.read_bytes() for path in files] == before

    drives.close([*first[:-1], *second])
    assert optimise(drives.work, SETTINGS).solved == ["a", "b"]
    assert read_table(drives.work.graph_closures).num_rows == 19
    drives.close([*first, *second])
    optimise(drives.work, SETTINGS)
    assert [path.read_bytes() for path in files] == before  # as in one go


def test_all_that_the_poses_depend_on_makes_them_again(drives: Any, square_of: Any) -> None:
    drives.add("a", square_of(1), 0.0, 1.0)
    drives.add("b", square_of(1), 0.0, 1.0)
    drives.close([("b", k, "a", k, None) for k in range(20, 400, 40)])
    both = ["a", "b"]

    def again(settings: Any = SETTINGS, **options: bool) -> list[str]:
        """What is solved now, after which nothing is left to do."""
        solved = optimise(drives.work, settings, **options).solved
        assert optimise(drives.work, settings, **(options | {"overwrite": False})).solved == []
        return list(solved)

    assert again() == both
    assert again() == []
    assert again(overwrite=True) == both
    assert again(covariances=True) == both
    other = load(assignments={"optimize.odometry_drift": "0.02"}).resolved()
    assert again(other) == both
    path = drives.work.session("b").session_json
    write_json(path, read_json(path) | {"fingerprint": "of another map"})
    assert again(other) == both
    drives.work.optimized_trajectory("b").unlink()
    assert again(other) == both
    # a trajectory of another time, as after a run that was killed
    earlier = drives.work.optimized_trajectory("b").read_bytes()
    assert again() == both
    drives.work.optimized_trajectory("b").write_bytes(earlier)
    assert again() == both
    # tables of the graph of another time: they are written last
    graph = (drives.work.graph_vertices, drives.work.graph_closures)
    before = [path.read_bytes() for path in graph]
    assert again(other) == both
    for path, content in zip(graph, before, strict=True):
        path.write_bytes(content)
    assert again(other) == both


def test_closures_of_two_groups_stay_in_the_order_of_their_table(
    drives: Any, square_of: Any
) -> None:
    """Rows of a and b, and of c and d, take turns."""
    for name in ("a", "b", "c", "d"):
        drives.add(name, square_of(1), 0.0, 1.0)
    drives.close([(q, k, t, k, None) for k in (20, 200) for q, t in (("d", "c"), ("b", "a"))])
    report = optimise(drives.work, SETTINGS)
    assert (report.frames, report.rejected) == (2, 0)
    ends = ("query_session", "query_stamp_ns")
    expected, kept = (
        [[row[end] for end in ends] for row in read_table(path).to_pylist()]
        for path in (drives.work.closures, drives.work.graph_closures)
    )
    assert [session for session, _ in kept] == ["d", "b", "d", "b"]
    assert kept == expected


def test_a_session_that_was_removed_leaves_nothing(drives: Any, square_of: Any) -> None:
    """Its closures are passed over, and its poses go."""
    for name in ("a", "b", "c"):
        drives.add(name, square_of(1), 0.0, 1.0)
    matches = [("b", 20, "a", 20, None), ("c", 30, "a", 30, None), ("a", 40, "c", 40, None)]
    drives.close(matches)
    assert optimise(drives.work, SETTINGS).closures == 3
    shutil.rmtree(drives.work.session("c").path)
    report = optimise(drives.work, SETTINGS)
    assert (report.sessions, report.closures, report.frames) == (2, 1, 1)
    trajectories = sorted(path.stem for path in drives.work.optimized.glob("*.parquet"))
    assert trajectories == ["a", "b"]


def test_without_any_closure_each_drive_has_its_own_frame(drives: Any, square_of: Any) -> None:
    drives.add("b", square_of(1), 0.0, 1.0)
    drives.add("a", square_of(1), 0.0, 1.0)
    drives.close([("b", 20, "a", 20, None)])
    table = read_table(drives.work.closures)
    write_table(drives.work.closures, table.slice(0, 0), read_metadata(drives.work.closures))
    report = optimise(drives.work, SETTINGS)
    assert (report.closures, report.rejected, report.frames) == (0, 0, 2)
    assert report.solved == ["a", "b"]


def test_the_graph_is_read_by_gtsam_with_the_same_poses(drives: Any, square_of: Any) -> None:
    gtsam = pytest.importorskip("gtsam")
    drives.add("a", square_of(1), 0.003, 1.0)
    drives.add("b", square_of(1), -0.004, 1.01)
    right = [("b", k, "a", k, None) for k in range(20, 400, 40)]
    drives.close([*right, ("b", 100, "a", 200, yaw_transform(0.0, (30.0, 0.0, 0.0)))])
    optimise(drives.work, SETTINGS)
    graph, values = gtsam.readG2o(str(drives.work.graph_file), True)
    table = read_table(drives.work.graph_vertices)
    assert values.size() == table.num_rows
    loops = len(right)  # the refused one is left out
    assert graph.size() == table.num_rows - 2 + loops
    for name in ("a", "b"):
        solved = _solved(drives, name)
        for row in table.to_pylist():
            if row["session"] == name:
                second = row["stamp_ns"] // 10**9 - drives.start_s[name]
                pose = values.atPose3(row["vertex"]).matrix()
                np.testing.assert_allclose(pose, solved[second], atol=1e-5)


def test_uncertainty_grows_with_the_way_from_the_closure(drives: Any, square_of: Any) -> None:
    drives.add("a", square_of(1), 0.0, 1.0)
    drives.add("b", square_of(1), 0.0, 1.0)
    drives.close([("b", 5, "a", 5, None)])
    optimise(drives.work, SETTINGS, covariances=True)
    table = read_table(drives.work.graph_vertices)
    covariance = np.array(table["covariance"].to_pylist()).reshape(-1, 6, 6)
    is_b = np.array(table["session"].to_pylist()) == "b"
    sigma = np.sqrt(np.trace(covariance[is_b, :3, :3], axis1=1, axis2=2))
    assert (np.diff(sigma[1:6]) > 0).all()  # along the first side
    # 0.1 m of every closure and some metres of odometry, in three axes
    assert 0.2 < sigma[1] < 0.6
    assert 2.0 < sigma[-1] < 20.0


def test_without_gtsam_a_sentence_names_the_extra(
    drives: Any, square_of: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    drives.add("a", square_of(1), 0.0, 1.0)
    drives.close([("a", 399, "a", 0, None)])
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(SemlocError, match=r"semloc_logs\[optimize\]"):
        optimise(drives.work, SETTINGS)

"""Closures against truth, with numbers that can be checked by hand: two sessions drive along x, 1 m
a second.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.errors import TruthError, WorkspaceError
from semloc_logs.evaluation.truth import evaluate_closures, read_tum
from semloc_logs.numerics.transforms import inverse, yaw_transform
from semloc_logs.settings import load
from semloc_logs.tables import contracts
from semloc_logs.tables.table import write_json, write_table
from semloc_logs.voxels.store import pose_columns
from semloc_logs.workspace import Workspace

SECOND = 1_000_000_000
METADATA = {"schema_version": 1, "voxel_size": 0.3}


def _poses(xs: NDArray[np.float64], y: float = 0.0) -> NDArray[np.float64]:
    return np.array([yaw_transform(0.0, (x, y, 0.0)) for x in xs])


def _session(work: Workspace, name: str, start_s: int, poses: NDArray[np.float64]) -> None:
    """A session whose keyframes are its trajectory, a second apart."""
    folder = work.session(name)
    n = len(poses)
    stamps = (start_s + np.arange(n)) * SECOND
    columns: dict[str, Any] = {"stamp_ns": stamps, **pose_columns(poses)}
    write_table(folder.trajectory, contracts.table("trajectory", columns), METADATA)
    steps = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))]
    frames = {
        **columns,
        "keyframe": np.arange(n),
        "log_time_ns": stamps,
        "topic": ["/points"] * n,
        "posed": [True] * n,
        "distance": steps,
        "ground_z": np.zeros(n),
        "points": np.zeros(n, int),
        **{f"{name}_{c}": np.zeros(n, np.float32) for name in ("origin", "view") for c in "xyz"},
    }
    write_table(folder.frames, contracts.table("frames", frames), METADATA)
    write_json(
        folder.session_json, {"posed": True, "session_T_map": np.eye(4).tolist(), "voxel_size": 0.3}
    )


def _closures(work: Workspace, rows: list[tuple[str, int, str, int, NDArray[np.float64]]]) -> None:
    """(query session, its second, target session, its second, target_T_query)."""
    n = len(rows)
    columns: dict[str, Any] = {
        "query_session": [r[0] for r in rows],
        "query_stamp_ns": [r[1] * SECOND for r in rows],
        "target_session": [r[2] for r in rows],
        "target_stamp_ns": [r[3] * SECOND for r in rows],
        **pose_columns(np.array([r[4] for r in rows])),
        "covariance": [np.eye(6).ravel().tolist()] * n,
        "overlap": [0.5] * n,
        "probability": [0.99] * n,
        "inliers": [1] * n,
        "words": [1] * n,
    }
    write_table(work.closures, contracts.table("closures", columns), METADATA)


@pytest.fixture
def work(tmp_path: Path) -> Workspace:
    """a drives x = 0 .. 20 at seconds 0 .. 20; b drives x = 10 .. 40 in a frame that lies 3 m to
    the left of a's, at 1000 .. 1030.
    """
    work = Workspace(tmp_path / "work")
    _session(work, "a", 0, _poses(np.arange(21.0)))
    _session(work, "b", 1000, _poses(np.arange(31.0)))
    truth = {
        "a.mcap": {"T_common_session": np.eye(4).tolist()},
        "b": {"T_common_session": yaw_transform(0.0, (10.0, 3.0, 0.0)).tolist()},
    }
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    return work


def _evaluate(work: Workspace, **options: Any) -> Any:
    return evaluate_closures(
        work,
        work.path.parent / "truth.json",
        load(assignments={"query.every": "2.0"}).resolved(),
        **options,
    )


def test_errors_are_those_of_the_relative_pose(work: Workspace) -> None:
    # b at second 1004 is at (14, 3) in common, a at second 12 at (12, 0): truly target_T_query is
    # (2, 3, 0)
    _closures(
        work,
        [
            ("b", 1004, "a", 12, yaw_transform(0.0, (2.3, 3.4, 0.0))),  # 0.5 m off
            ("b", 1006, "a", 14, yaw_transform(np.radians(4.0), (2.0, 3.0, 0.0))),  # 4 degrees off
            # 6 degrees: false
            ("b", 1008, "a", 16, yaw_transform(np.radians(6.0), (2.0, 3.0, 0.0))),
            ("b", 1010, "a", 18, yaw_transform(0.0, (2.0, 4.1, 0.0))),  # 1.1 m: false
        ],
    )
    result = _evaluate(work)
    assert [r.correct for r in result.rows] == [True, True, False, False]
    np.testing.assert_allclose([r.error_m for r in result.rows], [0.5, 0.0, 0.0, 1.1], atol=1e-9)
    np.testing.assert_allclose([r.error_deg for r in result.rows], [0.0, 4.0, 6.0, 0.0], atol=1e-6)
    assert (result.closures, result.correct, result.false, result.unjudged) == (4, 2, 2, 0)
    assert result.median_error_m == pytest.approx(0.25)
    assert result.median_error_deg == pytest.approx(2.0)


def test_the_pose_between_two_samples_is_interpolated(work: Workspace) -> None:
    folder = work.path.parent
    (folder / "b.tum").write_text("1000 10 3 0 0 0 0 1\n1030 40 3 0 0 0 0 1\n")
    (folder / "truth.json").write_text(
        json.dumps({"a": {"T_common_session": np.eye(4).tolist()}, "b": {"trajectory": "b.tum"}})
    )
    _closures(work, [("b", 1004, "a", 12, yaw_transform(0.0, (2.0, 3.0, 0.0)))])
    assert _evaluate(work).rows[0].error_m == pytest.approx(0.0, abs=1e-6)


def test_queries_near_the_other_session_count(work: Workspace) -> None:
    # queries of a at x = 0, 2 .. 20: b's road starts at (10, 3), so within 5 m from x = 6 on: 6 8
    # .. 20 are 8 queries queries of b at x = 10, 12 .. 40: a's road ends at (20, 0): within 5 m up
    # to x = 24: 10 .. 24 are 8 queries
    _closures(work, [])
    result = _evaluate(work)
    assert (result.queries, result.possible, result.answered) == (11 + 16, 16, 0)
    assert result.recall == 0.0


def test_a_closure_answers_its_query_and_the_query_at_its_other_end(work: Workspace) -> None:
    # b's query at second 1004; the target end, a at x = 12, is a query of a itself, and answered
    # with it; x = 10 and 14 are 2 m away: not
    _closures(work, [("b", 1004, "a", 12, yaw_transform(0.0, (2.0, 3.0, 0.0)))])
    assert _evaluate(work).answered == 2
    _closures(work, [("b", 1004, "a", 12, yaw_transform(0.0, (9.0, 3.0, 0.0)))])
    assert _evaluate(work).answered == 0


def test_recall_is_unknown_without_revisits(tmp_path: Path) -> None:
    work = Workspace(tmp_path / "work")
    _session(work, "a", 0, _poses(np.arange(21.0)))
    _closures(work, [])
    (tmp_path / "truth.json").write_text(
        json.dumps({"a.bag": {"T_common_session": np.eye(4).tolist()}})
    )
    result = _evaluate(work)
    assert result.recall is None
    assert result.median_error_m is None
    assert result.to_json()["closures"] == 0


def test_a_session_revisits_itself_apart_from_what_is_near(tmp_path: Path) -> None:
    """Out to x = 100 and back: keyframes of the way back lie on earlier ones, later than 30
    s and farther than 50 m of road.
    """
    work = Workspace(tmp_path / "work")
    xs = np.r_[np.arange(0.0, 101.0, 2.0), np.arange(98.0, -1.0, -2.0)]
    _session(work, "loop", 0, _poses(xs))
    _closures(work, [])
    (tmp_path / "truth.json").write_text(
        json.dumps({"loop.mcap": {"T_common_session": np.eye(4).tolist()}})
    )
    result = _evaluate(work)
    # keyframe k and 100 - k stand at one place; those within 5 m of it reach two keyframes (4 m)
    # farther. A query at x has a revisit when 2 * (100 - x) + 4 >= 50 m of road and as many / 2
    # seconds >= 30: x <= 72, both ways: x = 0, 2 .. 72 are 37 queries each
    assert (result.queries, result.possible) == (101, 74)
    assert _evaluate(work, self_closures=False).possible == 0


def test_closures_of_sessions_without_truth_are_not_judged(work: Workspace) -> None:
    truth = work.path.parent / "truth.json"
    truth.write_text(json.dumps({"a.mcap": {"T_common_session": np.eye(4).tolist()}}))
    _closures(work, [("b", 1004, "a", 12, np.eye(4))])
    result = _evaluate(work)
    assert (result.correct, result.false, result.unjudged) == (0, 0, 1)
    assert result.rows[0].error_m is None


def test_a_tum_file_says_the_same_as_the_matrix(work: Workspace) -> None:
    folder = work.path.parent
    lines = [
        "# seconds x y z qx qy qz qw",
        *(f"{1000 + k}.0 {10 + k} 3 0 0 0 0 1" for k in range(31)),
    ]
    (folder / "b.tum").write_text("\n".join(lines))
    truth = {"a.mcap": {"T_common_session": np.eye(4).tolist()}, "b.bag": {"trajectory": "b.tum"}}
    (folder / "truth.json").write_text(json.dumps(truth))
    _closures(work, [("b", 1004, "a", 12, yaw_transform(0.0, (2.3, 3.4, 0.0)))])
    result = _evaluate(work)
    assert result.rows[0].error_m == pytest.approx(0.5)
    assert result.possible == 16


def test_the_error_does_not_depend_on_the_common_frame(work: Workspace) -> None:
    rng = np.random.default_rng(1)
    _closures(work, [("b", 1004, "a", 12, yaw_transform(0.1, (2.3, 3.4, 0.0)))])
    first = _evaluate(work).rows[0]
    W = yaw_transform(float(rng.uniform(-3, 3)), tuple(rng.normal(size=3) * 100))
    truth = {
        "a": {"T_common_session": W.tolist()},
        "b": {"T_common_session": (W @ yaw_transform(0.0, (10.0, 3.0, 0.0))).tolist()},
    }
    (work.path.parent / "truth.json").write_text(json.dumps(truth))
    second = _evaluate(work).rows[0]
    assert second.error_m == pytest.approx(first.error_m)
    assert second.error_deg == pytest.approx(first.error_deg)
    np.testing.assert_allclose(inverse(W) @ W, np.eye(4), atol=1e-9)


def test_stamps_of_a_tum_file_are_exact(tmp_path: Path) -> None:
    path = tmp_path / "t.tum"
    path.write_text("1760000000.123456789 1 2 3 0 0 0 2\n1760000000.023456789 0 0 0 0 0 0 1\n")
    track = read_tum(path)
    assert track.stamps_ns.tolist() == [1760000000_023456789, 1760000000_123456789]
    np.testing.assert_allclose(track.common_T_base[1], yaw_transform(0.0, (1, 2, 3)), atol=1e-12)
    poses, known = track.at(np.array([1760000000_073456789, 1760000000_323456789]))
    np.testing.assert_allclose(poses[0][:3, 3], (0.5, 1, 1.5), atol=1e-6)
    assert known.tolist() == [True, False]


@pytest.mark.parametrize(
    "line",
    [
        "1 2 3",
        "a 1 2 3 0 0 0 1",
        "1 nan 2 3 0 0 0 1",
        "1 1 2 3 0 0 0 0",
        "1e30 1 2 3 0 0 0 1",
        "nan 1 2 3 0 0 0 1",
        "inf 0 0 0 0 0 0 1",
    ],
)
def test_wrong_lines_of_a_tum_file_are_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "t.tum"
    path.write_text("0 0 0 0 0 0 0 1\n" + line + "\n")
    with pytest.raises(TruthError, match="line 2"):
        read_tum(path)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        "{",
        '{"a": 3}',
        '{"a": {}}',
        '{"a": {"T_common_session": [[1]]}}',
        '{"a": {"trajectory": "no.tum"}}',
        '{"c": {"trajectory": "c.tum"}}',
        "\udcff",
    ],
)
def test_wrong_truth_files_are_refused(work: Workspace, content: str) -> None:
    (work.path.parent / "truth.json").write_bytes(content.encode("utf-8", "surrogateescape"))
    _closures(work, [])
    with pytest.raises(TruthError):
        _evaluate(work)


def test_a_truth_file_that_is_missing_is_named(work: Workspace) -> None:
    (work.path.parent / "truth.json").unlink(missing_ok=True)
    _closures(work, [])
    with pytest.raises(TruthError, match=r"truth.json does not exist"):
        _evaluate(work)


def test_a_matrix_that_is_no_pose_is_refused(work: Workspace) -> None:
    (work.path.parent / "truth.json").write_text(
        json.dumps({"a": {"T_common_session": (2 * np.eye(4)).tolist()}})
    )
    _closures(work, [])
    with pytest.raises(TruthError, match="rigid"):
        _evaluate(work)


def test_without_closures_there_is_nothing_to_evaluate(work: Workspace) -> None:
    with pytest.raises(WorkspaceError):
        _evaluate(work)


def test_a_workspace_without_sessions_or_closures_is_told_what_to_run(
    work: Workspace, tmp_path: Path
) -> None:
    settings = load().resolved()
    truth = tmp_path / "truth.json"
    with pytest.raises(WorkspaceError, match="holds no sessions: run 'semloc fuse' first"):
        evaluate_closures(Workspace(tmp_path / "empty"), truth, settings)
    with pytest.raises(WorkspaceError, match="has no closures yet: run 'semloc close' first"):
        evaluate_closures(work, truth, settings)


def test_recall_of_each_pair_of_sessions(work: Workspace) -> None:
    # c drives x = 100 .. 120, far from both, and d drives as a does, 2 m beside it
    _session(work, "c", 2000, _poses(np.arange(100.0, 121.0)))
    _session(work, "d", 3000, _poses(np.arange(21.0), 2.0))
    truth = json.loads((work.path.parent / "truth.json").read_text())
    truth |= {name: {"T_common_session": np.eye(4).tolist()} for name in "cd"}
    (work.path.parent / "truth.json").write_text(json.dumps(truth))
    _closures(
        work,
        [
            ("d", 3000, "a", 0, yaw_transform(0.0, (0.0, 2.0, 0.0))),  # right, at the first query
            ("d", 3010, "a", 10, yaw_transform(0.0, (5.0, 2.0, 0.0))),  # 5 m: false
            ("c", 2000, "b", 1030, yaw_transform(0.0, (0.0, 0.0, 0.0))),  # 60 m: false
        ],
    )
    result = _evaluate(work)
    pairs = {p.sessions: p for p in result.pairs}
    assert sorted(pairs) == [("a", "b"), ("a", "d"), ("b", "c"), ("b", "d")]
    assert (pairs["a", "d"].closures, pairs["a", "d"].correct, pairs["a", "d"].false) == (2, 1, 1)
    # queries every 2 m, 11 of each: all of them near the other; the first of d, and a's there
    assert (pairs["a", "d"].possible, pairs["a", "d"].answered) == (22, 2)
    assert pairs["a", "d"].recall == pytest.approx(2 / 22)
    assert (pairs["a", "b"].closures, pairs["a", "b"].answered, pairs["a", "b"].recall) == (0, 0, 0)
    assert (pairs["b", "c"].possible, pairs["b", "c"].recall) == (0, None)
    listed = {tuple(p["sessions"]): p["recall"] for p in result.to_json()["pairs"]}
    assert listed == {pair: p.recall for pair, p in pairs.items()}
    # a query that several sessions can answer counts once in all
    assert result.answered == 2
    assert result.possible < sum(p.possible for p in result.pairs)


def test_with_a_heading_only_revisits_at_that_angle_count(tmp_path: Path) -> None:
    """a drives east along y = 0, across drives north along x = 10, back drives west along y = 3."""
    work = Workspace(tmp_path / "work")
    steps = np.arange(21.0)
    north = np.array([yaw_transform(np.pi / 2, (10.0, y - 10.0, 0.0)) for y in steps])
    west = np.array([yaw_transform(np.pi, (20.0 - x, 3.0, 0.0)) for x in steps])
    _session(work, "a", 0, _poses(steps))
    _session(work, "across", 1000, north)
    truth = {name: {"T_common_session": np.eye(4).tolist()} for name in ("a", "across", "back")}
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    # at the crossing: seconds 10 of a and 1010 of across
    _closures(work, [("across", 1010, "a", 10, yaw_transform(np.pi / 2, (0.0, 0.0, 0.0)))])
    # x = 6, 8 .. 14 of a and y = -4, -2 .. 4 of across are within 5 m of the other street
    across = _evaluate(work, heading_deg=90.0)
    assert (across.closures, across.correct, across.possible, across.answered) == (1, 1, 10, 2)
    assert _evaluate(work).possible == 10
    opposite = _evaluate(work, heading_deg=180.0)
    assert (opposite.closures, opposite.possible) == (0, 0)

    # all 11 queries of back are beside a, 5 of them near across as well; and a's 11 beside back
    _session(work, "back", 2000, west)
    opposite = _evaluate(work, heading_deg=180.0)
    assert (opposite.closures, opposite.possible) == (0, 22)
    assert {p.sessions for p in opposite.pairs} == {("a", "back")}

    # once across was also driven east, a's queries meet more there than crossing views; the five
    # queries of across on its way north still cross a
    both = np.concatenate([north, _poses(np.arange(0.0, 21.0))])
    _session(work, "across", 1000, both)
    crossing = {p.sessions: p.possible for p in _evaluate(work, heading_deg=90.0).pairs}
    assert crossing["a", "across"] == 5

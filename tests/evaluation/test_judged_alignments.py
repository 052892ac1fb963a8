"""Alignments judged against the truth."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from semloc_logs.closures.alignment_tables import alignment_table
from semloc_logs.closures.closure import Alignment, Features
from semloc_logs.errors import WorkspaceError
from semloc_logs.evaluation import judged_alignments
from semloc_logs.evaluation.judged_alignments import judge_town, normalised_squares, read_judged
from semloc_logs.mapping.drift import UNMEASURED
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse, yaw_transform
from semloc_logs.tables import contracts
from semloc_logs.tables.table import read_table, write_table
from semloc_logs.workspace import Workspace

ROAD = np.array([yaw_transform(0.1, (2.0 * k, 1.0, 0.5)) for k in range(5)])
# 10 cm along x, 50 cm across, and 0.01 rad about z
COVARIANCE = np.diag([0.1, 0.5, 0.5, 0.1, 0.1, 0.01]) ** 2


def alignment(target_T_query: Any, stamp_ns: int = 10**9) -> Alignment:
    return Alignment(
        query_session="a",
        target_session="b",
        query_keyframe=1,
        target_keyframe=2,
        query_stamp_ns=stamp_ns,
        target_stamp_ns=2 * 10**9,
        target_T_query=target_T_query,
        covariance=COVARIANCE,
        overlap=0.5,
        inliers=1,
        words=1,
        features=Features(*[0.5] * 7),
    )


@pytest.fixture
def judge(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A function that stores alignments of session a in b and judges them into the table that it
    returns.
    """
    map_ = SimpleNamespace(
        map_T_base=ROAD,
        distance=2.0 * np.arange(5),
        stamps_ns=np.arange(5) * 10**9,
        folder=None,
        drift=UNMEASURED,
    )
    for name in "ab":
        (tmp_path / f"{name}.tum").write_text(
            "".join(f"{k} {2.0 * k} 1 0.5 0 0 {np.sin(0.05)} {np.cos(0.05)}\n" for k in range(5))
        )
    (tmp_path / "truth.json").write_text(
        '{"a": {"trajectory": "a.tum"}, "b": {"trajectory": "b.tum"}}'
    )
    monkeypatch.setattr(
        Workspace, "sessions", lambda _: [SimpleNamespace(name="a"), SimpleNamespace(name="b")]
    )
    monkeypatch.setattr(judged_alignments, "SessionMap", lambda _: cast(SessionMap, map_))

    def judged(*alignments: Alignment) -> Path:
        work = Workspace(tmp_path)
        none = contracts.schema("rejected").empty_table()
        write_table(work.rejected, none, {"voxel_size": 0.3, "queries": 5})
        path = work.alignments("a", "b")
        path.parent.mkdir(parents=True)
        write_table(path, alignment_table(alignments), {})
        output = tmp_path / "judged.parquet"
        judge_town(work, tmp_path / "truth.json", "here", output)
        return output

    return judged


def test_a_town_is_judged_into_a_table_and_read_back(judge: Any) -> None:
    errors = [np.eye(4), yaw_transform(0.0, (2.0, 0, 0)), yaw_transform(0.0, (9.0, 0, 0))]
    table = judge(*(alignment(inverse(ROAD[2]) @ ROAD[1] @ error) for error in errors))
    assert read_table(table)["error_m"].to_pylist() == pytest.approx([0, 2, 9], abs=1e-6)
    back = read_judged([table] * 2)
    assert back.right.tolist() == [True, False, False] * 2
    assert back.clear.tolist() == [True, False, True] * 2
    np.testing.assert_allclose(back.placed.target_T_query[0], ROAD[1], atol=1e-9)
    np.testing.assert_allclose(back.placed.map_T_query[0], ROAD[1], atol=1e-12)
    assert (back.placed.road[0], back.placed.target_road[0], back.town[0]) == (2.0, 4.0, "here")
    assert back.placed.sigma[0] == pytest.approx(0.5)


def test_squared_errors_over_their_covariance_by_hand(judge: Any) -> None:
    """20 cm along x is two standard deviations, 20 cm across 0.4 of one, 0.02 rad two."""
    true = inverse(ROAD[2]) @ ROAD[1]
    alignments = []
    for off, turn in (((0.2, 0, 0), 0.0), ((0, 0.2, 0), 0.0), ((0, 0, 0), 0.02)):
        T = true.copy()
        T[:3, 3] += off
        T[:3, :3] = Rotation.from_rotvec([0, 0, turn]).as_matrix() @ T[:3, :3]
        alignments.append(alignment(T))
    back = read_judged([judge(*alignments)])
    np.testing.assert_allclose(back.nees_position, [4.0, 0.16, 0.0], atol=1e-5)
    np.testing.assert_allclose(back.nees_pose, [4.0, 0.16, 4.0], atol=1e-5)


def test_tables_that_are_missing_or_of_another_version_are_named(
    judge: Any, tmp_path: Path
) -> None:
    with pytest.raises(WorkspaceError, match="No town"):
        read_judged([])
    table = judge(alignment(inverse(ROAD[2]) @ ROAD[1]))
    old = tmp_path / "old.parquet"
    write_table(old, read_table(table).drop_columns(["covariance"]), {"voxel_size": 0.3})
    with pytest.raises(WorkspaceError, match=r"old\.parquet is of another version"):
        read_judged([table, old])


def test_what_the_truth_does_not_know_is_not_judged(judge: Any) -> None:
    true = inverse(ROAD[2]) @ ROAD[1]
    table = judge(alignment(true), alignment(true, stamp_ns=9 * 10**9))
    assert read_table(table)["right"].to_pylist() == [True, None]
    assert len(read_judged([table])) == 1


def test_normalised_squares_have_their_degrees_of_freedom_in_the_mean() -> None:
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(3, 3)) + 2 * np.eye(3)
    errors = rng.normal(size=(20000, 3)) @ factor.T
    squares = normalised_squares(errors, np.tile(factor @ factor.T, (20000, 1, 1)))
    assert squares.mean() == pytest.approx(3.0, abs=0.06)

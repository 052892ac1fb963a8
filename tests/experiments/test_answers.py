"""Answers are kept, resumed and read back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from semloc_logs.errors import SemlocError
from semloc_logs.experiments.answers import (
    Learner,
    Run,
    answer_scenario,
    pose_errors,
    read_answers,
)
from semloc_logs.experiments.scenarios import Scenario, heading_scenario
from semloc_logs.experiments.system import Query, RankedPose, View
from semloc_logs.experiments.views import ViewStore
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.tables import contracts
from semloc_logs.tables.table import read_table

Make = Callable[..., ViewStore]
EAST = [(float(x), 0.0, 0.0) for x in range(100)]
RUN = Run("nearest", "lidar", 1, "v1")


class Nearest:
    """Answers with the views whose only point is nearest to the query's: the truth, as points of
    these views are their places.
    """

    name = "nearest"

    def __init__(self, breaks_after: int = 10**9) -> None:
        self.fits = 0
        self.queries: list[str] = []
        self.breaks_after = breaks_after

    def fit(self, database: Sequence[View]) -> None:
        self.fits += 1
        self.poses = [view.world_T_base for view in database]
        self.points = np.array([view.points[0] for view in database])

    def localise(self, query: Query) -> list[RankedPose]:
        if len(self.queries) >= self.breaks_after:
            raise KeyboardInterrupt
        self.queries.append(query.name)
        assert np.isnan(query.views[-1].world_T_base).all()
        away = np.linalg.norm(self.points - query.views[-1].points[0], axis=1)
        order = np.argsort(away, kind="stable")[:3]
        return [RankedPose(self.poses[k], -float(away[k])) for k in order]


@pytest.fixture
def plan(make_store: Make) -> tuple[ViewStore, Scenario]:
    store = make_store(map=EAST, drive=[(x + 0.25, 0.0, 0.0) for x, _, _ in EAST])
    return store, heading_scenario(store, 0.0, ["map"], ["drive"])


def test_errors_are_metres_and_degrees() -> None:
    truth = yaw_transform(np.radians(30), (1.0, 2.0, 0.0))
    estimate = yaw_transform(np.radians(45), (4.0, 6.0, 0.0))
    assert pose_errors(truth, estimate) == pytest.approx((5.0, 15.0))


def test_answers_come_back_with_their_errors(
    plan: tuple[ViewStore, Scenario], tmp_path: Path
) -> None:
    store, scenario = plan
    assert answer_scenario(RUN, scenario, Learner(store, Nearest), tmp_path) == 100
    answers = read_answers(RUN, scenario, tmp_path)
    assert len(answers) == 100
    assert answers.first_m.tolist() == pytest.approx([0.25] * 100)
    assert np.isfinite(answers.errors_m).sum(axis=1).tolist() == [3] * 100
    assert answers.first_score.tolist() == pytest.approx([-0.25] * 100)
    assert sorted(set(answers.passage.tolist())) == [0, 1, 2, 3, 4]
    tables = [read_table(path) for path in tmp_path.glob("system=*/*/*.parquet")]
    assert tables
    assert all(table.schema.equals(contracts.schema("answers")) for table in tables)


def test_an_interrupted_run_continues(plan: tuple[ViewStore, Scenario], tmp_path: Path) -> None:
    store, scenario = plan
    broken = Nearest(breaks_after=30)
    with pytest.raises(KeyboardInterrupt):
        answer_scenario(RUN, scenario, Learner(store, lambda: broken), tmp_path)
    again = Nearest()
    assert answer_scenario(RUN, scenario, Learner(store, lambda: again), tmp_path) == 70
    assert not set(again.queries) & set(broken.queries)
    assert len(read_answers(RUN, scenario, tmp_path)) == 100

    idle = Nearest()
    assert answer_scenario(RUN, scenario, Learner(store, lambda: idle), tmp_path) == 0
    assert idle.fits == 0


def test_answers_are_written_on_the_way_too(
    plan: tuple[ViewStore, Scenario], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, scenario = plan
    monkeypatch.setattr("semloc_logs.experiments.answers.PART_S", -1.0)
    written: list[int] = []

    class Watching(Nearest):
        def localise(self, query: Query) -> list[RankedPose]:
            written.append(len(read_answers(RUN, scenario, tmp_path)))
            return super().localise(query)

    answer_scenario(RUN, scenario, Learner(store, Watching), tmp_path)
    assert written == list(range(100))


def test_another_version_of_a_system_answers_again(
    plan: tuple[ViewStore, Scenario], tmp_path: Path
) -> None:
    store, scenario = plan
    answer_scenario(RUN, scenario, Learner(store, Nearest), tmp_path)
    newer = Run("nearest", "lidar", 1, "v2")
    assert answer_scenario(newer, scenario, Learner(store, Nearest), tmp_path) == 100
    assert len(read_answers(newer, scenario, tmp_path)) == 100


def test_a_query_without_a_pose_is_an_answer(
    plan: tuple[ViewStore, Scenario], tmp_path: Path
) -> None:
    store, scenario = plan

    class Silent(Nearest):
        def localise(self, query: Query) -> list[RankedPose]:
            return []

    answer_scenario(RUN, scenario, Learner(store, Silent), tmp_path)
    answers = read_answers(RUN, scenario, tmp_path)
    assert len(answers) == 100
    assert np.isinf(answers.errors_m).all()
    assert (answers.first_score == -np.inf).all()
    assert answer_scenario(RUN, scenario, Learner(store, Silent), tmp_path) == 0


def test_a_pose_that_is_not_finite_is_refused(
    plan: tuple[ViewStore, Scenario], tmp_path: Path
) -> None:
    store, scenario = plan

    class Cheat(Nearest):
        def localise(self, query: Query) -> list[RankedPose]:
            return [RankedPose(query.views[-1].world_T_base, 1.0)]

    with pytest.raises(SemlocError, match="not a finite 4x4 matrix"):
        answer_scenario(RUN, scenario, Learner(store, Cheat), tmp_path)

"""What makes `close` work again: every input, and nothing else; and its closures against the truth,
at three headings.
"""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import semloc_logs
from semloc_logs.engines import Serial
from semloc_logs.errors import WorkspaceError
from semloc_logs.numerics.transforms import inverse, rotation_angle, transform
from semloc_logs.settings import Resolved
from semloc_logs.stages import close as close_stage
from semloc_logs.stages import describe as describe_stage
from semloc_logs.stages import fuse as fuse_stage
from semloc_logs.stages.close import Selection
from semloc_logs.stages.inputs import SessionInput
from semloc_logs.stages.report import Report
from semloc_logs.workspace import Workspace

Close = Callable[..., Report]


@pytest.fixture
def close(tools: SimpleNamespace, coarse: Workspace) -> Close:
    """Closes the workspace ``coarse``, where closures were found before, with whatever differs from
    then.
    """

    def again(
        queries: tuple[str, ...] = (),
        targets: tuple[str, ...] = (),
        settings: Resolved | None = None,
        self_closures: bool = True,
        overwrite: bool = False,
    ) -> Report:
        settings = settings or tools.coarse_settings()
        selection = Selection(queries, targets, self_closures)
        return close_stage.close(coarse, settings, Serial(), selection, overwrite=overwrite)

    return again


def was_done(report: Report) -> bool:
    assert (report.done, report.kept) in ((["closures"], []), ([], ["closures"]))
    return bool(report.done == ["closures"])


def test_nothing_is_done_twice(close: Close, coarse: Workspace, tools: SimpleNamespace) -> None:
    before = tools.write_times(coarse.path)
    report = close()
    assert not was_done(report)
    assert report.closures == pq.read_metadata(coarse.closures).num_rows > 0
    assert tools.write_times(coarse.path) == before


def test_overwriting_does_it_again(close: Close, coarse: Workspace, tools: SimpleNamespace) -> None:
    tables = tools.files(coarse.path)
    times = tools.write_times(coarse.path)
    assert was_done(close(overwrite=True))
    assert tools.files(coarse.path) == tables
    written = {name for name, time in tools.write_times(coarse.path).items() if time != times[name]}
    assert written == {"closures.parquet", "closures.png", "rejected.parquet"}


@pytest.mark.parametrize("missing", ["closures", "rejected"])
def test_a_missing_table_is_made_again(
    close: Close, coarse: Workspace, tools: SimpleNamespace, missing: str
) -> None:
    tables = tools.files(coarse.path)
    getattr(coarse, missing).unlink()
    assert was_done(close())
    assert tools.files(coarse.path) == tables


def test_other_words_of_a_session_are_closed(
    close: Close, coarse: Workspace, drives: Any, tools: SimpleNamespace
) -> None:
    """The settings stay; another log makes other words."""
    other = SessionInput("monday", (drives["wednesday"].log,))
    fuse_stage.fuse([other], coarse, tools.coarse_settings(), Serial())
    describe_stage.describe(coarse, [], tools.coarse_settings(), Serial())
    assert was_done(close())
    assert not was_done(close())


@pytest.mark.parametrize(
    "changed",
    [
        {"fusion__hit": "0.9"},
        {"labels__erode": "3"},
        {"descriptor__query_stride": "4"},
        {"query__frames": "3"},
        {"closures__min_probability": "0.5"},
    ],
)
def test_settings_are_inputs(close: Close, tools: SimpleNamespace, changed: dict[str, str]) -> None:
    settings = tools.coarse_settings(**changed)
    assert was_done(close(settings=settings))
    assert not was_done(close(settings=settings))


def test_settings_of_the_training_are_none(close: Close, tools: SimpleNamespace) -> None:
    assert not was_done(close(settings=tools.coarse_settings(training__seed="7")))


def test_the_version_is_an_input(close: Close, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(semloc_logs, "__version__", "999.0")
    assert was_done(close())


def test_closures_within_a_session_are_an_input(close: Close) -> None:
    assert was_done(close(self_closures=False))
    assert not was_done(close(self_closures=False))
    assert was_done(close(self_closures=True))


def test_queries_and_targets_are_inputs(close: Close) -> None:
    assert was_done(close(("monday",), ("tuesday", "monday")))
    assert was_done(close(("monday", "tuesday"), ("monday",))), (
        "the same names in the same order, but other queries"
    )
    assert not was_done(close(("monday", "tuesday"), ("monday",)))
    assert was_done(close(("monday", "tuesday"), ("tuesday",)))


def test_sessions_without_the_words_that_are_needed_are_named(
    close: Close, coarse: Workspace, drives: Any, tools: SimpleNamespace
) -> None:
    uniform = tools.coarse_settings(labels__source="uniform")
    fuse_stage.fuse(tools.inputs(drives, "wednesday"), coarse, uniform, Serial())
    with pytest.raises(WorkspaceError, match="Session monday lacks geometric and semantic words"):
        close()
    describe_stage.describe(coarse, ["wednesday"], uniform, Serial())
    with pytest.raises(WorkspaceError, match="Session monday lacks geometric and semantic words"):
        close()
    describe_stage.describe(coarse, [], tools.coarse_settings(), Serial())
    assert was_done(close())


@pytest.mark.parametrize("step", [0, 1, 2])
def test_interrupted_closing_is_done_again(
    step: int,
    close: Close,
    coarse: Workspace,
    tools: SimpleNamespace,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Interrupted at the first, second or third of the two tables and the picture, under other
    settings.
    """
    other = tools.coarse_settings(closures__probes="7")
    first = tools.files(coarse.path)
    assert tools.renames(monkeypatch, lambda: close(settings=other)) == 3
    second = tools.files(coarse.path)
    assert {name for name in first if first[name] != second[name]} == {
        "closures.parquet",
        "rejected.parquet",
    }
    tools.renames(monkeypatch, lambda: close(settings=other, overwrite=True), step)
    close(settings=other)
    assert tools.files(coarse.path) == second
    close()
    picture = coarse.picture.read_bytes()
    tools.renames(monkeypatch, lambda: close(settings=other), step)
    close()
    assert tools.files(coarse.path) == first, (
        "the old closures must not speak for the new rejections"
    )
    assert coarse.picture.read_bytes() == picture


# -- against the truth


@pytest.mark.parametrize("labels", ["labelled", "unlabelled"])
def test_closures_are_where_the_truth_is(
    labels: str, request: pytest.FixtureRequest, drives: Any
) -> None:
    """Monday goes east, Tuesday west, Wednesday north: every pair of headings is met, from both
    sides.
    """
    work: Workspace = request.getfixturevalue(labels)
    rows = pq.read_table(work.closures).to_pylist()
    turns = set()
    for row in rows:
        query = drives[row["query_session"]]
        target = drives[row["target_session"]]
        target_T_query = transform(
            np.array([row[f"t_{c}"] for c in "xyz"]), np.array([row[f"q_{c}"] for c in "xyzw"])
        )
        truth = inverse(target.world_T_base(row["target_stamp_ns"])) @ query.world_T_base(
            row["query_stamp_ns"]
        )
        wrong = inverse(truth) @ target_T_query
        assert np.linalg.norm(wrong[:3, 3]) < 0.05
        assert np.degrees(rotation_angle(wrong[:3, :3])) < 0.5
        turn = (
            round(float(np.degrees(np.arctan2(target_T_query[1, 0], target_T_query[0, 0])))) % 360
        )
        turns.add((query.name, target.name, 90 * round(turn / 90)))
    east_west = {("monday", "tuesday", 180), ("tuesday", "monday", 180)}
    north = {
        ("wednesday", "monday", 90),
        ("monday", "wednesday", 270),
        ("wednesday", "tuesday", 270),
        ("tuesday", "wednesday", 90),
    }
    assert turns <= east_west | north, "no closure within a drive, none at another heading"
    assert len({frozenset(pair[:2]) for pair in turns}) == 3
    assert len(rows) >= 9


def test_label_sources_are_written_down(labelled: Workspace, unlabelled: Workspace) -> None:
    from semloc_logs.tables.table import read_metadata

    assert read_metadata(labelled.closures)["label_source"] == "log"
    assert read_metadata(unlabelled.closures)["label_source"] == "geometry"

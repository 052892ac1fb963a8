"""What makes `close` work again: every input, and nothing else; and its closures against the truth,
at three headings.
"""

import contextlib
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import semloc_logs
from semloc_logs.closures import search_tasks
from semloc_logs.closures.query import query_keyframes
from semloc_logs.closures.search_tasks import search_queries
from semloc_logs.engines import Serial
from semloc_logs.errors import WorkspaceError
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse, rotation_angle, transform
from semloc_logs.settings import Resolved
from semloc_logs.stages import close as close_stage
from semloc_logs.stages import describe as describe_stage
from semloc_logs.stages import fuse as fuse_stage
from semloc_logs.stages import pair_search
from semloc_logs.stages import run as run_stage
from semloc_logs.stages.inputs import Redo, SessionInput
from semloc_logs.stages.pair_search import Selection
from semloc_logs.stages.report import Report
from semloc_logs.tables.table import read_json, read_metadata, write_json
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
    alignments = {name for name in written if name.startswith("alignments/")}
    assert written - alignments == {"closures.parquet", "closures.png", "rejected.parquet"}
    assert alignments == {name for name in tables if name.startswith("alignments/")}


def test_all_queries_are_decided_together(
    close: Close, coarse: Workspace, tools: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Queries without alignments count, too; closures nearer than two queries are one."""
    settings = tools.coarse_settings()
    maps = {name: SessionMap(coarse.session(name)) for name in ("monday", "tuesday")}
    queries = {name: query_keyframes(one, settings) for name, one in maps.items()}
    given: dict[str, Any] = {}

    def spy(name: str, place: int) -> Callable[..., Any]:
        real = vars(close_stage)[name]

        def spied(*args: Any) -> Any:
            given[name] = args[place]
            return real(*args)

        return spied

    for name, place in (("decide", 3), ("unique_closures", 2)):
        monkeypatch.setattr(close_stage, name, spy(name, place))
    assert was_done(close(overwrite=True))
    assert given == {"decide": queries, "unique_closures": 8.0}
    assert read_metadata(coarse.closures)["queries"] == sum(map(len, queries.values()))


def test_a_session_that_does_not_fit_any_more_loses_its_closures(
    close: Close, coarse: Workspace
) -> None:
    """Its alignments stay: it may be searched all the same."""
    coarse.settings.unlink()
    path = coarse.session("monday").session_json
    write_json(path, read_json(path) | {"fit": {"track": "its poses jump", "streams": []}})
    report = close(overwrite=True)
    assert [sentence.split(":")[0] for sentence in report.skipped] == [
        "Session monday gets no closures"
    ]
    for table in (coarse.closures, coarse.rejected):
        rows = pq.read_table(table).to_pylist()
        assert {row[f"{end}_session"] for row in rows for end in ("query", "target")} <= {"tuesday"}
    assert coarse.alignments("tuesday", "monday").exists()
    assert coarse.settings.exists()  # closing keeps the settings that it was done with


@pytest.mark.parametrize("name", ["closures", "rejected", "alignments"])
@pytest.mark.parametrize("is_damaged", [False, True])
def test_a_missing_or_damaged_table_is_made_again(
    close: Close, coarse: Workspace, tools: SimpleNamespace, name: str, is_damaged: bool
) -> None:
    tables = tools.files(coarse.path)
    path = getattr(coarse, name)
    path = path("tuesday", "monday") if name == "alignments" else path
    path.write_bytes(path.read_bytes()[:-9]) if is_damaged else path.unlink()
    close()
    assert tools.files(coarse.path) == tables


def test_other_words_of_a_session_are_closed(
    close: Close, coarse: Workspace, drives: Any, tools: SimpleNamespace
) -> None:
    """The settings stay; another log makes other words."""
    other = SessionInput("monday", (drives["wednesday"].log,))
    fuse_stage.fuse([other], coarse, tools.coarse_settings(), Serial(), redo=Redo.EVERYTHING)
    with pytest.raises(WorkspaceError, match="monday lacks semantic words of its present map"):
        close()
    describe_stage.describe(coarse, [], tools.coarse_settings(), Serial())
    assert was_done(close())
    assert not was_done(close())


@pytest.mark.parametrize(
    "changed",
    [
        {"labels__erode": "3"},
        {"query__frames": "3"},
        {"closures__kappa": "9"},
        {"closures__min_probability": "0.5"},
    ],
)
def test_settings_are_inputs(close: Close, tools: SimpleNamespace, changed: dict[str, str]) -> None:
    settings = tools.coarse_settings(**changed)
    assert was_done(close(settings=settings))
    assert not was_done(close(settings=settings))


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"fusion__hit": "0.9"}, r"was fused with fusion\.hit=0\.85"),
        ({"descriptor__query_stride": "4"}, "lacks semantic words of its present map and settings"),
    ],
)
def test_maps_and_words_of_other_settings_are_refused(
    close: Close,
    coarse: Workspace,
    tools: SimpleNamespace,
    changed: dict[str, str],
    sentence: str,
) -> None:
    before = tools.files(coarse.path)
    with pytest.raises(WorkspaceError, match=sentence):
        close(settings=tools.coarse_settings(**changed))
    assert tools.files(coarse.path) == before


def test_settings_of_the_training_are_none(close: Close, tools: SimpleNamespace) -> None:
    assert not was_done(close(settings=tools.coarse_settings(training__seed="7")))


def test_the_version_is_an_input(close: Close, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(semloc_logs, "__version__", "999.0")
    with pytest.raises(WorkspaceError, match="lacks semantic words"):
        close()


def test_the_decision_alone_is_made_again_for_another_probability(
    close: Close, coarse: Workspace, tools: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = tools.files(coarse.path)
    monkeypatch.setattr(pair_search, "search_queries", None)
    assert was_done(close(settings=tools.coarse_settings(closures__min_probability="0.5")))
    changed = {n for n, digest in tools.files(coarse.path).items() if before.get(n) != digest}
    assert changed == {"closures.parquet", "rejected.parquet", "workspace.json"}


# -- pairs of sessions


def searched(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """The pairs whose queries are searched from now on."""
    pairs: list[tuple[str, str]] = []
    search = search_queries

    def counted(task: Any) -> int:
        pairs.extend((task.session, target) for target in task.targets)
        return search(task)

    monkeypatch.setattr(pair_search, "search_queries", counted)
    return pairs


def test_a_new_session_is_searched_and_nothing_else(
    close: Close,
    coarse: Workspace,
    drives: Any,
    tools: SimpleNamespace,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Wednesday after the others, and before them: the same bytes as all at once."""
    pairs = searched(monkeypatch)
    all_at_once = tools.whole(tmp_path / "all", drives, tools.coarse_settings())
    assert len(set(pairs)) == 6
    days = list(drives)
    assert {(q, t) for q, t in pairs if days.index(q) < days.index(t)} == set()
    pairs.clear()

    def add(work: Workspace, *names: str) -> None:
        inputs = tools.inputs(drives, *names)
        run_stage.run(inputs, work, tools.coarse_settings(), Serial())
        work.summary.unlink()

    add(coarse, "wednesday")
    assert set(pairs) == {("wednesday", target) for target in days}
    other_way = Workspace(tmp_path / "other")
    for name in ("wednesday", "tuesday", "monday"):
        add(other_way, name)
    assert tools.files(coarse.path) == tools.files(all_at_once.path)
    assert tools.files(other_way.path) == tools.files(all_at_once.path)


def test_a_log_under_two_names_is_told(close: Close, coarse: Workspace) -> None:
    """Its closures are kept, but of a drive with itself they show nothing."""
    assert not [text for text in close().skipped if "one recording" in str(text)]
    again = coarse.session("again")
    shutil.copytree(coarse.session("monday").path, again.path)
    write_json(again.session_json, read_json(again.session_json) | {"name": "again"})
    [text] = [str(text) for text in close().skipped if "one recording" in str(text)]
    assert text.startswith("Sessions again and monday are of one recording")


def test_a_selection_restricts_what_is_searched_and_never_what_is_known(
    close: Close, coarse: Workspace, tools: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = tools.files(coarse.path)
    pairs = searched(monkeypatch)
    for selection in ((("monday",), ("tuesday",)), (("tuesday",), ()), ((), ("monday",))):
        assert not was_done(close(*selection))
        assert not was_done(close(*selection, self_closures=False))
    assert tools.files(coarse.path) == before

    shutil.rmtree(coarse.path / "alignments")
    assert was_done(close(("monday",), ("tuesday",))), "in either direction"
    assert set(pairs) == {("tuesday", "monday")}
    pairs.clear()
    close(self_closures=False)
    assert pairs == []
    close()
    assert set(pairs) == {("monday", "monday"), ("tuesday", "tuesday")}
    assert tools.files(coarse.path) == before


def test_alignments_of_a_session_that_is_gone_are_forgotten(
    close: Close, coarse: Workspace, drives: Any, tools: SimpleNamespace
) -> None:
    shutil.rmtree(coarse.session("tuesday").path)
    assert was_done(close())
    left = sorted(str(p.parent) for p in (coarse.path / "alignments").rglob("*.parquet"))
    assert left == [str(coarse.alignments("monday", "monday").parent)]
    assert pq.read_metadata(coarse.closures).num_rows == 0


def test_a_search_goes_on_at_the_task_it_was_at(
    close: Close, coarse: Workspace, tools: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed in every task once: each task is done once, and the tables are the same."""
    for module in (pair_search, search_tasks):
        monkeypatch.setattr(module, "block_size", lambda _: 1)  # tasks hold whole blocks
    shutil.rmtree(coarse.path / "alignments")
    close()
    before = tools.files(coarse.path)
    shutil.rmtree(coarse.path / "alignments")
    monkeypatch.setattr(pair_search, "QUERIES_A_TASK", 1)
    search = search_queries
    tasks: list[Any] = []

    def interrupted(task: Any) -> int:
        if task not in tasks:
            tasks.append(task)
            search(task)
            raise KeyboardInterrupt
        pytest.fail("a finished task is done again")

    monkeypatch.setattr(pair_search, "search_queries", interrupted)
    for _ in range(50):
        with contextlib.suppress(KeyboardInterrupt):
            close()
            break
    assert len(tasks) > 3
    assert tools.files(coarse.path) == before
    assert not (coarse.path / ".parts" / "tuesday").exists()


def test_sessions_without_the_words_that_are_needed_are_named(
    close: Close, coarse: Workspace, drives: Any, tools: SimpleNamespace
) -> None:
    uniform = tools.coarse_settings(labels__source="uniform")
    fuse_stage.fuse(tools.inputs(drives, "wednesday"), coarse, uniform, Serial())
    with pytest.raises(WorkspaceError, match="Session monday lacks geometric words"):
        close()
    describe_stage.describe(coarse, ["wednesday"], uniform, Serial())
    with pytest.raises(WorkspaceError, match="Session monday lacks geometric words"):
        close()
    assert not was_done(close(("monday",), ("tuesday",))), "this pair needs none"
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
    other = tools.coarse_settings(closures__min_probability="0.9")
    first = tools.files(coarse.path)
    assert tools.renames(monkeypatch, lambda: close(settings=other)) == 4  # and workspace.json
    second = tools.files(coarse.path)
    step += 1
    assert {name for name in first if first[name] != second[name]} == {
        "closures.parquet",
        "rejected.parquet",
        "workspace.json",
    }
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

"""`semloc benchmark paper`: every system on the same queries of every scenario.

A folder keeps logs, maps, pictures, answers, and what systems have trained; a run that was
interrupted continues there.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from semloc_logs.engines import Engine, make_engine
from semloc_logs.errors import SemlocError, SettingsError
from semloc_logs.evaluation.truth import read_truth
from semloc_logs.experiments.answers import Learner, Run, answer_scenario, read_answers
from semloc_logs.experiments.figure import draw_figure
from semloc_logs.experiments.log_views import (
    SENSORS,
    Recorded,
    fused_views,
    recorded_logs,
    simulated_logs,
)
from semloc_logs.experiments.orderings import findings
from semloc_logs.experiments.pair_lists import pair_scenario, read_pairs
from semloc_logs.experiments.scenarios import (
    Extent,
    Scenario,
    heading_scenario,
    time_scenario,
)
from semloc_logs.experiments.simulated_drives import (
    AGAIN,
    BACK,
    MAP,
    Town,
    drives_version,
    full_town,
    quick_town,
    time_session,
)
from semloc_logs.experiments.summary_table import Outcome, Row, to_json, to_markdown
from semloc_logs.experiments.system_version import module_version
from semloc_logs.experiments.systems.catalogue import (
    BASELINES,
    MODULES,
    Entry,
    SystemOptions,
    entries,
    make_system,
)
from semloc_logs.experiments.views import ViewStore
from semloc_logs.settings import Resolved
from semloc_logs.tables.atomic_files import replacing_file
from semloc_logs.tables.table import write_json

ANSWERS = "answers"  # folder of a run
HEADINGS_DEG = 0.0, 90.0, 180.0
QUICK = Extent(per_passage=1, most=1)
FULL = Extent(most=120)

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class PaperRequest:
    """Which experiments: ``folder`` of the run; ``systems``: names, all without; ``quick``: a small
    simulated scene; ``logs`` with their ``truth`` instead of simulated ones; ``queries``: the most
    of a scenario; ``sensors`` and ``scenarios``: names, all without; ``weights``: a folder of
    trained networks; ``only_tables``: of the answers that are there, while others are missing;
    ``pairs``: a list of frames of ``logs`` to be registered, a scenario more.
    """

    settings: Resolved
    folder: Path
    systems: Sequence[str] = ()
    quick: bool = False
    logs: Sequence[Path] = ()
    truth: Path | None = None
    queries: int | None = None
    sensors: Sequence[str] = ()
    scenarios: Sequence[str] = ()
    jobs: int | None = None
    weights: Path | None = None
    only_tables: bool = False
    note: Callable[[str], None] = lambda _: None
    pairs: Path | None = None


@dataclass(frozen=True, slots=True)
class PaperFiles:
    """What a run has written."""

    table: Path
    json: Path
    figures: list[Path] = field(default_factory=list)
    answers: Path = Path()


def run_paper(request: PaperRequest) -> PaperFiles:
    """Run the experiments and write tables and figures.

    SettingsError for unknown names, logs without truth; SemlocError when a log cannot be used. A
    system that fails is a row that tells why, and the others go on.
    """
    chosen = entries(request.systems)
    for name in request.sensors:
        if name not in SENSORS:
            raise SettingsError(f"Unknown sensor '{name}': there are {', '.join(SENSORS)}.")
    if bool(request.logs) != (request.truth is not None):
        raise SettingsError("Benchmark paper takes logs and --truth FILE, or neither.")
    if request.pairs is not None and request.truth is None:
        raise SettingsError("A list of --pairs needs its logs and --truth FILE.")
    engine = make_engine("processes", request.jobs)
    try:
        stores, scenarios = _prepared(request, engine)
        return run_systems(request, chosen, stores, scenarios, engine)
    except BaseException:
        engine.stop()
        raise
    finally:
        engine.close()


def _prepared(
    request: PaperRequest, engine: Engine
) -> tuple[dict[str, ViewStore], dict[str, list[Scenario]]]:
    """The views and scenarios of every sensor."""
    town: Town | None = None
    if request.truth is not None:
        recorded = recorded_logs(request.logs, request.truth)
    else:
        town = quick_town() if request.quick else full_town()
        request.note(f"Simulating {len(town.drives)} drives ...")
        recorded = simulated_logs(town, request.folder / "logs" / _scene(request), engine)
    stores: dict[str, ViewStore] = {}
    scenarios: dict[str, list[Scenario]] = {}
    for sensor in request.sensors or SENSORS:
        try:
            stores[sensor] = _views(request, recorded, sensor, engine)
        except SemlocError as problem:
            if town is not None or len(request.sensors or SENSORS) == 1:
                raise
            request.note(f"No views by {sensor}: {problem}")
            continue
        scenarios[sensor] = _scenarios(request, stores[sensor], town)
    if not stores:
        raise SemlocError("None of the logs gave views: name their topics or another log.")
    return stores, scenarios


def _scene(request: PaperRequest) -> str:
    """The name of the scene in the folder of the run; another one for other code of the drives."""
    if request.truth is not None:
        return "own"
    return f"{'quick' if request.quick else 'full'}-{drives_version()}"


def _views(request: PaperRequest, recorded: Recorded, sensor: str, engine: Engine) -> ViewStore:
    folder = request.folder / "maps" / _scene(request)
    return fused_views(recorded, sensor, folder, request.settings, engine)


def _scenarios(request: PaperRequest, store: ViewStore, town: Town | None) -> list[Scenario]:
    """The scenarios of a store: all sessions in all others where the logs are the user's."""
    extent = QUICK if request.quick else FULL
    if request.queries is not None:
        extent = Extent(min(extent.per_passage, request.queries), request.queries)
    if town is None:
        database: Sequence[str] = store.names
        queries: Sequence[str] = store.names
        pairs = [
            (f"{one}>{other}", one, other)
            for one in store.names
            for other in store.names
            if one != other
        ]
    else:
        database = [MAP]
        queries = [AGAIN, BACK]
        pairs = [
            (
                f"{one.name}>{other.name}",
                time_session(one, is_query=False),
                time_session(other, is_query=True),
            )
            for one, other in town.pairs
        ]
    out = [heading_scenario(store, h, database, queries, extent) for h in HEADINGS_DEG]
    out += [time_scenario(store, name, one, other, extent) for name, one, other in pairs]
    if request.pairs is not None and request.truth is not None:
        sessions = {s.session.folder.name: s.session for s in store.sessions}
        tracks = read_truth(request.truth, sessions)
        frames_ns = {name: track.stamps_ns for name, track in tracks.items()}
        out.append(pair_scenario(store, read_pairs(request.pairs), frames_ns))
    out = [scenario for scenario in out if scenario.trials]
    wanted = set(request.scenarios)
    unknown = wanted - {scenario.name for scenario in out}
    if unknown:
        raise SettingsError(
            f"Unknown scenario '{min(unknown)}': "
            f"there are {', '.join(scenario.name for scenario in out)}."
        )
    return [s for s in out if not wanted or s.name in wanted]


def run_systems(
    request: PaperRequest,
    chosen: Sequence[Entry],
    stores: Mapping[str, ViewStore],
    scenarios: Mapping[str, Sequence[Scenario]],
    engine: Engine | None = None,
) -> PaperFiles:
    """Answer the open queries, then write the tables and figures of all answers.

    A system is a task of the ``engine``; without one they follow each other in this process.
    """
    tasks = [_SystemTask(entry, stores, scenarios, request) for entry in chosen]
    outcomes: Iterable[dict[str, str]] = ({} for _ in tasks)
    if not request.only_tables:
        engine = engine or make_engine("serial")
        outcomes = engine.map(_answer_all, [task.lean() for task in tasks])
    rows = []
    for task, not_run in zip(tasks, outcomes, strict=True):
        row = Row(task.entry.name, task.entry.title, task.entry.remark, not_run=not_run)
        for sensor, reason in not_run.items():
            request.note(f"{task.entry.title}, {sensor}: {reason}")
        for sensor in stores:
            for scenario in scenarios[sensor]:
                answers = read_answers(task.run(sensor), scenario, request.folder / ANSWERS)
                if len(answers):
                    row.answers[sensor, scenario.name] = answers
        rows.append(row)
    known = {
        (row.name, sensor, scenario): answers
        for row in rows
        for (sensor, scenario), answers in row.answers.items()
    }
    rivals = [entry.name for entry in BASELINES]
    outcome = Outcome(rows, scenarios, stores, findings(known, rivals), request.quick)
    return _write(request.folder, outcome)


@dataclass(frozen=True, eq=False)
class _SystemTask:
    """A system on all scenarios of all sensors; picklable when it is :meth:`lean`."""

    entry: Entry
    stores: Mapping[str, ViewStore]
    scenarios: Mapping[str, Sequence[Scenario]]
    request: PaperRequest

    def lean(self) -> _SystemTask:
        """The task without the listener of the request."""
        return replace(self, request=replace(self.request, note=_silent))

    def run(self, sensor: str) -> Run:
        """Names and version of the system on a sensor."""
        version = module_version(f"{MODULES}.{self.entry.made_by.partition(':')[0]}")
        return Run(self.entry.name, sensor, self.entry.frames, version)


def _silent(_: str) -> None:
    """Notes of tasks are made where they return."""


def _answer_all(task: _SystemTask) -> dict[str, str]:
    """Answer the open queries of a system; why it could not, by sensor."""
    folder = task.request.folder / "systems" / task.entry.name
    folder.mkdir(parents=True, exist_ok=True)
    request = task.request
    options = SystemOptions(
        request.settings,
        folder,
        request.quick,
        name=task.entry.name,
        weights=request.weights,
    )
    reasons = {sensor: _answer_sensor(task, sensor, options) for sensor in task.stores}
    return {sensor: reason for sensor, reason in reasons.items() if reason}


def _answer_sensor(task: _SystemTask, sensor: str, options: SystemOptions) -> str:
    """Answer the open queries of a sensor; why it could not, or "" where it could."""
    entry = task.entry
    store = task.stores[sensor]
    if entry.needs_pictures and not store.has_pictures:
        return "it works on pictures, and the logs have no calibrated camera."
    if not entry.needs_pictures:
        store = store.without_pictures()
    learner = Learner(store, partial(make_system, entry, options))
    try:
        for scenario in task.scenarios[sensor]:
            answers = task.request.folder / ANSWERS
            answer_scenario(task.run(sensor), scenario, learner, answers)
    except SemlocError as problem:
        return str(problem)
    except Exception as problem:  # one system must not end a run of hours
        _log.exception("%s failed", entry.title)
        return f"it failed: {type(problem).__name__}: {problem}"
    return ""


def _write(folder: Path, outcome: Outcome) -> PaperFiles:
    """Tables and figures of a run."""
    table = folder / "table.md"
    with replacing_file(table) as temporary:
        temporary.write_text(to_markdown(outcome), encoding="utf-8")
    content = folder / "table.json"
    write_json(content, to_json(outcome))
    figures = []
    for sensor in outcome.stores:
        if any(s == sensor for row in outcome.rows for s, _ in row.answers):
            path = folder / f"figure_{sensor}.png"
            draw_figure(outcome, sensor, path)
            figures.append(path)
    return PaperFiles(table, content, figures, folder / ANSWERS)

"""Every answer of every system as Parquet. A run that was interrupted continues where it stopped,
and new measures need no new run.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from semloc_logs import progress
from semloc_logs.arrays import F64
from semloc_logs.errors import SemlocError, WorkspaceError
from semloc_logs.experiments.kept_files import Spent, cpu_seconds, measured
from semloc_logs.experiments.scenarios import PlannedQuery, Scenario, Trial, query_views
from semloc_logs.experiments.system import MOST_POSES, Query, RankedPose, System
from semloc_logs.experiments.views import ViewStore
from semloc_logs.numerics.transforms import inverse, rotation_angle
from semloc_logs.stages.inputs import fingerprint_of
from semloc_logs.tables import contracts
from semloc_logs.tables.metadata import SCHEMA_VERSION
from semloc_logs.tables.table import read_metadata, read_table, write_table
from semloc_logs.voxels.store import POSE, pose_columns

TABLE = "answers"
PART_S = 60.0  # of wall time after which the answers so far are written
_SORTING = ("query", "rank")


@dataclass(frozen=True, slots=True)
class Run:
    """One system on one scenario: ``system`` and ``sensor`` are names, ``frames`` the views of a
    query, ``version`` changes when the system's code does.
    """

    system: str
    sensor: str
    frames: int
    version: str

    def folder(self, answers: Path, scenario: Scenario) -> Path:
        """The folder of its answers."""
        name = f"{self.sensor}-{scenario.name.replace('>', '-in-')}"
        return answers / f"system={self.system}" / name


@dataclass(eq=False)
class Learner:
    """Systems that ``make`` makes, fitted to databases of a ``store``.

    The latest one is kept: scenarios that follow each other may share their database.
    """

    store: ViewStore
    make: Callable[[], System]

    def __post_init__(self) -> None:
        self._latest: tuple[bytes, System] | None = None

    def fitted(self, database: NDArray[np.int64]) -> tuple[System, Spent]:
        """The system that has learnt the views of these numbers, and the CPU time that took now."""
        key = database.tobytes()
        if self._latest is not None and self._latest[0] == key:
            return self._latest[1], Spent()
        self._latest = None  # two of them may not fit into memory
        with measured() as spent:
            system = self.make()
            system.fit(self.store.selection(database))
        self._latest = (key, system)
        return system, spent


def answer_scenario(run: Run, scenario: Scenario, learner: Learner, answers: Path) -> int:
    """Answer the queries that have no answer yet; their number.

    The system is made and fitted only for trials with open queries. Whatever it raises is passed
    on; the answers before it are kept.
    """
    store = learner.store
    folder = run.folder(answers, scenario)
    answered = 0
    total = len(scenario.queries)
    done = 0
    for trial in scenario.trials:
        parts = _Parts(run, scenario, trial, store, folder)
        left = parts.left()
        done += len(trial.queries) - len(left)
        if left:
            system, parts.fit = learner.fitted(trial.database)
            name = f"{run.system}, {run.sensor} {scenario.name}"
            try:
                for query in left:
                    parts.add(query, _localised(system, query, run.frames, store))
                    done += 1
                    answered += 1
                    progress.report("benchmark", name, done, total, "queries")
            finally:
                parts.write()
    return answered


@dataclass(frozen=True, slots=True, eq=False)
class _Answered:
    """The poses of a query and its CPU time."""

    poses: list[RankedPose]
    cpu_s: float


def _localised(system: System, query: PlannedQuery, frames: int, store: ViewStore) -> _Answered:
    views = tuple(store.hidden(view) for view in query_views(store, query.view, frames))
    started = cpu_seconds()
    poses = system.localise(Query(query.name, views))
    spent = cpu_seconds() - started
    for number, pose in enumerate(poses):
        if np.shape(pose.world_T_base) != (4, 4) or not np.isfinite(pose.world_T_base).all():
            raise SemlocError(
                f"{system.name} gave a pose that is not a finite 4x4 matrix "
                f"for {query.name}, rank {number + 1}."
            )
    return _Answered(list(poses[:MOST_POSES]), spent)


@dataclass(eq=False)
class _Parts:
    """The files of a trial's answers."""

    run: Run
    scenario: Scenario
    trial: Trial
    store: ViewStore
    folder: Path
    fit: Spent = field(default_factory=Spent)

    def __post_init__(self) -> None:
        self._rows: list[tuple[PlannedQuery, _Answered]] = []
        self._last = time.monotonic()
        self._made_from = self._fingerprint()

    def _fingerprint(self) -> str:
        """What the answers depend on: the system's version and the views of the database."""
        store = self.store
        views = [
            f"{store.names[s]}@{stamp}"
            for s, stamp in zip(
                store.session_of[self.trial.database].tolist(),
                store.stamps_ns[self.trial.database].tolist(),
                strict=True,
            )
        ]
        run = self.run
        return fingerprint_of([run.system, run.sensor, str(run.frames), run.version, *views])

    def left(self) -> list[PlannedQuery]:
        """Queries without an answer. Files of another version are removed."""
        known: set[str] = set()
        for path in _files(self.folder, self.trial.name):
            if _is_of(path, self._made_from):
                known |= set(read_table(path, ["query"])["query"].to_pylist())
            else:
                path.unlink()
        return [query for query in self.trial.queries if query.name not in known]

    def add(self, query: PlannedQuery, answered: _Answered) -> None:
        """Take the answer to a query; write a file when the last one is old."""
        self._rows.append((query, answered))
        if time.monotonic() - self._last > PART_S:
            self.write()

    def write(self) -> None:
        """Write the answers that are in no file yet."""
        if not self._rows:
            return
        number = len(_files(self.folder, self.trial.name))
        path = self.folder / f"{self.trial.name}-{number:04d}.parquet"
        metadata = {
            "schema_version": SCHEMA_VERSION,
            "made_from": self._made_from,
            "fit_cpu_s": self.fit.cpu_s,
            "kept_cpu_s": self.fit.kept_s,
            "database_views": len(self.trial.database),
        }
        write_table(path, self._table(), metadata, _SORTING)
        self.fit = Spent()
        self._rows = []
        self._last = time.monotonic()

    def _table(self) -> pa.Table:
        rows = sorted(self._rows, key=lambda row: row[0].name)
        tables = [self._columns(query, answered) for query, answered in rows]
        return contracts.table(
            TABLE, {name: np.concatenate([t[name] for t in tables]) for name in tables[0]}
        )

    def _columns(self, query: PlannedQuery, answered: _Answered) -> dict[str, NDArray[Any]]:
        """The columns of one query."""
        truth = self.store.world_T_base[query.view]
        poses = np.array([p.world_T_base for p in answered.poses], float).reshape(-1, 4, 4)
        count = max(1, len(poses))
        if len(poses):
            rank = np.arange(1, count + 1)
            score = np.array([p.score for p in answered.poses], float)
            errors = np.array([pose_errors(truth, pose) for pose in poses])
            pose_values = pose_columns(poses)
        else:
            rank = np.zeros(1, int)
            score = np.full(1, np.nan)
            errors = np.full((1, 2), np.nan)
            pose_values = {name: np.full(1, np.nan) for name in POSE}
        return {
            "system": np.full(count, self.run.system),
            "sensor": np.full(count, self.run.sensor),
            "scenario": np.full(count, self.scenario.name),
            "trial": np.full(count, self.trial.name),
            "query": np.full(count, query.name),
            "passage": np.full(count, query.passage),
            "rank": rank,
            "score": score,
            "error_m": errors[:, 0],
            "error_deg": errors[:, 1],
            "cpu_s": np.full(count, answered.cpu_s),
            **pose_values,
            **{f"true_{c}": np.full(count, truth[k, 3]) for k, c in enumerate("xyz")},
        }


def pose_errors(truth: F64, pose: F64) -> tuple[float, float]:
    """Metres and degrees between two poses (4, 4)."""
    rest = inverse(truth) @ pose
    metres = float(np.linalg.norm(pose[:3, 3] - truth[:3, 3]))
    return metres, float(np.degrees(rotation_angle(rest[:3, :3])))


def _files(folder: Path, trial: str) -> list[Path]:
    return sorted(folder.glob(f"{trial}-*.parquet"))


def _is_of(path: Path, made_from: str) -> bool:
    try:
        return read_metadata(path).get("made_from") == made_from
    except WorkspaceError:
        return False


@dataclass(frozen=True, eq=False)
class Answers:
    """The answers of one system to one scenario, queries (q,) by name, ranks (r,) to MOST_POSES.

    ``errors_m``, ``errors_deg`` (q, r) are infinite, ``score`` (q, r) is -inf and ``positions`` (q,
    r, 3) are NaN where a pose is missing. ``truth`` (q, 3) are the true positions, ``trial`` (q,)
    names of trials, ``passage`` (q,), ``cpu_s`` (q,); ``fit`` is the time of the databases.
    """

    queries: list[str]
    errors_m: F64
    errors_deg: F64
    score: F64
    positions: F64
    truth: F64
    trial: list[str]
    passage: NDArray[np.int64]
    cpu_s: F64
    fit: Spent = field(default_factory=Spent)

    def __len__(self) -> int:
        return len(self.queries)

    @property
    def first_m(self) -> F64:
        """Errors (q,) of the first pose."""
        return self.errors_m[:, 0]

    @property
    def first_score(self) -> F64:
        """Scores (q,) of the first pose."""
        return self.score[:, 0]

    def of_trial(self, name: str) -> NDArray[np.int64]:
        """Which queries are of a trial."""
        return np.flatnonzero([trial == name for trial in self.trial])


def read_answers(run: Run, scenario: Scenario, answers: Path) -> Answers:
    """The answers of a run so far, in the order of their names."""
    folder = run.folder(answers, scenario)
    tables: list[pa.Table] = []
    fit = Spent()
    for trial in scenario.trials:
        for path in _files(folder, trial.name):
            tables.append(read_table(path))
            metadata = read_metadata(path)
            fit.cpu_s += float(metadata["fit_cpu_s"])
            fit.kept_s |= metadata.get("kept_cpu_s", {})
    return answers_of(tables, fit)


def answers_of(tables: Sequence[pa.Table], fit: Spent | None = None) -> Answers:
    """The answers in ``tables`` of one system and scenario."""
    table = pa.concat_tables([contracts.schema(TABLE).empty_table(), *tables])
    names = table["query"].to_pylist()
    queries = sorted(set(names))
    row = {name: k for k, name in enumerate(queries)}
    owner = np.array([row[name] for name in names], np.int64)
    rank = table["rank"].to_numpy()
    is_answered = rank > 0
    place = (owner[is_answered], rank[is_answered] - 1)
    count = len(queries)

    def by_rank(column: str, missing: float) -> F64:
        out = np.full((count, MOST_POSES), missing)
        out[place] = table[column].to_numpy()[is_answered]
        return out

    trial = [""] * count
    for name, number in zip(table["trial"].to_pylist(), owner.tolist(), strict=True):
        trial[number] = name
    return Answers(
        queries=queries,
        errors_m=by_rank("error_m", np.inf),
        errors_deg=by_rank("error_deg", np.inf),
        score=by_rank("score", -np.inf),
        positions=np.stack([by_rank(f"t_{c}", np.nan) for c in "xyz"], axis=2),
        truth=np.stack([_by_query(table, f"true_{c}", owner, count) for c in "xyz"], axis=1),
        trial=trial,
        passage=_by_query(table, "passage", owner, count).astype(np.int64),
        cpu_s=_by_query(table, "cpu_s", owner, count),
        fit=fit or Spent(),
    )


def _by_query(table: pa.Table, column: str, owner: NDArray[np.int64], count: int) -> F64:
    out = np.zeros(count)
    out[owner] = table[column].to_numpy()
    return out

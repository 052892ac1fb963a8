"""What a command would do, and for how long about; nothing is written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semloc_logs.closures.exclusions import Exclusions
from semloc_logs.closures.query import query_keyframes
from semloc_logs.closures.session_pairs import known_pairs
from semloc_logs.errors import SemlocError, WorkspaceError
from semloc_logs.logs.containers.open import open_log
from semloc_logs.mapping.session_fusion import FuseTask
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import Resolved
from semloc_logs.stages.describe import plan_describe
from semloc_logs.stages.fuse import plan_fuse
from semloc_logs.stages.inputs import Redo, SessionInput
from semloc_logs.stages.pair_search import (
    EVERYTHING,
    PairSearch,
    Selection,
    pair_fingerprints,
)
from semloc_logs.tables.table import read_json
from semloc_logs.workspace import Workspace

# seconds of one worker for a unit of work, on a core of 2024: they stand in until `semloc run` has
# measured them in the workspace
USUAL_RATES = {"fuse": 0.5, "describe": 3.0, "close": 0.1}
UNITS = {"fuse": "s of log", "describe": "submaps", "close": "searches"}
USUAL_SPEED = 8.0  # m/s: road of a log that is not read yet


@dataclass(frozen=True, slots=True)
class PlannedStage:
    """The sessions, or pairs of sessions, that a stage has to do of ``total``.

    ``amount`` of work in units of the stage, and the ``seconds`` that one worker takes.
    """

    stage: str
    todo: tuple[str, ...]
    total: int
    amount: float
    unit: str
    seconds: float


@dataclass(frozen=True, slots=True)
class _Coming:
    """A session that will be fused: when it was recorded, and seconds of its logs."""

    start_ns: int
    seconds: float


class Plan:
    """The stages of a command, planned one after the other: later ones know of earlier ones."""

    def __init__(self, work: Workspace, settings: Resolved) -> None:
        self.stages: list[PlannedStage] = []
        self.known_failures: list[str] = []
        self._work = work
        self._settings = settings
        self._coming: dict[str, _Coming] = {}
        self._rates = {**USUAL_RATES, **measured_rates(work)}

    def fuse(self, sessions: Sequence[SessionInput], redo: Redo = Redo.NOTHING) -> None:
        plan = plan_fuse(sessions, self._work, self._settings, redo=redo)
        coming = {task.folder.name: _coming(task) for task in plan.tasks}
        self.known_failures = plan.report.failed
        seconds = sum(one.seconds for one in coming.values())
        self._add("fuse", list(coming), len(sessions), seconds)
        # a log that cannot be opened makes no session
        self._coming = {name: one for name, one in coming.items() if one.seconds}

    def describe(self, names: Sequence[str] = (), *, overwrite: bool) -> None:
        """WorkspaceError where there are neither sessions nor logs to fuse."""
        is_empty = self._coming and not self._work.sessions()
        folders = [] if is_empty else self._work.chosen(names)
        folders = [folder for folder in folders if folder.name not in self._coming]
        missing = plan_describe(self._work, folders, self._settings, overwrite=overwrite)
        submaps = sum(
            len(read_json(f.session_json)["submaps"]) for f in folders if f.name in missing
        )
        fusion = self._settings.fusion
        spacing = fusion.submap_length * (1 - fusion.submap_overlap)
        for one in self._coming.values():
            submaps += 1 + int(one.seconds * USUAL_SPEED / spacing)
        todo = [*missing, *self._coming]
        self._add("describe", todo, len(folders) + len(self._coming), submaps)

    def close(self, selection: Selection = EVERYTHING, *, overwrite: bool) -> None:
        """WorkspaceError where a session lacks words, unless they would be made before."""
        if not self.stages:
            PairSearch.of(self._work, self._settings, selection, overwrite=overwrite)
        folders = [f for f in self._work.sessions() if f.name not in self._coming]
        maps = {folder.name: SessionMap(folder) for folder in folders}
        exclusions = Exclusions.of(maps, self._settings)
        fingerprints = pair_fingerprints(maps, self._settings)
        known = known_pairs(self._work)
        possible = [p for p in fingerprints if selection.has(p) and not exclusions.has(p)]
        todo = [p for p in possible if overwrite or known.get(p) != fingerprints[p]]
        queries = {
            name: len(query_keyframes(maps[name], self._settings))
            for name in {p.query for p in todo}
        }
        searches: float = sum(queries[pair.query] for pair in todo)
        names = [f"{pair.query} in {pair.target}" for pair in todo]

        # sessions that are still logs: by the times of their recording
        starts = {
            name: int(m.stamps_ns[0]) for name, m in maps.items() if name not in exclusions.misfits
        }
        starts |= {name: one.start_ns for name, one in self._coming.items()}
        order = sorted(starts, key=lambda name: (starts[name], name))
        for number, query in enumerate(order):
            for target in order[: number + 1]:
                if self._coming.keys() & {query, target}:
                    names.append(f"{query} in {target}")
                    searches += self._queries(query, maps)
        total = len(possible) + len(names) - len(todo)
        self._add("close", names, total, searches)

    def _queries(self, name: str, maps: Mapping[str, SessionMap]) -> float:
        if name in maps:
            return len(query_keyframes(maps[name], self._settings))
        return 1 + self._coming[name].seconds * USUAL_SPEED / self._settings.query.every

    def _add(self, stage: str, todo: Sequence[str], total: int, amount: float) -> None:
        seconds = amount * self._rates[stage]
        self.stages.append(
            PlannedStage(stage, tuple(todo), total, round(amount), UNITS[stage], seconds)
        )


def _coming(task: FuseTask) -> _Coming:
    """Of logs that cannot be opened, nothing: fusing names them."""
    starts: list[int] = []
    seconds = 0.0
    for path in task.logs:
        try:
            with closing(open_log(Path(path), task.settings.logs.memory)) as log:
                if log.start_ns is not None and log.end_ns is not None:
                    starts.append(log.start_ns)
                    seconds += (log.end_ns - log.start_ns) / 1e9
        except SemlocError:
            continue
    return _Coming(min(starts, default=0), seconds)


def measured_rates(work: Workspace) -> dict[str, float]:
    """Seconds of one worker for a unit of each stage, as `semloc run` measured them last."""
    try:
        rates: Any = read_json(work.summary).get("rates", {})
    except WorkspaceError:
        return {}
    return {k: float(v) for k, v in rates.items() if k in USUAL_RATES}

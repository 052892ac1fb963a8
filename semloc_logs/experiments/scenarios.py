"""The scenarios of the paper (section 4): which views a system learns, and which it localises.

A heading filter leaves views out of the *database*, before a system learns it; ranks of an answer
are never filtered. Queries of about the same heading share one database: the views that the filter
allows for every one of them, so that no query ever meets a view that the paper leaves out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from semloc_logs.arrays import F64, I64, Bools
from semloc_logs.evaluation.headings import in_window
from semloc_logs.experiments.views import ViewStore
from semloc_logs.numerics.evenly import evenly

PER_PASSAGE = 20  # queries around an intersection (paper, section 4.5)
EXCLUDED_VIEWS = 50  # of the same session about a query: the protocol of KITTI loops
NEAR_M = 10.0  # from a passage to the nearest view of its heading, and to its farthest query: 20
# frames of KITTI are 20 m
_SPREAD_DEG = 10.0  # of the headings of queries that share a database
_GAP = 3  # views between two queries of one passage that may be farther away


class PlannedQuery(NamedTuple):
    """A query: its ``name``, the number of its ``view``, and the ``passage`` that it belongs to:
    queries of one passage see the same place and are not independent.
    """

    name: str
    view: int
    passage: int


@dataclass(frozen=True, eq=False)
class Trial:
    """Queries that share a database of view numbers (n,)."""

    name: str
    database: I64
    queries: tuple[PlannedQuery, ...]


@dataclass(frozen=True, eq=False)
class Scenario:
    """A column of the table: its ``name``, such as ``90`` or ``summer>snow``, and its trials."""

    name: str
    trials: tuple[Trial, ...]

    @property
    def queries(self) -> list[PlannedQuery]:
        """The queries of all trials."""
        return [query for trial in self.trials for query in trial.queries]


@dataclass(frozen=True, slots=True)
class Extent:
    """How many queries a scenario has: around each intersection, and in all."""

    per_passage: int = PER_PASSAGE
    most: int = 200


# -- headings


def heading_scenario(
    store: ViewStore,
    heading_deg: float,
    database: Sequence[str],
    queries: Sequence[str],
    extent: Extent | None = None,
) -> Scenario:
    """Queries of the sessions ``queries`` where the road was driven at ``heading_deg`` to them in a
    session of ``database``.

    0 is the paper's traditional scenario: the database keeps the views of all headings. Without
    any intersection the scenario has no trials.
    """
    extent = extent or Extent()
    numbers = np.concatenate([store.of_session(name) for name in database])
    allowed = _Allowed(store, numbers, heading_deg)
    passages = [passage for name in queries for passage in find_passages(store, name, allowed)]
    chosen = _thinned(passages, extent)
    return Scenario(f"{heading_deg:g}", _trials(chosen, allowed, store))


@dataclass(frozen=True, eq=False)
class _Allowed:
    """Which of the ``database``'s views (n,) a query may meet at a heading."""

    store: ViewStore
    database: I64
    heading_deg: float

    def views(self, query: int) -> Bools:
        """Of the database, the views (n,) that the query is allowed to be localised with."""
        store = self.store
        if self.heading_deg == 0:
            return self._apart(query)
        window = in_window(
            store.headings_deg[self.database], store.headings_deg[query], self.heading_deg
        )
        return np.asarray(window & self._apart(query))

    def matching(self, query: int) -> I64:
        """Numbers of the views at the scenario's heading to the query."""
        window = in_window(
            self.store.headings_deg[self.database],
            self.store.headings_deg[query],
            self.heading_deg,
        )
        return self.database[window & self._apart(query)]

    def _apart(self, query: int) -> Bools:
        """Which views are of other sessions, or far from the query in its own."""
        store = self.store
        others = store.session_of[self.database] != store.session_of[query]
        return np.asarray(others | (np.abs(self.database - query) > EXCLUDED_VIEWS))


def find_passages(store: ViewStore, session: str, allowed: _Allowed) -> list[I64]:
    """Numbers of the views of each passage of a session through an intersection at the heading, in
    their order: ``PER_PASSAGE`` about the nearest one; long passages are cut into several.
    """
    views = store.of_session(session)
    away = np.full(len(views), np.inf)
    place = store.world_T_base[:, :3, 3]
    for k, view in enumerate(views):
        matching = allowed.matching(int(view))
        if len(matching):
            away[k] = np.linalg.norm(place[matching] - place[view], axis=1).min()
    passing = np.flatnonzero(away <= NEAR_M)
    if not len(passing):
        return []
    runs = np.split(passing, np.flatnonzero(np.diff(passing) > _GAP) + 1)
    return [views[part] for run in runs for part in _parts(run, away, place[views])]


def _parts(run: I64, away: F64, place: F64) -> list[I64]:
    """``PER_PASSAGE`` positions about the nearest one of a run; consecutive ones of a long run."""
    first = int(run[0])
    last = int(run[-1])
    length = last - first + 1
    if length >= 2 * PER_PASSAGE:
        count = length // PER_PASSAGE
        return [first + PER_PASSAGE * k + np.arange(PER_PASSAGE) for k in range(count)]
    nearest = first + int(np.argmin(away[first : last + 1]))
    start = min(max(0, nearest - PER_PASSAGE // 2), max(0, len(away) - PER_PASSAGE))
    part = np.arange(start, min(len(away), start + PER_PASSAGE))
    off = np.linalg.norm(place[part] - place[nearest], axis=1)
    # in a bend the crossing street is not at the heading to all of them
    return [part[(off <= NEAR_M) & (away[part] <= 2 * NEAR_M)]]


def _thinned(passages: Sequence[I64], extent: Extent) -> list[tuple[int, int]]:
    """At most ``extent.most`` queries, evenly of all passages and evenly within them: the number of
    the passage and of the view.
    """
    thinned = [_evenly(p, extent.per_passage) for p in passages]
    kept = np.arange(len(thinned))
    if sum(len(p) for p in thinned) > extent.most:
        usual = float(np.mean([len(p) for p in thinned]))
        kept = _evenly(kept, max(1, math.ceil(extent.most / usual)))
    queries = [(k, int(view)) for k in kept.tolist() for view in thinned[k]]
    return [queries[i] for i in _evenly(np.arange(len(queries)), extent.most)]


def _evenly(numbers: I64, most: int) -> I64:
    if len(numbers) <= most:
        return numbers
    return numbers[evenly(len(numbers), most)]


def _trials(
    chosen: Iterable[tuple[int, int]], allowed: _Allowed, store: ViewStore
) -> tuple[Trial, ...]:
    """Queries whose databases agree, and the views that every one of them allows."""
    queries = [PlannedQuery(query_name(store, view), view, passage) for passage, view in chosen]
    out: list[Trial] = []
    for group in _groups(queries, allowed):
        mask = np.logical_and.reduce([allowed.views(query.view) for query in group])
        if mask.any():
            out.append(Trial(f"{len(out):03d}", allowed.database[mask], tuple(group)))
    return tuple(out)


def _groups(queries: Sequence[PlannedQuery], allowed: _Allowed) -> list[list[PlannedQuery]]:
    """Queries that share a database: of about one heading, and, where the database has views of
    their own session, of one passage.
    """
    store = allowed.store
    own = set(store.session_of[allowed.database].tolist())

    def group(query: PlannedQuery) -> int:
        return query.passage if int(store.session_of[query.view]) in own else -1

    out: list[list[PlannedQuery]] = []
    for number in sorted({group(query) for query in queries}):
        members = [query for query in queries if group(query) == number]
        if allowed.heading_deg == 0:
            out.append(members)
            continue
        # opposite directions have the same streets across
        period = 180.0 if allowed.heading_deg == 90 else 360.0
        out += _of_one_heading(members, store.headings_deg % period, period)
    return out


def _of_one_heading(
    queries: Sequence[PlannedQuery], headings: F64, period: float
) -> list[list[PlannedQuery]]:
    """Cut the circle of headings where it is widest open, then group by ``_SPREAD_DEG``."""
    ordered = sorted(queries, key=lambda q: (float(headings[q.view]), q.view))
    values = np.array([headings[q.view] for q in ordered])
    start = int(np.argmax(np.diff(np.append(values, values[0] + period)))) + 1
    ordered = [*ordered[start:], *ordered[:start]]
    out: list[list[PlannedQuery]] = []
    for query in ordered:
        first = headings[out[-1][0].view] if out else 0.0
        if out and (headings[query.view] - first) % period <= _SPREAD_DEG:
            out[-1].append(query)
        else:
            out.append([query])
    return out


def query_name(store: ViewStore, view: int) -> str:
    """The name of the query at a view: its session and stamp."""
    return f"{store.names[int(store.session_of[view])]}@{int(store.stamps_ns[view])}"


# -- cross-time


def time_scenario(
    store: ViewStore, name: str, database: str, queries: str, extent: Extent | None = None
) -> Scenario:
    """An entry of the cross-time matrix: a session localised in the map of another one.

    Queries are the views within ``NEAR_M`` of the mapped road, evenly chosen; ``PER_PASSAGE``
    consecutive ones are a passage.
    """
    extent = extent or Extent()
    numbers = store.of_session(database)
    views = store.of_session(queries)
    if not len(numbers) or not len(views):
        return Scenario(name, ())
    place = store.world_T_base[:, :3, 3]
    away, _ = cKDTree(place[numbers]).query(place[views])
    passing = views[away <= NEAR_M]
    planned = tuple(
        PlannedQuery(query_name(store, int(view)), int(view), int(position) // PER_PASSAGE)
        for position, view in zip(
            _evenly(np.arange(len(passing)), extent.most),
            _evenly(passing, extent.most),
            strict=True,
        )
    )
    return Scenario(name, (Trial("000", numbers, planned),) if planned else ())


def query_views(store: ViewStore, view: int, frames: int) -> list[int]:
    """Numbers of the ``frames`` consecutive views that end at a view: fewer at the session's start,
    or where a true pose is missing.
    """
    session = int(store.session_of[view])
    first = view
    while view - first + 1 < frames:
        before = first - 1
        if before < 0 or int(store.session_of[before]) != session:
            break
        first = before
    return list(range(first, view + 1))

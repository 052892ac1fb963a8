"""Tasks of a search: some queries of one session, in the sessions that they may meet.

What a pair of sessions gets does not depend on the other sessions. Most pairs never meet, so cheap
looks come first: a survey of the words of all sessions at once, which tells for each of them
whether a block of consecutive queries is worth a search; a search of the block's query with the
most votes; and where that one finds a place that may be right, a search of the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.query_map import Query
from semloc_logs.closures.acceptance.calibration import is_plausible
from semloc_logs.closures.alignment_tables import write_part
from semloc_logs.closures.closure import Alignment
from semloc_logs.closures.database import open_database
from semloc_logs.closures.matching import ground_below, prepare, search_query
from semloc_logs.closures.query import build_query
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import STREET_VOXEL, Resolved
from semloc_logs.words.catalogue import segments
from semloc_logs.words.survey import NO_VOTES, Survey, Votes
from semloc_logs.workspace import Workspace

BLOCK = 4  # consecutive queries that are searched together; tasks hold whole blocks
SURVEY_CELL = 4.8  # m, at voxels of 0.30 m: edge of the cells that a survey votes in
OPEN_SURVEYS = 4
MIN_SHARE = 0.1  # of the votes in a session: small maps and small queries have few
# of an alignment's own features, below which it tells nothing about neighbouring queries
MIN_PROBABILITY = 0.02

Built = tuple[Query, NDArray[np.float64]]
Surveyed = Mapping[int, Mapping[str, Votes]]  # of queries, by keyframe and session


@dataclass(frozen=True, slots=True)
class SearchTask:
    """Some queries of one session to search in others; picklable.

    ``targets`` are fingerprints of the pairs by session. The alignments go to ``output``.
    """

    work: Path
    session: str
    keyframes: tuple[int, ...]
    targets: dict[str, str]
    settings: Resolved
    output: Path


def search_queries(task: SearchTask) -> int:
    """Write the alignments of each keyframe of the task, best first; how many there are.

    Each target is searched by itself, so its alignments do not depend on the others.
    """
    session = SessionMap(Workspace(task.work).session(task.session))
    queries = {k: build_query(session, k, task.settings) for k in task.keyframes}
    votes = survey_queries(task, session, queries)
    found: list[Alignment] = []
    for target, fingerprint in task.targets.items():

        def search(keyframe: int, target: str = target, key: str = fingerprint) -> list[Alignment]:
            database = open_database(task.work, target, key, task.settings)
            return search_query(database, session, keyframe, queries[keyframe])

        if target == task.session:
            found += [a for keyframe in queries for a in search(keyframe)]
            continue
        of_target = {k: votes[k].get(target, NO_VOTES) for k in queries}
        for block in _blocks(task.keyframes):
            found += _search_block(block, of_target, task.settings.closures.min_votes, search)
    found.sort(key=lambda a: (a.query_keyframe, a.target_session))
    write_part(task.output, task.keyframes, task.targets, found)
    return len(found)


def _blocks(keyframes: Sequence[int]) -> Iterator[Sequence[int]]:
    for first in range(0, len(keyframes), BLOCK):
        yield keyframes[first : first + BLOCK]


def _search_block(
    block: Sequence[int],
    votes: Mapping[int, Votes],
    min_votes: float,
    search: Callable[[int], list[Alignment]],
) -> list[Alignment]:
    """The alignments of the queries of a block in one target, as far as these are worth a search.

    With a ``min_votes`` of 0 all are searched.
    """
    if min_votes <= 0:
        return [a for keyframe in block for a in search(keyframe)]
    first = max(block, key=lambda keyframe: (votes[keyframe].place, -keyframe))
    enough = min(min_votes, MIN_SHARE * votes[first].everywhere)
    if votes[first].place <= 0 or votes[first].place < enough:
        return []
    found = search(first)
    if any(_may_be_right(alignment) for alignment in found):
        for keyframe in block:
            if keyframe != first:
                found += search(keyframe)
    return found


def _may_be_right(alignment: Alignment) -> bool:
    return alignment.probability >= MIN_PROBABILITY and bool(is_plausible(alignment.features))


# -- surveys


def survey_queries(task: SearchTask, session: SessionMap, queries: Mapping[int, Built]) -> Surveyed:
    """How many words of each query agree about a place in each target, other than the session."""
    settings = task.settings
    names = [name for name in task.targets if name != task.session]
    votes: dict[int, dict[str, Votes]] = {k: dict.fromkeys(names, NO_VOTES) for k in queries}
    if settings.closures.min_votes <= 0 or not names:
        return votes
    for variant, chosen in _by_variant(task, session, names).items():
        survey = _survey(task.work, variant, chosen, settings)
        for keyframe, (query, _) in queries.items():
            if len(query.structure[0]):
                described, turned = prepare(
                    query, variant, ground_below(session, keyframe), settings
                )
                centre = described.centre.astype(float) * settings.fusion.voxel_size
                votes[keyframe] |= survey.votes(turned, centre)
    return votes


def _by_variant(
    task: SearchTask, session: SessionMap, names: Sequence[str]
) -> dict[str, tuple[tuple[str, str], ...]]:
    """The targets, with the fingerprints of their pairs, by the words that they are searched by."""
    work = Workspace(task.work)
    forced = task.settings.descriptor.variant
    out: dict[str, list[tuple[str, str]]] = {}
    for name in names:
        variant: str = forced
        if forced == "auto":
            known = session.has_classes and SessionMap(work.session(name)).has_classes
            variant = "semantic" if known else "geometric"
        out.setdefault(variant, []).append((name, task.targets[name]))
    return {variant: tuple(targets) for variant, targets in out.items()}


@lru_cache(maxsize=OPEN_SURVEYS)
def _survey(
    work: Path, variant: str, targets: tuple[tuple[str, str], ...], settings: Resolved
) -> Survey:
    """The survey of targets, kept between the tasks of a process, with all that it depends on."""
    names = [name for name, _ in targets]
    cell = SURVEY_CELL * settings.fusion.voxel_size / STREET_VOXEL
    held = segments(Workspace(work), variant, names)
    return Survey(held, names, settings.descriptor.headings, cell)

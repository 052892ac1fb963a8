"""Tasks of a search: some queries of one session, in the sessions that they may meet.

What a pair of sessions gets does not depend on the other sessions. Most pairs never meet, so cheap
looks come first: a survey of the words of all sessions at once, which tells for each of them
whether a block of consecutive queries is worth a search; a search of the block's query with the
most votes; and where that one finds a place that may be right, a search of the others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.query_map import Query
from semloc_logs.closures.acceptance.calibration import probability_of, shipped
from semloc_logs.closures.alignment_tables import write_part
from semloc_logs.closures.closure import Alignment
from semloc_logs.closures.database import open_database
from semloc_logs.closures.matching import allowed_words, ground_below, prepare, search_query
from semloc_logs.closures.query import build_query, query_keyframes
from semloc_logs.closures.visibility import visible_to
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import STREET_VOXEL, Resolved
from semloc_logs.words.index import LookUp
from semloc_logs.words.segment_catalogue import segments
from semloc_logs.words.survey import NO_VOTES, Survey, Votes, votes_in_session
from semloc_logs.workspace import Workspace

SURVEY_CELL = 4.8  # m, at voxels of 0.30 m: edge of the cells that a survey votes in
OPEN_SURVEYS = 4
# of the best hypothesis in another session. Of 343 stretches of simulated drives (14 towns, all
# kinds of sensors) that may be closed one has less, and six of seven of sessions that never meet
LEAST_AGREEMENT = 0.15
MIN_SHARE = 0.1  # of the votes in a session: small maps and small queries have few
# of an alignment's own features, below which it tells nothing about neighbouring queries
MIN_PROBABILITY = 0.02

Built = tuple[Query, NDArray[np.float64]]
Surveyed = Mapping[int, Mapping[str, Votes]]  # of queries, by keyframe and session


@dataclass(frozen=True, slots=True)
class SearchTask:
    """Some queries of one session to search in others; picklable.

    ``targets`` are fingerprints of the pairs by session, ``words`` of the sessions' own words and
    maps. The alignments go to ``output``.
    """

    work: Path
    session: str
    keyframes: tuple[int, ...]
    targets: dict[str, str]
    words: Mapping[str, str]
    settings: Resolved
    output: Path


def search_queries(task: SearchTask) -> int:
    """Write the alignments of each keyframe of the task, best first; how many there are.

    Each target is searched by itself, so its alignments do not depend on the others.
    """
    session = SessionMap(Workspace(task.work).session(task.session))
    queries = {k: build_query(session, k, task.settings) for k in task.keyframes}
    least_votes = min_votes(session, task.settings)
    votes = survey_queries(task, session, queries) if least_votes > 0 else {k: {} for k in queries}
    alignments: list[Alignment] = []
    for target in task.targets:

        def search(
            keyframe: int, least_agreement: float = 0.0, target: str = target
        ) -> list[Alignment]:
            database = open_database(task.work, target, task.words[target], task.settings)
            built = queries[keyframe]
            return search_query(database, session, keyframe, built, least_agreement=least_agreement)

        of_target = {k: votes[k].get(target, NO_VOTES) for k in queries}
        is_other = target != task.session
        for block in _blocks(task.keyframes, block_size(task.settings)):
            alignments += _search_block(block, of_target, least_votes, search, is_other=is_other)
    alignments.sort(key=lambda a: (a.query_keyframe, a.target_session))
    write_part(task.output, task.keyframes, task.targets, alignments)
    return len(alignments)


def min_votes(session: SessionMap, settings: Resolved) -> float:
    """Votes that are worth a search. A single query is searched in any case: no neighbour finds
    what its survey missed.
    """
    return settings.closures.min_votes if len(query_keyframes(session, settings)) > 1 else 0.0


def block_size(settings: Resolved) -> int:
    """How many consecutive queries are searched together; tasks hold whole blocks."""
    return max(1, round(settings.closures.every / settings.query.every))


def _blocks(keyframes: Sequence[int], size: int) -> Iterator[Sequence[int]]:
    for first in range(0, len(keyframes), size):
        yield keyframes[first : first + size]


class Search(Protocol):
    """The alignments of a query of a block in one target, see :func:`search_query`."""

    def __call__(self, keyframe: int, least_agreement: float = 0.0) -> list[Alignment]: ...


def _search_block(
    block: Sequence[int],
    votes: Mapping[int, Votes],
    min_votes: float,
    search: Search,
    *,
    is_other: bool,
) -> list[Alignment]:
    """The alignments of the queries of a block in one target, as far as these are worth a search.

    With a ``min_votes`` of 0 all are searched. In another session the votes must be more than
    chance brings, and so must the best hypothesis: there may be hundreds that never meet the
    query's. Its own is one, and a revisit begins with a few votes.
    """
    if min_votes <= 0:
        return [a for keyframe in block for a in search(keyframe)]
    first = max(block, key=lambda keyframe: (votes[keyframe].place, -keyframe))
    enough = min(min_votes, MIN_SHARE * votes[first].everywhere)
    if is_other:
        enough = max(enough, votes[first].by_chance)
    if votes[first].place <= 0 or votes[first].place < enough:
        return []
    alignments = search(first, LEAST_AGREEMENT if is_other else 0.0)
    if _may_be_right(alignments):
        for keyframe in block:
            if keyframe != first:
                alignments += search(keyframe)
    return alignments


def _may_be_right(alignments: Sequence[Alignment]) -> bool:
    """Whether some alignment is worth the vote of a neighbour."""
    probabilities = (probability_of(shipped().own_log_odds(a.features)) for a in alignments)
    return any(float(p) >= MIN_PROBABILITY for p in probabilities)


# -- surveys


def survey_queries(task: SearchTask, session: SessionMap, queries: Mapping[int, Built]) -> Surveyed:
    """How many words of each query agree about a place in each target.

    Of the session itself only words of another time vote (:mod:`.visibility`).
    """
    settings = task.settings
    votes: dict[int, dict[str, Votes]] = {keyframe: {} for keyframe in queries}
    with_structure = {k: query for k, (query, _) in queries.items() if len(query.structure[0])}

    def words(keyframe: int, variant: str) -> tuple[list[list[LookUp]], NDArray[np.float64]]:
        query = with_structure[keyframe]
        described, turned = prepare(query, variant, ground_below(session, keyframe), settings)
        return turned, described.centre.astype(float) * settings.fusion.voxel_size

    others = tuple((name, task.words[name]) for name in task.targets if name != task.session)
    if others:
        surveys = _surveys(task.work, others, session.has_classes, settings)
        for variant, survey in surveys.items():
            for keyframe in with_structure:
                votes[keyframe] |= survey.votes(*words(keyframe, variant))

    if task.session in task.targets:
        words_of_session = task.words[task.session]
        database = open_database(task.work, task.session, words_of_session, settings)
        for keyframe in with_structure:
            visible = visible_to(database, session, keyframe)
            for variant, allowed in allowed_words(visible, session).items():
                votes[keyframe][task.session] = votes_in_session(
                    database.words(variant).parts,
                    allowed,
                    *words(keyframe, variant),
                    headings=settings.descriptor.headings,
                    cell=_survey_cell(settings),
                )
    return votes


def _survey_cell(settings: Resolved) -> float:
    return SURVEY_CELL * settings.fusion.voxel_size / STREET_VOXEL


@lru_cache(maxsize=OPEN_SURVEYS)
def _surveys(
    work: Path, targets: tuple[tuple[str, str], ...], has_classes: bool, settings: Resolved
) -> dict[str, Survey]:
    """Surveys of the targets of a session, by the words that they are searched by.

    They are kept between the tasks of a process; ``targets`` come with fingerprints of their words.
    ``has_classes``: whether the session's labels come from a log or a model.
    """
    forced = settings.descriptor.variant
    names: dict[str, list[str]] = {}
    for name, _ in targets:
        variant: str = forced
        if forced == "auto":
            known = has_classes and SessionMap(Workspace(work).session(name)).has_classes
            variant = "semantic" if known else "geometric"
        names.setdefault(variant, []).append(name)
    cell = _survey_cell(settings)
    headings = settings.descriptor.headings
    return {
        variant: Survey(segments(Workspace(work), variant, chosen), chosen, headings, cell)
        for variant, chosen in names.items()
    }

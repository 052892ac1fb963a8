"""Which sessions may hold a query's place: votes of its words, counted in all sessions at once.

A search compares each query word with thousands of a session's words. A survey looks only at those
that fall into its nearest few words of the vocabulary and have nearly its code, and finds how many
of them agree where the query lies. That takes microseconds a session. The votes in a session do not
depend on the other sessions.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from semloc_logs.arrays import F32, F64, I32, I64, U32, U64, Bools
from semloc_logs.numerics.bits import popcount
from semloc_logs.words.index import ALL, NONE, Allowed, LookUp, Part, may_match
from semloc_logs.words.segment import Segment

NEAR_CODE = 14  # bits between codes that vote
# of a vote with equal codes; other votes weigh (1 - bits / FAR_CODE)^2 of it, in whole numbers:
# their sums do not depend on their order
FULL_VOTE = 1024
FAR_CODE = 32
# of the numbers of cells: place | heading | x | y | weight
HEADING_BITS = 8
CELL_BITS = 14
WEIGHT_BITS = 11
# in six simulated towns of ten kilometres 23 of 100 stretches of sessions that never meet have more
# votes than that by chance, and 1,243 of 1,248 stretches within 5 m of the other session's road
CHANCE = 0.3
KILOMETRE = 12  # submaps of so much road


class _Postings(NamedTuple):
    """The lists of a segment, and which of their entries may vote (:meth:`Allowed.of`)."""

    starts: U32
    code: U64
    place: U32
    row: U32
    centre: F32
    yaw: F32
    begin: I64
    rows: Bools


class _QueryWords(NamedTuple):
    """Words of a query: each (n, w) of its nearest ones, with its code, quarter turns and
    centre (n, 2), metres."""

    word: I32
    code: U64
    turns: I64
    centre: F64


class Votes(NamedTuple):
    """The weight of the votes in a session: for the best ``place``, and ``everywhere`` in its
    ``submaps``.

    Equal codes have weight 1.
    """

    place: float
    everywhere: float
    submaps: int

    @property
    def by_chance(self) -> float:
        """What the best place of a session that never meets the query's gets, which few exceed.

        It grows with the root of the votes. The more submaps there are, the more places may be
        best; that adds little from a kilometre on.
        """
        kilometre = min(1.0, KILOMETRE / max(self.submaps, 1))
        return CHANCE * float(np.sqrt(self.everywhere * kilometre))


NO_VOTES = Votes(0.0, 0.0, 0)


class Survey:
    """The words of the sessions ``names`` in ``segments``, each with the sessions that it serves.

    Votes are counted in cells of ``cell`` metres and of ``headings`` headings.
    """

    def __init__(
        self,
        segments: Iterable[tuple[Segment, frozenset[str]]],
        names: Sequence[str],
        headings: int,
        cell: float,
    ) -> None:
        self.names = tuple(names)
        self._headings = headings
        self._cell = cell
        self._submaps = np.zeros(len(self.names), np.int64)
        numbers = {name: number for number, name in enumerate(self.names)}
        self._lists: list[tuple[_Postings, I64]] = []
        for segment, served in segments:
            # the number of each place's session, -1 for none
            session = np.array(
                [numbers[n] if n in served else -1 for n, _ in segment.places], np.int64
            )
            self._submaps += np.bincount(session[session >= 0], minlength=len(self.names))
            begin = np.where(session >= 0, ALL, NONE)
            self._lists.append((_postings(segment, begin, np.zeros(0, bool)), session))

    def votes(self, turned: Sequence[Sequence[LookUp]], centre: F64) -> Mapping[str, Votes]:
        """The votes in each session.

        ``turned`` are the look-ups of a query's words at ``centre`` (n, 3), metres, in each quarter
        turn.
        """
        weights = np.zeros((2, len(self.names)), np.int64)
        if len(centre):
            words = _query_words(turned, centre)
            for postings, session in self._lists:
                _add_votes(words, postings, session, weights, self._headings, self._cell)
        return dict(zip(self.names, _of_sessions(weights, self._submaps), strict=True))


def votes_in_session(
    parts: Iterable[Part],
    allowed: Allowed,
    turned: Sequence[Sequence[LookUp]],
    centre: F64,
    *,
    headings: int,
    cell: float,
) -> Votes:
    """The votes of a query, as :meth:`Survey.votes` takes it, for the words of one session that
    are ``allowed``. ``parts`` hold no other session's.
    """
    weights = np.zeros((2, 1), np.int64)
    submaps = 0
    if len(centre):
        words = _query_words(turned, centre)
        for part in parts:
            submaps += len(part.group)
            postings = _postings(part.segment, *allowed.of(part.group))
            session = np.zeros(len(part.group), np.int64)
            _add_votes(words, postings, session, weights, headings, cell)
    return _of_sessions(weights, [submaps])[0]


def _postings(segment: Segment, begin: I64, rows: Bools) -> _Postings:
    s = segment
    return _Postings(s.starts, s.code, s.place, s.row, s.centre, s.yaw, begin, rows)


def _add_votes(
    words: _QueryWords, postings: _Postings, session: I64, weights: I64, headings: int, cell: float
) -> None:
    """Add the votes to the ``weights`` (2, sessions) of best places and of everything.

    ``session`` (places,) has the number of each place's.
    """
    for votes in _word_votes(words, postings, headings, cell):
        votes.sort()
        _count(votes, session, *weights)


def _of_sessions(weights: I64, submaps: Iterable[int]) -> list[Votes]:
    place, everywhere = weights / FULL_VOTE
    # both grids have all votes
    columns = zip(place.tolist(), (everywhere / 2).tolist(), submaps, strict=True)
    return [Votes(best, total, int(count)) for best, total, count in columns]


def _query_words(turned: Sequence[Sequence[LookUp]], centre: F64) -> _QueryWords:
    batches = [batch for batches in turned for batch in batches]
    return _QueryWords(
        np.concatenate([batch.word for batch in batches]),
        np.concatenate([batch.word_codes for batch in batches]),
        np.repeat(np.arange(len(turned)), len(centre)),
        np.tile(np.asarray(centre, float)[:, :2], (len(turned), 1)),
    )


@njit(cache=True, nogil=True)
def _word_votes(
    words: _QueryWords, postings: _Postings, headings: int, cell: float
) -> tuple[I64, I64]:
    """The votes of all pairs of near words: numbers of cells with a weight in their last bits.

    Of cells as they lie, and of cells moved by half their edge, so that no place is split at a
    border in both.
    """
    step = 2 * np.pi / headings
    quarter = headings // 4
    cells = 1 << CELL_BITS
    weights = np.empty(NEAR_CODE + 1, np.int64)
    for bits in range(NEAR_CODE + 1):
        weights[bits] = np.int64(FULL_VOTE * (1 - bits / FAR_CODE) ** 2)
    cosine = np.cos(np.arange(headings) * step)
    sine = np.sin(np.arange(headings) * step)
    votes = np.empty((2, 4096), np.int64)
    count = 0
    for q in range(len(words.word)):
        for n in range(words.word.shape[1]):
            word = np.int64(words.word[q, n])
            code = words.code[q, n]
            for i in range(np.int64(postings.starts[word]), np.int64(postings.starts[word + 1])):
                bits = popcount(code ^ postings.code[i])
                if bits > NEAR_CODE:
                    continue
                place = np.int64(postings.place[i])
                row = np.int64(postings.row[i])
                if not may_match(place, row, postings.begin, postings.rows):
                    continue
                own = np.int64(np.rint(postings.yaw[i] / step))
                heading = (own + words.turns[q] * quarter) % headings
                c = cosine[heading]
                s = sine[heading]
                x = (postings.centre[i, 0] - c * words.centre[q, 0] + s * words.centre[q, 1]) / cell
                y = (postings.centre[i, 1] - s * words.centre[q, 0] - c * words.centre[q, 1]) / cell
                if count == votes.shape[1]:
                    more = np.empty((2, 2 * count), np.int64)
                    more[:, :count] = votes
                    votes = more
                for grid in range(2):
                    column = np.int64(np.floor(x + 0.5 * grid)) & (cells - 1)
                    row = np.int64(np.floor(y + 0.5 * grid)) & (cells - 1)
                    number = ((place << HEADING_BITS | heading) << CELL_BITS | column) << CELL_BITS
                    votes[grid, count] = (number | row) << WEIGHT_BITS | weights[bits]
                count += 1
    return votes[0, :count].copy(), votes[1, :count].copy()


@njit(cache=True, nogil=True)
def _count(votes: I64, session: I64, place: I64, everywhere: I64) -> None:
    """Weights in each session: the greatest in a cell into ``place``, the sum to ``everywhere``.

    ``votes`` (n,) are ascending.
    """
    weight = np.int64(0)
    for i in range(len(votes)):
        cell = votes[i] >> WEIGHT_BITS
        weight += votes[i] & ((1 << WEIGHT_BITS) - 1)
        if i + 1 == len(votes) or votes[i + 1] >> WEIGHT_BITS != cell:
            number = session[cell >> (HEADING_BITS + 2 * CELL_BITS)]
            place[number] = max(place[number], weight)
            everywhere[number] += weight
            weight = np.int64(0)

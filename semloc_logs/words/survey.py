"""Which sessions may hold a query's place: votes of its words, counted in all sessions at once.

A search compares each query word with many words of a session. A survey looks only at the words of
the database that are the same word, with a code nearly the same, and counts how many of them put
the query in one place. That takes microseconds a session. The votes in a session do not depend on
the other sessions.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.numerics.bits import popcount
from semloc_logs.words.index import LookUp
from semloc_logs.words.segment import Segment

U16 = NDArray[np.uint16]
U32 = NDArray[np.uint32]
U64 = NDArray[np.uint64]
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
NEAR_CODE = 20  # bits between two codes of one word that vote
# of the numbers of cells: place | heading | x | y
HEADING_BITS = 8
CELL_BITS = 16


class _Lists(NamedTuple):
    """The lists of a segment; ``session`` (places,) is the number of each place's, -1 for none."""

    starts: U32
    code: U64
    place: U32
    centre: F32
    yaw: F32
    session: I64


class _Asked(NamedTuple):
    """Words of a query (n,), their codes, quarter turns and centres (n, 2), metres."""

    word: U16
    code: U64
    turns: I64
    centre: F64


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
        numbers = {name: number for number, name in enumerate(self.names)}
        self._lists = [
            _Lists(
                s.starts,
                s.code,
                s.place,
                s.centre,
                s.yaw,
                np.array([numbers[n] if n in served else -1 for n, _ in s.places], np.int64),
            )
            for s, served in segments
        ]

    def votes(self, turned: Sequence[Sequence[LookUp]], centre: F64) -> Mapping[str, int]:
        """The most votes for one place in each session.

        ``turned`` are the look-ups of a query's words at ``centre`` (n, 3), metres, in each quarter
        turn.
        """
        asked = _asked(turned, centre)
        most = np.zeros(len(self.names), np.int64)
        for lists in self._lists:
            for cells in _cells(asked, lists, self._headings, self._cell):
                cells.sort()
                _count(cells, lists.session, most)
        return dict(zip(self.names, most.tolist(), strict=True))


def _asked(turned: Sequence[Sequence[LookUp]], centre: F64) -> _Asked:
    batches = [batch for batches in turned for batch in batches]
    if not batches or not len(centre):
        nothing = np.zeros(0, np.int64)
        return _Asked(
            nothing.astype(np.uint16), nothing.astype(np.uint64), nothing, np.zeros((0, 2))
        )
    return _Asked(
        np.concatenate([batch.word for batch in batches]),
        np.concatenate([batch.codes[:, 0] for batch in batches]),
        np.repeat(np.arange(len(turned)), len(centre)),
        np.tile(np.asarray(centre, float)[:, :2], (len(turned), 1)),
    )


@njit(cache=True, nogil=True)
def _cells(asked: _Asked, lists: _Lists, headings: int, cell: float) -> tuple[I64, I64]:
    """Numbers of the cells that each pair of near words votes for.

    They are of cells as they lie and of cells moved by half their edge, so that no place is split
    at a border in both.
    """
    step = 2 * np.pi / headings
    quarter = headings // 4
    middle = 1 << (CELL_BITS - 1)
    cells = np.empty((2, 4096), np.int64)
    count = 0
    for q in range(len(asked.word)):
        word = np.int64(asked.word[q])
        code = asked.code[q]
        for i in range(np.int64(lists.starts[word]), np.int64(lists.starts[word + 1])):
            if popcount(code ^ lists.code[i]) > NEAR_CODE:
                continue
            place = np.int64(lists.place[i])
            if place >= len(lists.session) or lists.session[place] < 0:  # a file may be damaged
                continue
            heading = (np.int64(np.rint(lists.yaw[i] / step)) + asked.turns[q] * quarter) % headings
            c = np.cos(heading * step)
            s = np.sin(heading * step)
            x = (lists.centre[i, 0] - c * asked.centre[q, 0] + s * asked.centre[q, 1]) / cell
            y = (lists.centre[i, 1] - s * asked.centre[q, 0] - c * asked.centre[q, 1]) / cell
            if count == cells.shape[1]:
                more = np.empty((2, 2 * count), np.int64)
                more[:, :count] = cells
                cells = more
            for grid in range(2):
                column = np.int64(np.floor(x + 0.5 * grid)) + middle
                row = np.int64(np.floor(y + 0.5 * grid)) + middle
                number = (place << HEADING_BITS) | heading
                number = (number << CELL_BITS) | (column & (2 * middle - 1))
                cells[grid, count] = (number << CELL_BITS) | (row & (2 * middle - 1))
            count += 1
    return cells[0, :count].copy(), cells[1, :count].copy()


@njit(cache=True, nogil=True)
def _count(cells: I64, session: I64, most: I64) -> None:
    """The most votes for a cell of each session into ``most``, from ascending ``cells`` (n,)."""
    first = 0
    for i in range(len(cells)):
        if i + 1 == len(cells) or cells[i + 1] != cells[i]:
            number = session[cells[i] >> (HEADING_BITS + 2 * CELL_BITS)]
            most[number] = max(most[number], i + 1 - first)
            first = i + 1

"""Inverted lists over the words of many submaps, and the search for the nearest codes (paper 3.4).

A query looks into the lists of its nearest cells. Where these hold more than a budget of codes, it
looks at the words of these cells that are nearest to it, as many as hold the budget: so the work of
a look-up does not grow with the map beyond that. The codes nearest in Hamming distance, with all
that are as near as the last, are found by counting bits. Of these the nearest are chosen by the
*asymmetric* distance (Gordo et al. 2014): a bit that differs counts as much as the query's
projection lies off the cell's threshold, as bits of projections close to it mean little. That finds
more true neighbours than the Hamming distance alone does, for a few microseconds a query; the
distance to the centroid of an entry's word adds nothing to it (docs/benchmarks.md, Words).

Matches do not depend on how words are spread over segments: the budget counts words of all of them,
and of equally near entries the first by submap and row is nearer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import F32, F64, I32, I64, U8, U32, U64, Bools
from semloc_logs.numerics.bits import lowest_bit, popcount
from semloc_logs.words.kmeans import grid
from semloc_logs.words.segment import WORDS, Held, Segment, segment_in_memory
from semloc_logs.words.vocabulary import BITS, Vocabulary, codes_of

# of each query: where its ranges start (n + 1,); of each range: first word, last word + 1, probe
Ranges = tuple[I64, I64, I64, I64]
SHORTLIST = 32  # nearest codes in Hamming distance that are compared asymmetrically
BUDGET = 32_768  # codes that a look-up compares, and the codes of one word more
# distances of descriptors to words are multiples of 1 / UNIT: see
# :mod:`semloc_logs.words.vocabulary`
UNIT = 2.0**19
QUERIES = 1024  # that are looked up together
# of a query word, in its nearest cells, that a survey looks into
NEAREST_WORDS, NEAREST_CELLS = 4, 2
# of the words of a place: all may match, none
ALL = -1
NONE = -2


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Matches of a search, for each query the nearest first, by the asymmetric distance.

    ``query`` (m,) rows of the query, ``group`` (m,) submaps, ``entry`` (m,) rows among the words of
    the submap, their ``centre`` (m, 3), metres, and ``yaw`` (m,), radians, ``distance`` (m,)
    Hamming.
    """

    query: I32
    group: I64
    entry: I64
    centre: F64
    yaw: F64
    distance: I32


@dataclass(frozen=True, slots=True, eq=False)
class Allowed:
    """Words that may match: of submaps ``groups`` (g,), of some of them certain ``rows`` only.

    ``rows`` has a mask (n,) of the words by number.
    """

    groups: Bools
    rows: Mapping[int, Bools] = field(default_factory=dict)

    def of(self, group: I64) -> tuple[I64, Bools]:
        """For each place, of submap ``group`` (places,): where its rows begin in the masks.

        The masks are returned one behind the other. It is ``NONE`` where none of the words may
        match, ``ALL`` where all may.
        """
        open_ = np.where((group >= 0) & self.groups[group], ALL, NONE).astype(np.int64)
        masks = [np.zeros(0, bool)]
        length = 0
        for g, mask in self.rows.items():
            open_[(group == g) & (open_ == ALL)] = length
            masks.append(mask)
            length += len(mask)
        return open_, np.concatenate(masks)


# sums of multiples of 1 / UNIT are exact in any order
@njit(cache=True, nogil=True, fastmath={"reassoc"})
def _word_distances(projected: F32, cell: int, children: F32, square: F32, out: I32) -> None:
    """Distances of a query to the words of ``cell`` (k,) into ``out``.

    In units, and less its own square.
    """
    for c in range(children.shape[1]):
        dot = np.float32(0.0)
        for b in range(BITS):
            dot += projected[b] * children[cell, c, b]
        out[c] = np.int32(
            min(max((square[cell, c] - 2 * dot) * np.float32(UNIT), -(2.0**29)), 2.0**29)
        )


@njit(cache=True, nogil=True)
def _nearest_words(
    projected: F32, cells: I32, codes: U64, children: F32, square: F32
) -> tuple[I32, U64]:
    """The nearest words (n, NEAREST_WORDS) of each query in its first cells, and its codes there.

    Of equals the first; ``cells`` and ``codes`` are (n, p).
    """
    n, p = cells.shape
    p = min(p, NEAREST_CELLS)
    k = children.shape[1]
    words = np.empty((n, min(NEAREST_WORDS, p * k)), np.int32)
    code = np.empty(words.shape, np.uint64)
    distance = np.empty(p * k, np.int32)
    for q in range(n):
        for j in range(p):
            _word_distances(
                projected[q], cells[q, j], children, square, distance[j * k : j * k + k]
            )
        for i in range(words.shape[1]):
            nearest = np.argmin(distance)
            j = nearest // k
            words[q, i] = cells[q, j] * 256 + nearest % k
            code[q, i] = codes[q, j]
            distance[nearest] = np.iinfo(np.int32).max
    return words, code


@njit(cache=True, nogil=True)
def _farthest(distance: I32, weight: I64, budget: int) -> int:
    """The least distance within which there are entries of ``weight`` ``budget`` or more."""
    low = np.int64(distance.min())
    high = np.int64(distance.max())
    while low < high:
        middle = (low + high) >> 1
        total = 0
        for i in range(len(distance)):
            total += weight[i] if distance[i] <= middle else 0
        if total >= budget:
            high = middle
        else:
            low = middle + 1
    return int(low)


@njit(cache=True, nogil=True)
def _choose(
    projected: F32, cells: I32, children: F32, square: F32, live: I64, cell_live: I64, budget: int
) -> Ranges:
    """Ranges of words that each query looks into: its cells, or their nearest words.

    Queries have ``cells`` (n, p); the words hold ``budget`` entries. ``live`` (65536,) and
    ``cell_live`` (256,) are the entries of words and cells.
    """
    n, p = cells.shape
    k = children.shape[1]
    offsets = np.zeros(n + 1, np.int64)
    distance = np.zeros(p * k, np.int32)
    weight = np.zeros(p * k, np.int64)
    first = np.empty(n * p, np.int64)
    last = np.empty(n * p, np.int64)
    probe = np.empty(n * p, np.int64)
    chosen = 0
    for q in range(n):
        if chosen + p * k > len(first):
            more = np.empty(max(len(first), p * k), np.int64)
            first = np.concatenate((first, more))
            last = np.concatenate((last, more))
            probe = np.concatenate((probe, more))
        if cell_live[cells[q]].sum() <= budget:
            for j in range(p):
                first[chosen], last[chosen], probe[chosen] = (
                    cells[q, j] * 256,
                    cells[q, j] * 256 + 256,
                    j,
                )
                chosen += 1
        else:
            for j in range(p):
                _word_distances(
                    projected[q], cells[q, j], children, square, distance[j * k : j * k + k]
                )
                weight[j * k : j * k + k] = live[cells[q, j] * 256 : cells[q, j] * 256 + k]
            bound = _farthest(distance, weight, budget)
            for j in range(p):
                begun = False
                for c in range(k):
                    if distance[j * k + c] <= bound and weight[j * k + c]:
                        if not begun:
                            first[chosen], probe[chosen], begun = cells[q, j] * 256 + c, j, True
                            chosen += 1
                        last[chosen - 1] = cells[q, j] * 256 + c + 1
                    elif weight[j * k + c]:  # words without entries do not part a range
                        begun = False
        offsets[q + 1] = chosen
    return offsets, first[:chosen], last[:chosen], probe[:chosen]


class _Lists(NamedTuple):
    """The lists of a segment and which of their entries may answer (:meth:`Allowed.of`)."""

    starts: U32
    code: U64
    place: U32
    row: U32
    begin: I64
    rows: Bools


@njit(cache=True, nogil=True)
def may_match(place: np.integer[Any], row: np.integer[Any], begin: I64, rows: Bools) -> bool:
    """Whether the word in ``row`` of a place may match: ``begin`` (places,) and ``rows`` are of
    :meth:`Allowed.of`.
    """
    if place >= len(begin):  # a file may be damaged
        return False
    first = begin[place]
    return bool(first == ALL or (first >= 0 and first + row < len(rows) and rows[first + row]))


@njit(cache=True, nogil=True)
def _may_answer(lists: _Lists, entry: int) -> bool:
    row = np.int64(lists.row[entry])
    return may_match(lists.place[entry], row, lists.begin, lists.rows)


@njit(cache=True, nogil=True)
def _bound(count: I64, within: int, limit: int, size: int) -> int:
    """The least distance up to ``limit`` within which ``count`` (66,) has ``size`` entries.

    ``within`` entries are within ``limit``.
    """
    while limit > 0 and within - int(count[limit]) >= size:
        within -= int(count[limit])
        limit -= 1
    return limit


@njit(cache=True, nogil=True)
def _look(
    codes: U64,
    ranges: Ranges,
    q: int,
    lists: _Lists,
    size: int,
    count: I64,
    limit: int,
    distance: U8,
    positions: I64,
) -> tuple[int, int]:
    """Entries of a segment that query ``q`` with codes (p,) may want.

    Their distances, and positions and probes in ``positions`` (2, m). ``count`` (66,) entries were
    found at each distance up to ``limit``. Returns how many match now and the new limit, within
    which there are ``size``; the entries of this segment within it have been added to ``count``.
    """
    offsets, firsts, lasts, probes = ranges
    n = 0
    histogram = count.copy()
    # without branches: the compiler makes many at a time
    for r in range(offsets[q], offsets[q + 1]):
        code = codes[probes[r]]
        first = int(lists.starts[firsts[r]])
        end = int(lists.starts[lasts[r]])
        block = lists.code[first:end]
        into = distance[n : n + end - first]
        for i in range(len(block)):
            into[i] = np.uint8(popcount(code ^ block[i]))
        n += end - first
    for i in range(n):
        histogram[distance[i]] += 1
    bound = _bound(histogram, int(histogram[: limit + 1].sum()), limit, size)
    step = 1
    while True:
        matches = 0
        n = 0
        new = count.copy()
        for r in range(offsets[q], offsets[q + 1]):
            first = int(lists.starts[firsts[r]])
            end = int(lists.starts[lasts[r]])
            into = distance[n : n + end - first]
            for i in range(len(into)):
                if into[i] <= bound and _may_answer(lists, first + i):
                    positions[0, matches], positions[1, matches] = first + i, probes[r]
                    new[into[i]] += 1
                    matches += 1
            n += end - first
        within = int(new[: bound + 1].sum())
        if within >= size or bound == limit:
            break
        # many may not answer: look farther
        bound = min(bound + step, limit)
        step = 2 * step
    count[:] = new
    return matches, _bound(new, within, bound, size)


@njit(cache=True, nogil=True)
def _scan(codes: U64, ranges: Ranges, lists: _Lists, size: int, count: I64, limit: I64) -> I64:
    """Queries, positions and probes (3, m) of the entries of a segment among the ``size`` nearest.

    These may match and are the nearest so far. ``count`` (n, 66) and ``limit`` (n,) are of
    :func:`_look` and continue from segment to segment.
    """
    offsets, firsts, lasts, _ = ranges
    most = np.int64(0)
    for q in range(len(codes)):
        entries = np.int64(0)
        for r in range(offsets[q], offsets[q + 1]):
            entries += np.int64(lists.starts[lasts[r]]) - np.int64(lists.starts[firsts[r]])
        most = max(most, entries)
    distance = np.empty(most, np.uint8)
    positions = np.empty((2, most), np.int64)
    out = np.empty((3, 64 * len(codes) + most), np.int64)
    total = 0
    for q in range(len(codes)):
        matches, limit[q] = _look(
            codes[q], ranges, q, lists, size, count[q], limit[q], distance, positions
        )
        if total + matches > out.shape[1]:
            more = np.empty((3, 2 * (total + matches)), np.int64)
            more[:, :total] = out[:, :total]
            out = more
        for i in range(matches):
            if popcount(codes[q, positions[1, i]] ^ lists.code[positions[0, i]]) <= limit[q]:
                out[0, total], out[1, total], out[2, total] = q, positions[0, i], positions[1, i]
                total += 1
    return out[:, :total].copy()


@njit(cache=True, nogil=True)
def _nearest(
    margin: F32, codes: U64, bound: I64, query: I64, probe: I64, code: U64, key: I64, k: int
) -> tuple[I64, I32]:
    """The k nearest candidates (n, k) of each query and their Hamming distances, nearest first.

    -1 where there are fewer. ``margin`` (n, p, 64) is how far the query's projections lie off the
    thresholds of its cells, ``codes`` (n, p) their signs; candidates beyond their query's ``bound``
    (n,) do not count. Of equally near ones the one with the lesser ``key`` is nearer.
    """
    n = len(codes)
    nearest = np.full((n, k), -1, np.int64)
    hamming = np.zeros((n, k), np.int32)
    best = np.full((n, k), np.inf)
    for i in range(len(query)):
        q = query[i]
        p = probe[i]
        different = codes[q, p] ^ code[i]
        bits = popcount(different)
        distance = 0.0
        if bits > bound[q]:
            continue
        while different and distance <= best[q, k - 1]:
            b = lowest_bit(different)
            distance += margin[q, p, b]
            different &= different - np.uint64(1)
        j = k
        while j > 0 and (
            distance < best[q, j - 1]
            or (
                distance == best[q, j - 1]
                and (nearest[q, j - 1] < 0 or key[i] < key[nearest[q, j - 1]])
            )
        ):
            if j < k:
                best[q, j], nearest[q, j], hamming[q, j] = (
                    best[q, j - 1],
                    nearest[q, j - 1],
                    hamming[q, j - 1],
                )
            j -= 1
        if j < k:
            best[q, j], nearest[q, j], hamming[q, j] = distance, i, bits
    return nearest, hamming


@njit(cache=True, nogil=True)
def _count_live(starts: U32, place: U32, inside: Bools, live: I64) -> None:
    for w in range(WORDS):
        for i in range(np.int64(starts[w]), np.int64(starts[w + 1])):
            live[w] += place[i] < len(inside) and inside[place[i]]


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A segment in a search.

    ``group`` (places,) is the number of the submap at each of its places, -1 for those that take no
    part.
    """

    segment: Segment
    group: I64


@dataclass(frozen=True, slots=True, eq=False)
class LookUp:
    """Descriptors (n) as every index of a vocabulary looks them up.

    Their nearest ``cells`` (n, p), ``codes`` (n, p) in each of them, ``margin`` (n, p, 64) of the
    projections from the cells' thresholds, ``projected`` (n, 64) descriptors, and their nearest
    words ``word`` (n, w) with the codes ``word_codes`` (n, w) in the cells of these.
    """

    cells: I32
    margin: F32
    codes: U64
    projected: F32
    word: I32
    word_codes: U64


def look_ups(vocabulary: Vocabulary, descriptors: F32, probes: int) -> list[LookUp]:
    """Descriptors (n, N) to be looked for in their ``probes`` nearest cells, in batches."""
    out = []
    for first in range(0, len(descriptors), QUERIES):
        batch = descriptors[first : first + QUERIES]
        cells = vocabulary.nearest_cells(batch, probes)
        margin = vocabulary.margins(batch, cells)
        projected = grid(vocabulary.projected(batch))
        codes = codes_of(margin)
        words = _nearest_words(projected, cells, codes, vocabulary.children, vocabulary.squares)
        out.append(LookUp(cells, np.abs(margin), codes, projected, *words))
    return out


class Index:
    """Words of a database in segments.

    A look-up compares at most ``budget`` codes and the codes of one word more.
    """

    def __init__(self, vocabulary: Vocabulary, parts: Sequence[Part], budget: int = BUDGET) -> None:
        self.vocabulary = vocabulary
        self.budget = budget
        self.shortlist = SHORTLIST
        self.parts = sorted((p for p in parts if len(p.segment)), key=lambda p: -len(p.segment))
        self._live = np.zeros(WORDS, np.int64)
        for p in self.parts:
            if (p.group >= 0).all():
                self._live += np.diff(p.segment.starts)
            else:
                _count_live(p.segment.starts, p.segment.place, p.group >= 0, self._live)
        self._cell_live = self._live.reshape(256, 256).sum(1)

    @classmethod
    def of_words(
        cls,
        vocabulary: Vocabulary,
        word: NDArray[np.integer],
        code: U64,
        group: NDArray[np.integer],
    ) -> Index:
        """An index in memory of words (n,) and codes (n,) in the submaps ``group`` (n,).

        ``entry`` of matches are their rows.
        """
        n = len(word)
        groups = np.arange(int(group.max()) + 1 if n else 0)
        columns = {
            "word": word,
            "code": code,
            "place": group,
            "row": np.arange(n),
            "centre": np.zeros((n, 3)),
            "yaw": np.zeros(n),
        }
        held = Held("", "", tuple(groups.tolist()), n)
        return cls(vocabulary, [Part(segment_in_memory((held,), columns), groups)])

    def __len__(self) -> int:
        return int(self._live.sum())

    def search(self, descriptors: F32, k: int, probes: int, allowed: Allowed) -> Matches:
        """The ``k`` nearest ``allowed`` words of each descriptor (n, N).

        They are looked for in its ``probes`` nearest cells.
        """
        return self.find(look_ups(self.vocabulary, descriptors, probes), k, allowed)

    def find(self, batches: Sequence[LookUp], k: int, allowed: Allowed) -> Matches:
        """The same for descriptors that :func:`look_ups` prepared."""
        parts = [self._find(batch, k, allowed) for batch in batches]
        if not parts:
            parts = [self._gather(np.zeros((4, 0), np.int64))]
        query = np.concatenate([m.query + i * QUERIES for i, m in enumerate(parts)]).astype(
            np.int32
        )
        rest = (
            np.concatenate([getattr(m, name) for m in parts])
            for name in ("group", "entry", "centre", "yaw", "distance")
        )
        return Matches(query, *rest)

    def _find(self, batch: LookUp, k: int, allowed: Allowed) -> Matches:
        codes = batch.codes
        ranges = _choose(
            batch.projected,
            batch.cells,
            self.vocabulary.children,
            self.vocabulary.squares,
            self._live,
            self._cell_live,
            self.budget,
        )
        count = np.zeros((len(codes), BITS + 2), np.int64)
        limit = np.full(len(codes), BITS)
        scanned: list[NDArray[np.int64]] = []
        candidates: list[tuple[U64, I64]] = []
        for number, p in enumerate(self.parts):
            s = p.segment
            lists = _Lists(s.starts, s.code, s.place, s.row, *allowed.of(p.group))
            m = _scan(codes, ranges, lists, max(self.shortlist, k), count, limit)
            scanned.append(np.concatenate([m, np.full((1, m.shape[1]), number)]))
            candidates.append((s.code[m[1]], p.group[s.place[m[1]]] << 32 | s.row[m[1]]))
        if not scanned:
            return self._gather(np.zeros((4, 0), np.int64))
        m = np.concatenate(scanned, axis=1)
        code, key = (np.concatenate([n[i] for n in candidates]) for i in (0, 1))
        nearest, hamming = _nearest(batch.margin, codes, limit, m[0], m[2], code, key, k)
        query, rank = np.nonzero(nearest >= 0)
        chosen = m[:, nearest[query, rank]]
        return self._gather(np.stack([query, chosen[1], chosen[3], hamming[query, rank]]))

    def _gather(self, chosen: I64) -> Matches:
        """Matches of queries, positions, numbers of parts and distances (4, m)."""
        query, position, number, distance = chosen
        m = len(query)
        group = np.zeros(m, np.int64)
        entry = np.zeros(m, np.int64)
        centre = np.zeros((m, 3))
        yaw = np.zeros(m)
        for i, p in enumerate(self.parts):
            rows = np.flatnonzero(number == i)
            place = position[rows]
            group[rows], entry[rows] = p.group[p.segment.place[place]], p.segment.row[place]
            centre[rows], yaw[rows] = p.segment.centre[place], p.segment.yaw[place]
        return Matches(query.astype(np.int32), group, entry, centre, yaw, distance.astype(np.int32))

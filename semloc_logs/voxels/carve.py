"""Ray carving of one frame: which voxels its rays end in (occupied) and which they pass (free).

The hot loop of fusion. A frame is marked in a grid of its own first, hits winning over passes, and
the marks are then added to hashed blocks: each voxel changes once a frame, as in OctoMap (paper
3.1). The grid lies in memory block by block, so that a block is flushed as one run of 4096 bytes;
the address of a voxel is the sum of three table look-ups, one an axis. One ray is walked for each
end voxel, the ray of its first point: the others would pass nearly the same voxels.

A mark is a byte: bit 0 is set where a ray passed, the bits above hold the weight of the best hit in
sixteenths (0: none).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import F32, F64, I64, U8
from semloc_logs.labels.space import GROUND
from semloc_logs.numerics.hash_table import (
    EMPTY,
    MULTIPLIER,
    SHIFT,
    place_of,
    table_size,
)
from semloc_logs.settings import ResolvedFusion
from semloc_logs.voxels.keys import BLOCK

BITS = 12  # of an address within a block
CLASSES = 20  # of the votes of a frame: 19 and the unlabelled
VOTE_CLASSES = 32  # numbers of classes in a key of the votes: a power of two
FULL_WEIGHT = 16
UNOBSERVED = -128  # in log-odds
MARGIN = 1e-3  # voxels around the rays, as positions from the grid's corner are rounded once more
LEVEL = np.isin(np.arange(256), GROUND)  # classes whose surfaces are level

Votes = NDArray[np.uint32]


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """Observations by the rays of one frame, until the next frame is carved.

    ``grid`` of marks, in runs of 4096 bytes; the ``runs`` (m,) of it that hold any are the blocks
    ``blocks`` (m, 3); ``ends`` (n,) are 2 * address + is_hit of the end voxels, with their
    ``votes`` (n, 20).
    """

    grid: U8
    runs: I64
    blocks: I64
    ends: I64
    votes: Votes


class Grid(NamedTuple):
    """The grid of a frame, for compiled functions.

    ``marks`` in runs of 4096 bytes; ``touched`` (runs,) is 1 where a run holds any; voxel (x, y, z)
    is at byte ``ax[x] + ay[y] + az[z]``.
    """

    marks: U8
    touched: U8
    ax: I64
    ay: I64
    az: I64


class Rays(NamedTuple):
    """Rays in voxels from ``start`` (3,) in the grid, for compiled functions.

    ``offset`` (n, 3) to their ends, cut at ``limit``; ``length`` (n,) before the cut, nan where the
    end is not finite; ``label`` (n,) and ``sigma`` (n,), the standard deviation of the length, of
    their echoes; ``sigma`` (0,) where all are certain.
    """

    start: F64
    offset: F64
    length: F64
    limit: float
    label: U8
    sigma: F32


class Carver:
    """Carves one frame after the other; its grid is as large as the largest frame so far."""

    def __init__(self, fusion: ResolvedFusion) -> None:
        self._per_metre = 1.0 / fusion.voxel_size
        self._limit = fusion.max_range / fusion.voxel_size
        self._marks = np.zeros(0, np.uint8)
        self._used = np.zeros(0, np.int64)

    def marks(
        self,
        points: NDArray[np.floating],
        label: U8,
        origin: NDArray[np.floating],
        sigma: NDArray[np.floating] | None = None,
        map_T_points: F64 | None = None,
    ) -> Marks:
        """Carve ``points`` (n, 3) with classes ``label`` (n,) (255 unknown), seen from ``origin``.

        ``points`` and ``origin`` (3,) are in the map frame unless ``map_T_points`` (4, 4) takes
        them there. Points beyond the maximum range carve and do not hit; points that are not finite
        are left out. ``sigma`` (n,) is the standard deviation of the range in metres: uncertain
        points count less.
        """
        self._marks.reshape(-1, 1 << BITS)[self._used] = 0
        pose = np.eye(4) if map_T_points is None else np.ascontiguousarray(map_T_points, np.float64)
        start = (pose[:3, :3] @ np.asarray(origin, float) + pose[:3, 3]) * self._per_metre
        if not np.isfinite(start).all():
            points = points[:0]
            label = label[:0]
            sigma = None
            start = np.zeros(3)
        offset, length, lowest, highest = to_rays(
            np.ascontiguousarray(points), pose, start, self._per_metre, self._limit
        )

        # the blocks that the rays reach, and their grid
        low = np.floor((lowest - MARGIN) / BLOCK).astype(np.int64) * BLOCK
        counts = np.floor((highest + MARGIN - low) / BLOCK).astype(np.int64) + 1
        nx, ny, nz = counts.tolist()
        grid = self._grid((nx, ny, nz))

        spread = np.zeros(0, np.float32)
        if sigma is not None:
            spread = np.asarray(sigma * self._per_metre, np.float32)
        rays = Rays(start - low, offset, length, self._limit, label, spread)
        votes = np.zeros((len(points), CLASSES), np.uint32)
        ends, carved = mark_ends(grid, rays, votes)
        carve(grid, rays.start, carved)
        self._used = np.flatnonzero(grid.touched)
        blocks = np.stack(np.unravel_index(self._used, (nx, ny, nz)), 1) + low // BLOCK
        return Marks(self._marks, self._used, blocks, ends, votes[: len(ends)])

    def _grid(self, blocks: tuple[int, int, int]) -> Grid:
        """An empty grid of so many blocks along each axis."""
        count = blocks[0] * blocks[1] * blocks[2]
        if count << BITS > len(self._marks):
            self._marks = np.zeros(count << BITS, np.uint8)
        return Grid(self._marks, np.zeros(count, np.uint8), *addresses(blocks))


def addresses(blocks: tuple[int, int, int]) -> tuple[I64, I64, I64]:
    """Tables ax, ay, az of a grid of ``blocks``: voxel (x, y, z) is at ax[x] + ay[y] + az[z]."""
    _, ny, nz = blocks
    outer = (ny * nz, nz, 1)
    inner = (BLOCK * BLOCK, BLOCK, 1)

    def table(axis: int) -> I64:
        i = np.arange(blocks[axis] * BLOCK)
        return np.asarray(((i // BLOCK * outer[axis]) << BITS) + i % BLOCK * inner[axis], np.int64)

    return table(0), table(1), table(2)


@njit(cache=True, nogil=True)
def to_rays(
    points: F32, pose: F64, start: F64, per_metre: float, limit: float
) -> tuple[F64, F64, F64, F64]:
    """Rays in voxels from ``start`` (3,) to ``points`` (n, 3), cut at ``limit``.

    ``pose`` (4, 4) takes the points, metres, into the map. Returns the rays (n, 3); their full
    lengths (n,), nan where a point is not finite; the lowest and highest coordinate (3,) that they
    reach, the start included.
    """
    rays = np.empty((len(points), 3))
    length = np.empty(len(points))
    low = start.copy()
    high = start.copy()
    for i in range(len(points)):
        px = float(points[i, 0])
        py = float(points[i, 1])
        pz = float(points[i, 2])
        x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
        y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
        z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
        dx = x * per_metre - start[0]
        dy = y * per_metre - start[1]
        dz = z * per_metre - start[2]
        far = np.sqrt(dx * dx + dy * dy + dz * dz)
        if not np.isfinite(far):
            length[i] = np.nan
            continue
        if far > limit:
            scale = limit / far
            dx = dx * scale
            dy = dy * scale
            dz = dz * scale
        rays[i] = dx, dy, dz
        length[i] = far
        for k in range(3):
            reached = start[k] + rays[i, k]
            low[k] = min(low[k], reached)
            high[k] = max(high[k], reached)
    return rays, length, low, high


@njit(cache=True, nogil=True)
def _weight_and_reach(length: float, dz: float, sigma: float, level: bool) -> tuple[int, float]:
    """The weight of a hit in sixteenths, and the share of the ray's ``length`` that it carves.

    A length of standard deviation ``sigma`` (voxels) has the weight min(1, 1 / 2 sigma), the share
    of its density that the end voxel holds at most, and carves up to 2 sigma before its end. Rays
    that end on a ``level`` surface carve down to a voxel above it.
    """
    weight = FULL_WEIGHT
    carved = 1.0
    if sigma > 0.5:
        spread = 2 * sigma
        weight = max(1, int(FULL_WEIGHT / spread))
        carved = max(0.0, 1.0 - spread / max(length, 1e-9))
    if level:
        # a ray that grazes the ground runs within its voxels for metres: they stay unobserved
        carved = max(0.0, min(carved, 1.0 - 1.0 / max(abs(dz), 1.0)))
    return weight, carved


@njit(cache=True, nogil=True)
def _place_of_row(rows: NDArray[np.int32], keys: I64, key: int) -> int:
    """Where the row of ``key`` is in ``rows``, or the empty place (-1) for it.

    As :func:`place_of`, but the table holds rows of ``keys``: a third of the memory, where few of
    many rays end in voxels of their own.
    """
    mask = len(rows) - 1
    place = ((key * MULTIPLIER) >> SHIFT) & mask
    while rows[place] >= 0 and keys[rows[place]] != key:
        place = (place + 1) & mask
    return int(place)


@njit(cache=True, nogil=True)
def mark_ends(grid: Grid, rays: Rays, votes: Votes) -> tuple[I64, F64]:
    """Mark the end voxels of all rays; those longer than the limit do not hit.

    Returns 2 * address + is_hit (m,) and the points to carve to (m, 3), one of each end voxel.
    ``votes`` (n, 20) zeros: gets the weights of each class in sixteenths, a row an end.
    """
    marks, touched, ax, ay, az = grid
    start, offset, length, limit, labels, sigma = rays
    n = len(offset)
    rows = np.full(table_size(n), -1, np.int32)
    address_of = np.empty(n, np.int64)
    ends = np.empty((n, 3))
    count, last, row = 0, -1, -1
    for i in range(n):
        if np.isnan(length[i]):
            continue
        dx = offset[i, 0]
        dy = offset[i, 1]
        dz = offset[i, 2]
        is_hit = length[i] <= limit
        weight, carved = FULL_WEIGHT, 1.0
        if is_hit:
            uncertainty = float(sigma[i]) if len(sigma) else 0.0
            weight, carved = _weight_and_reach(length[i], dz, uncertainty, LEVEL[labels[i]])
        address = ax[int(start[0] + dx)] + ay[int(start[1] + dy)] + az[int(start[2] + dz)]
        # a hit and a pass that end in the same voxel are carved both: they carve different parts
        key = address * 2 + is_hit
        if key != last:
            last = key
            touched[address >> BITS] = 1
            place = _place_of_row(rows, address_of, key)
            row = rows[place]
            if row < 0:
                row = count
                rows[place] = row
                address_of[row] = key
                ends[row, 0] = start[0] + dx * carved
                ends[row, 1] = start[1] + dy * carved
                ends[row, 2] = start[2] + dz * carved
                count += 1
        if is_hit:
            if (marks[address] >> 1) < weight:
                marks[address] = weight << 1
            votes[row, min(labels[i], CLASSES - 1)] += weight
        elif marks[address] == 0:
            marks[address] = 1
    return address_of[:count], ends[:count]


@njit(cache=True, nogil=True)
def carve(grid: Grid, start: F64, ends: F64) -> None:
    """Mark the voxels of the rays from ``start`` (3,) to ``ends`` (n, 3), in voxels, as passed.

    Not the end voxels themselves, which :func:`mark_ends` has marked.
    The digital differential analyser of Amanatides and Woo (1987).
    """
    marks, touched, ax, ay, az = grid
    x0 = int(start[0])
    y0 = int(start[1])
    z0 = int(start[2])
    first = ax[x0] + ay[y0] + az[z0]
    for r in range(len(ends)):
        dx = ends[r, 0] - start[0]
        dy = ends[r, 1] - start[1]
        dz = ends[r, 2] - start[2]
        x, y, z = x0, y0, z0
        x1 = int(ends[r, 0])
        y1 = int(ends[r, 1])
        z1 = int(ends[r, 2])
        sx = 1 if dx > 0 else -1
        sy = 1 if dy > 0 else -1
        sz = 1 if dz > 0 else -1
        # an axis that is done waits at infinity: rounding can then never carry the walk past its
        # end
        tx = ((x + (dx > 0)) - start[0]) / dx if x != x1 else np.inf
        ty = ((y + (dy > 0)) - start[1]) / dy if y != y1 else np.inf
        tz = ((z + (dz > 0)) - start[2]) / dz if z != z1 else np.inf
        stepx = sx / dx if x != x1 else 0.0
        stepy = sy / dy if y != y1 else 0.0
        stepz = sz / dz if z != z1 else 0.0
        address = first
        for _ in range(abs(x1 - x) + abs(y1 - y) + abs(z1 - z)):
            marks[address] |= 1
            touched[address >> BITS] = 1
            if tx <= ty and tx <= tz:
                address += ax[x + sx] - ax[x]
                x += sx
                tx = tx + stepx if x != x1 else np.inf
            elif ty <= tz:
                address += ay[y + sy] - ay[y]
                y += sy
                ty = ty + stepy if y != y1 else np.inf
            else:
                address += az[z + sz] - az[z]
                z += sz
                tz = tz + stepz if z != z1 else np.inf


class LogOddsUnits(NamedTuple):
    """Log-odds in units of 1/20: added by a hit, taken by a miss, and the clamp."""

    hit: int
    miss: int
    low: int
    high: int


@njit(cache=True, nogil=True)
def flush(marks: U8, runs: I64, slots: I64, log_odds: NDArray[np.int8], by: LogOddsUnits) -> None:
    """Add the marks of ``runs`` (m,) of 4096 bytes to rows ``slots`` (m,) of ``log_odds``.

    ``log_odds`` (slots, 4096) int8 in units of 1/20, clamped; -128 is unobserved. A hit adds its
    weight's share of ``by.hit``, at least 1.
    """
    gain = np.empty(256, np.int64)
    for mark in range(256):
        hit = (by.hit * (mark >> 1) + FULL_WEIGHT // 2) // FULL_WEIGHT
        gain[mark] = max(1, hit) if mark > 1 else -by.miss
    for b in range(len(runs)):
        row = log_odds[slots[b]]
        run = marks[runs[b] << BITS : (runs[b] + 1) << BITS]
        for n in range(len(run)):
            mark = run[n]
            if mark:
                old = 0 if row[n] == UNOBSERVED else int(row[n])
                row[n] = min(max(old + gain[mark], by.low), by.high)


class VoteTable(NamedTuple):
    """Votes by voxel and class: a hash table of ``keys``, with their ``counts``.

    A key is (slot * 4096 + cell) * 32 + class.
    """

    keys: I64
    counts: Votes


def vote_table(places: int) -> VoteTable:
    """An empty table; ``places`` is a power of two."""
    return VoteTable(np.full(places, EMPTY, np.int64), np.zeros(places, np.uint32))


@njit(cache=True, nogil=True)
def add_votes(table: VoteTable, ends: I64, voxel_votes: Votes, slot_of_run: I64) -> int:
    """Add a frame's votes to a table with room for them; returns how many keys are new.

    A class gets at least one vote where it has any weight.
    """
    new = 0
    for r in range(len(ends)):
        if not ends[r] & 1:
            continue
        address = ends[r] >> 1
        voxel = (slot_of_run[address >> BITS] << BITS) + (address & ((1 << BITS) - 1))
        for label in range(CLASSES):
            weight = voxel_votes[r, label]
            if weight == 0:
                continue
            key = voxel * VOTE_CLASSES + label
            place = place_of(table.keys, key)
            if table.keys[place] == EMPTY:
                table.keys[place] = key
                new += 1
            table.counts[place] += (weight + FULL_WEIGHT - 1) // FULL_WEIGHT
    return new


@njit(cache=True, nogil=True)
def rehash(table: VoteTable, larger: VoteTable) -> None:
    """Move a table into a larger, empty one."""
    for i in range(len(table.keys)):
        if table.keys[i] != EMPTY:
            place = place_of(larger.keys, table.keys[i])
            larger.keys[place] = table.keys[i]
            larger.counts[place] = table.counts[i]

"""Ray carving of one frame: which voxels its rays end in (occupied) and which they pass (free). The
hot loop of fusion.

A frame is marked in a grid of its own first, hits winning over passes, and the marks are then added
to hashed blocks: each voxel changes once a frame, as in OctoMap (paper 3.1). The grid lies in
memory block by block, so that a block is flushed as one run of 4096 bytes; the address of a voxel
is the sum of three table look-ups, one an axis. One ray is walked for each end voxel, that of its
first point: the others would pass nearly the same voxels.

A mark is a byte: bit 0 says that a ray passed, the bits above hold the weight of the best hit in
sixteenths (0: none).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.labels.space import GROUND
from semloc_logs.settings import ResolvedFusion
from semloc_logs.voxels.keys import BLOCK

BITS = 12  # of an address within a block
CLASSES = 20  # of the votes of a frame: 19 and the unlabelled
FULL_WEIGHT = 16

U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


LEVEL = np.isin(np.arange(256), GROUND)  # classes whose surfaces are level


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """What the rays of one frame say, until the next frame is carved: ``grid`` of marks, in runs of
    4096 bytes; ``runs`` (m,) of it hold any, those of the blocks ``blocks`` (m, 3); ``ends`` (n,) 2
    * address + is_hit of the end voxels and their ``votes`` (n, 20).
    """

    grid: U8
    runs: I64
    blocks: I64
    ends: I64
    votes: NDArray[np.uint32]


class Carver:
    """Carves one frame after the other; its grid is as large as the largest frame so far."""

    def __init__(self, fusion: ResolvedFusion) -> None:
        self._per_metre = 1.0 / fusion.voxel_size
        self._limit = fusion.max_range / fusion.voxel_size
        self._grid, self._used = np.zeros(0, np.uint8), np.zeros(0, np.int64)

    def marks(
        self,
        points: NDArray[np.floating],
        label: U8,
        origin: NDArray[np.floating],
        sigma: NDArray[np.floating] | None = None,
        map_T_points: NDArray[np.float64] | None = None,
    ) -> Marks:
        """Carve ``points`` (n, 3) with classes ``label`` (n,) (255 unknown), seen from ``origin``
        (3,); both are in the map frame unless ``map_T_points`` (4, 4) takes them there.

        Points beyond the maximum range carve and do not hit; points that are not finite are left
        out. ``sigma`` (n,) is the standard deviation of the range in metres: uncertain points count
        less.
        """
        self._grid.reshape(-1, 1 << BITS)[self._used] = 0
        pose = np.eye(4) if map_T_points is None else np.ascontiguousarray(map_T_points, np.float64)
        start = (pose[:3, :3] @ np.asarray(origin, float) + pose[:3, 3]) * self._per_metre
        if not np.isfinite(start).all():
            points = points[:0]
            label = label[:0]
            sigma = None
            start = np.zeros(3)
        rays, length, lowest, highest = to_rays(
            np.ascontiguousarray(points), pose, start, self._per_metre, self._limit
        )
        # a thousandth of a voxel to spare, as positions from the corner are rounded once more
        low = np.floor((lowest - 1e-3) / BLOCK).astype(np.int64) * BLOCK
        blocks: tuple[int, int, int] = tuple(
            (np.floor((highest + 1e-3 - low) / BLOCK).astype(np.int64) + 1).tolist()
        )
        count = blocks[0] * blocks[1] * blocks[2]
        if count << BITS > len(self._grid):
            self._grid = np.zeros(count << BITS, np.uint8)
        tables = addresses(blocks)
        touched = np.zeros(count, np.uint8)
        votes = np.zeros((len(points), CLASSES), np.uint32)
        spread = (
            np.zeros(0, np.float32)
            if sigma is None
            else np.asarray(sigma * self._per_metre, np.float32)
        )
        ends, carved = mark_ends(
            self._grid,
            touched,
            tables,
            rays,
            length,
            label,
            spread,
            LEVEL,
            start - low,
            self._limit,
            votes,
        )
        carve(self._grid, touched, tables, start - low, carved)
        self._used = np.flatnonzero(touched)
        found = np.stack(np.unravel_index(self._used, blocks), 1) + low // BLOCK
        return Marks(self._grid, self._used, found, ends, votes[: len(ends)])


def addresses(blocks: tuple[int, int, int]) -> tuple[I64, I64, I64]:
    """Tables for the axes of a grid of ``blocks``: voxel (x, y, z) is at byte ``ax[x] + ay[y] +
    az[z]``.
    """
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
    """Rays in voxels: (n, 3) from ``start`` (3,) to ``points`` (n, 3) metres that ``pose`` (4, 4)
    takes into the map, cut at ``limit``; their full lengths (n,), nan where a point is not finite;
    lowest and highest coordinate (3,) that they reach, the start included.
    """
    rays = np.empty((len(points), 3))
    length = np.empty(len(points))
    low = start.copy()
    high = start.copy()
    for i in range(len(points)):
        px = float(points[i, 0])
        py = float(points[i, 1])
        pz = float(points[i, 2])
        dx = (pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]) * per_metre - start[
            0
        ]
        dy = (pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]) * per_metre - start[
            1
        ]
        dz = (pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]) * per_metre - start[
            2
        ]
        far = np.sqrt(dx * dx + dy * dy + dz * dz)
        if not np.isfinite(far):
            length[i] = np.nan
            continue
        if far > limit:
            scale = limit / far
            dx = dx * scale
            dy = dy * scale
            dz = dz * scale
        rays[i, 0], rays[i, 1], rays[i, 2], length[i] = dx, dy, dz, far
        low[0], low[1], low[2] = (
            min(low[0], start[0] + dx),
            min(low[1], start[1] + dy),
            min(low[2], start[2] + dz),
        )
        high[0], high[1], high[2] = (
            max(high[0], start[0] + dx),
            max(high[1], start[1] + dy),
            max(high[2], start[2] + dz),
        )
    return rays, length, low, high


@njit(cache=True, nogil=True)
def _slot(table: NDArray[np.int32], addresses_of: I64, address: int) -> int:
    """Where ``address`` is in an open hash table of ray numbers, or the empty place (-1) for it."""
    mask = len(table) - 1
    h = (address * 0x9E3779B1 >> 7) & mask
    while table[h] >= 0 and addresses_of[table[h]] != address:
        h = (h + 1) & mask
    return h


@njit(cache=True, nogil=True)
def mark_ends(
    marks: U8,
    touched: U8,
    tables: tuple[I64, I64, I64],
    rays: F64,
    length: F64,
    label: U8,
    sigma: F32,
    level: NDArray[np.bool_],
    start: F64,
    limit: float,
    voxel_votes: NDArray[np.uint32],
) -> tuple[I64, F64]:
    """Mark the end voxels of all rays; returns 2 * address + is_hit (m,) and the ends to carve to
    (m, 3), one of each end voxel.

    ``rays`` (n, 3) and ``length`` (n,) as :func:`to_rays` gives them, from ``start`` (3,) in the
    grid, all in voxels; those longer than ``limit`` do not hit. ``label`` (n,); ``sigma`` (n,) in
    voxels or (0,): a range of standard deviation sigma hits with the weight min(1, 1 / 2 sigma),
    the share of its density that the end voxel holds at most, and carves up to 2 sigma before its
    end. ``level`` (256,) says of which classes the surfaces are level: rays that end there carve
    down to a voxel above them. ``voxel_votes`` (n, 20) zeros: gets the weights of each class in
    sixteenths, a row a ray.
    """
    ax, ay, az = tables
    n = len(rays)
    size = 1024
    while size < 2 * n:
        size *= 2
    hashed = np.full(size, -1, np.int32)
    address_of = np.empty(n, np.int64)
    ends = np.empty((n, 3))
    count, last, row = 0, -1, -1
    for i in range(n):
        if np.isnan(length[i]):
            continue
        dx = rays[i, 0]
        dy = rays[i, 1]
        dz = rays[i, 2]
        is_hit = length[i] <= limit
        weight, carved = FULL_WEIGHT, 1.0
        if is_hit and len(sigma) and sigma[i] > 0.5:
            spread = 2 * sigma[i]
            weight = max(1, int(FULL_WEIGHT / spread))
            carved = max(0.0, 1.0 - spread / max(length[i], 1e-9))
        if is_hit and level[label[i]]:
            # a ray that grazes the ground runs within its voxels for metres: it says nothing about
            # them
            carved = max(0.0, min(carved, 1.0 - 1.0 / max(abs(dz), 1.0)))
        x = start[0] + dx
        y = start[1] + dy
        z = start[2] + dz
        address = ax[int(x)] + ay[int(y)] + az[int(z)]
        # one ray for a hit and one for a pass that end in the same voxel: they differ in what they
        # carve
        key = address * 2 + is_hit
        if key != last:
            last = key
            touched[address >> BITS] = 1
            h = _slot(hashed, address_of, key)
            row = hashed[h]
            if row < 0:
                row = count
                hashed[h] = row
                address_of[row] = key
                ends[row, 0], ends[row, 1], ends[row, 2] = (
                    start[0] + dx * carved,
                    start[1] + dy * carved,
                    start[2] + dz * carved,
                )
                count += 1
        if is_hit:
            if (marks[address] >> 1) < weight:
                marks[address] = weight << 1
            voxel_votes[row, min(label[i], CLASSES - 1)] += weight
        elif marks[address] == 0:
            marks[address] = 1
    return address_of[:count], ends[:count]


@njit(cache=True, nogil=True)
def carve(marks: U8, touched: U8, tables: tuple[I64, I64, I64], start: F64, ends: F64) -> None:
    """Mark the voxels of the rays from ``start`` (3,) to ``ends`` (n, 3), both in voxels within the
    grid, as passed, and their blocks in ``touched``; not the end voxels themselves, which
    :func:`mark_ends` has marked.

    The digital differential analyser of Amanatides and Woo (1987).
    """
    ax, ay, az = tables
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


@njit(cache=True, nogil=True)
def flush(
    marks: U8,
    runs: I64,
    slots: I64,
    log_odds: NDArray[np.int8],
    hit: int,
    miss: int,
    low: int,
    high: int,
) -> None:
    """Add the marks of ``runs`` (m,) of 4096 bytes to rows ``slots`` (m,) of ``log_odds`` (slots,
    4096) int8 in units of 1/20, clamped to [low, high]; -128 is unobserved. A hit adds its weight's
    share of ``hit``, at least 1.
    """
    gain = np.empty(256, np.int64)
    for mark in range(256):
        gain[mark] = (
            max(1, (hit * (mark >> 1) + FULL_WEIGHT // 2) // FULL_WEIGHT) if mark > 1 else -miss
        )
    for b in range(len(runs)):
        row = log_odds[slots[b]]
        run = marks[runs[b] << BITS : (runs[b] + 1) << BITS]
        for n in range(len(run)):
            mark = run[n]
            if mark:
                old = int(row[n])
                row[n] = min(max((0 if old == -128 else old) + gain[mark], low), high)


@njit(cache=True, nogil=True)
def _place(keys: I64, key: int) -> int:
    """Where ``key`` is in an open hash table of :func:`add_votes`, or the empty place for it."""
    mask = len(keys) - 1
    h = ((key * 0x9E3779B97F4A7C1) >> 20) & mask
    while keys[h] >= 0 and keys[h] != key:
        h = (h + 1) & mask
    return h


@njit(cache=True, nogil=True)
def add_votes(
    keys: I64,
    counts: NDArray[np.uint32],
    used: int,
    ends: I64,
    voxel_votes: NDArray[np.uint32],
    slot_of_run: I64,
) -> int:
    """Add a frame's votes to a hash table of ``keys`` ((slot * 4096 + cell) * 32 + class, -1 empty)
    and ``counts``; returns how many places are used. The table must be large enough. A class gets
    at least one vote where it has any weight.
    """
    for r in range(len(ends)):
        if not ends[r] & 1:
            continue
        address = ends[r] >> 1
        voxel = (slot_of_run[address >> BITS] << BITS) + (address & ((1 << BITS) - 1))
        for label in range(CLASSES):
            weight = voxel_votes[r, label]
            if weight == 0:
                continue
            key = voxel * 32 + label
            h = _place(keys, key)
            if keys[h] < 0:
                keys[h] = key
                used += 1
            counts[h] += (weight + FULL_WEIGHT - 1) // FULL_WEIGHT
    return used


@njit(cache=True, nogil=True)
def rehash(
    keys: I64, counts: NDArray[np.uint32], new_keys: I64, new_counts: NDArray[np.uint32]
) -> None:
    """Move a table of :func:`add_votes` into a larger, empty one."""
    for i in range(len(keys)):
        if keys[i] >= 0:
            h = _place(new_keys, keys[i])
            new_keys[h], new_counts[h] = keys[i], counts[i]

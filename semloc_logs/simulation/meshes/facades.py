"""Walls with recessed windows, doors, shop windows and garage doors, and what hangs on walls:
balconies, bays, awnings, porches, pipes.

Walls run from a plan point to another with their outside on the right, so anticlockwise round a
house.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.simulation.meshes.shapes import Rng, boxes, grid, joined, loft
from semloc_logs.simulation.meshes.world import Mesh, cylinder, place, quads

FOOT = -1.5  # m; walls reach into the ground, which slopes


@dataclass(frozen=True, slots=True)
class Openings:
    """Windows of a house, lengths in metres: height of a storey, pitch along the wall, width, sill
    and head over the floor, recess.
    """

    storey: float
    pitch: float
    width: float
    sill: float
    head: float
    recess: float
    ground: str  # "windows", "shop", "garage" or "blank"


def openings(rng: Rng, ground: str) -> Openings:
    """Windows as one house has them."""
    storey = float(rng.uniform(2.6, 3.3))
    width = float(rng.uniform(0.8, 1.5) if rng.random() < 0.75 else rng.uniform(1.5, 2.4))
    sill = float(rng.uniform(0.7, 1.05) if rng.random() < 0.8 else 0.1)
    head = min(storey - 0.35, sill + float(rng.uniform(1.2, 1.7)) + (0.6 if sill < 0.5 else 0.0))
    return Openings(
        storey,
        width + float(rng.uniform(0.7, 2.2)),
        width,
        sill,
        head,
        float(rng.uniform(0.06, 0.3)),
        ground,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Panes:
    """The panes of a wall at ``columns`` (k, 2) along it and ``rows`` (m, 2) up, in metres.

    They lie ``recess`` metres deep where they are ``opened`` (m, k).
    """

    columns: F64
    rows: F64
    opened: NDArray[np.bool_]
    recess: float


def wall(start: F64, end: F64, low: float, high: float, panes: Panes) -> Mesh:
    """A wall from ``low`` to ``high`` metres with panes."""
    way = end - start
    length = float(np.hypot(*way))
    way = way / max(length, 1e-9)
    inward = np.array([-way[1], way[0]])
    c = _wall_cells(length, low, high, panes)
    s = c[:, [0, 1, 1, 0]]
    z = c[:, [2, 2, 3, 3]]
    faces = [np.stack([s, np.repeat(c[:, 4:], 4, axis=1), z], axis=-1)]

    # the four sides of every recess
    deep = np.flatnonzero(c[:, 4] > 0)
    front = faces[0][deep] * [1, 0, 1]
    faces += [
        np.stack([front[:, a], front[:, b], faces[0][deep][:, b], faces[0][deep][:, a]], axis=1)
        for a, b in ((1, 0), (2, 1), (3, 2), (0, 3))
    ]

    local = np.concatenate(faces)
    corners = np.empty_like(local)
    corners[..., :2] = start + local[..., :1] * way + local[..., 1:2] * inward
    corners[..., 2] = local[..., 2]
    return quads(corners)


def _wall_cells(length: float, low: float, high: float, panes: Panes) -> F64:
    """The rectangles (n, 5) that a wall is made of: from, to, bottom, top and depth, in metres."""
    columns = panes.columns
    rows = panes.rows
    left = np.concatenate([[0.0], columns[:, 1]])
    right = np.concatenate([columns[:, 0], [length]])
    below = np.concatenate([[low], rows[:, 1]])
    above = np.concatenate([rows[:, 0], [high]])
    cells = [
        np.column_stack(
            [np.zeros(len(below)), np.full(len(below), length), below, above, np.zeros(len(below))]
        )
    ]
    if len(rows) and len(columns):
        k, m = grid(np.arange(len(columns) + 1), np.arange(len(rows)))
        cells.append(np.column_stack([left[k], right[k], rows[m, 0], rows[m, 1], np.zeros(len(k))]))
        k, m = grid(np.arange(len(columns)), np.arange(len(rows)))
        depth = np.where(panes.opened[m, k], panes.recess, 0.0)
        cells.append(np.column_stack([columns[k], rows[m], depth]))
    elif len(rows):
        cells.append(
            np.column_stack(
                [np.zeros(len(rows)), np.full(len(rows), length), rows, np.zeros(len(rows))]
            )
        )
    c: F64 = np.concatenate(cells)
    wide = c[:, 1] - c[:, 0] > 1e-6
    tall = c[:, 3] - c[:, 2] > 1e-6
    return np.asarray(c[wide & tall])


def columns_of(length: float, pitch: float, width: float, margin: float = 0.6) -> F64:
    """Evenly spread openings (k, 2) of a width along a wall."""
    count = int((length - 2 * margin + pitch - width) // pitch)
    if count < 1:
        return np.zeros((0, 2))
    centre = length / 2 + (np.arange(count) - (count - 1) / 2) * min(
        pitch, (length - 2 * margin) / count
    )
    return np.column_stack([centre - width / 2, centre + width / 2])


def side_wall(rng: Rng, start: F64, end: F64, height: float, o: Openings, share: float) -> Mesh:
    """All storeys of a wall with a share of the windows that there could be."""
    columns = columns_of(float(np.hypot(*(end - start))), o.pitch, o.width)
    floors = np.arange(0, max(1, int((height + 0.5) / o.storey))) * o.storey
    rows = np.column_stack([floors + o.sill, np.minimum(floors + o.head, height - 0.2)])
    rows = rows[rows[:, 1] - rows[:, 0] > 0.3]
    opened = np.broadcast_to(rng.random(len(columns)) < share, (len(rows), len(columns)))
    return wall(start, end, FOOT, height, Panes(columns, rows, opened, o.recess))


def front_wall(rng: Rng, start: F64, end: F64, height: float, o: Openings) -> tuple[Mesh, F64, F64]:
    """A front with its ground floor apart: a door and windows, shop windows or a garage; its mesh,
    columns (k, 2) and upper floors (m,).
    """
    length = float(np.hypot(*(end - start)))
    columns = columns_of(length, o.pitch, o.width)
    top = min(o.storey, height)
    floors: F64 = np.arange(1.0, max(1, int((height + 0.5) / o.storey))) * o.storey
    rows = np.column_stack([floors + o.sill, np.minimum(floors + o.head, height - 0.2)])
    rows = rows[rows[:, 1] - rows[:, 0] > 0.3]
    meshes = []
    if height > top + 0.1:
        every = np.ones((len(rows), len(columns)), bool)
        meshes.append(wall(start, end, top, height, Panes(columns, rows, every, o.recess)))
    ground = columns
    if o.ground == "shop":
        ground = columns_of(length, rng.uniform(2.2, 4.5), rng.uniform(1.6, 2.1), 0.4)
        levels = np.array([[0.05, 0.4], [0.4, top - 0.45]])
    elif o.ground == "garage" and length > 3.2:
        ground = columns_of(length, rng.uniform(2.8, 3.2), 2.4, 0.3)
        levels = np.array([[-0.1, 0.2], [0.2, 2.1]])
    else:
        levels = (
            np.array([[0.02, o.sill], [o.sill, max(o.head, 2.05)]])
            if o.sill < top - 0.5
            else np.array([[0.02, 0.3], [0.3, 2.0]])
        )
    levels = np.minimum(levels, top - 0.15)
    opened = np.ones((2, len(ground)), bool)
    if o.ground == "windows":
        opened[0] = False
    if len(ground):
        opened[0, int(rng.integers(len(ground)))] = True
    if o.ground == "blank":
        opened[:] = False
    deep = max(o.recess, 0.25) if o.ground == "shop" else o.recess
    meshes.append(wall(start, end, FOOT, top, Panes(ground, levels, opened, deep)))
    return joined(*meshes), columns, floors[: len(rows)]


def balconies(rng: Rng, columns: F64, floors: F64, x0: float, y: float, deep: float) -> Mesh:
    """Balconies with railings before columns (k, 2) of windows from x0 on, on every floor, of a
    front at y.
    """
    keep = columns[rng.random(len(columns)) < rng.choice([0.35, 0.7, 1.0])]
    if not len(keep) or not len(floors):
        return boxes(np.zeros((0, 6)))
    k, z = grid(x0 + keep.mean(1), floors)
    width = float(np.clip(keep[0, 1] - keep[0, 0] + rng.uniform(0.5, 1.6), 1.4, 4.0))
    solid = float(rng.uniform(0.8, 1.0))
    n = len(k)

    def rows(a: float, b: float, c: float, dx: float, dy: float, dz: float) -> F64:
        return np.column_stack(
            [np.broadcast_to([a, b, c], (n, 3)), k + dx, np.full(n, y + dy), z + dz]
        )

    floor = rows(width, deep, 0.16, 0, -deep / 2, -0.1)
    face = rows(width, 0.05, solid, 0, 0.03 - deep, 0.06)
    sides = [rows(0.05, deep, solid, s * width / 2, -deep / 2, 0.06) for s in (-1, 1)]
    return boxes(np.concatenate([floor, face, *sides]))


def trim(rng: Rng, columns: F64, floors: F64, x0: float, y: float, o: Openings) -> Mesh:
    """Sills, and shutters or lintels, round the windows of a front at y."""
    if not len(columns):
        return boxes(np.zeros((0, 6)))
    k, z = grid(x0 + columns.mean(1), floors if o.ground == "shop" else np.append(0.0, floors))
    n = len(k)
    tall = o.head - o.sill

    def rows(a: float, b: float, c: float, dx: float, dz: float) -> F64:
        return np.column_stack(
            [np.broadcast_to([a, b, c], (n, 3)), k + dx, np.full(n, y - b / 2), z + dz]
        )

    pieces = [rows(o.width + 0.2, rng.uniform(0.08, 0.2), 0.06, 0, o.sill - 0.06)]
    if rng.random() < 0.3:
        pieces += [rows(0.45 * o.width, 0.05, tall, s * 0.75 * o.width, o.sill) for s in (-1, 1)]
    elif rng.random() < 0.4:
        pieces.append(rows(o.width + 0.3, 0.1, 0.18, 0, o.head))
    return boxes(np.concatenate(pieces))


def bay(rng: Rng, x: float, y: float, width: float, deep: float, height: float) -> Mesh:
    """A bay window before a front at y: a box or a trapezium on the plan, with a lean-to or pointed
    roof.
    """
    slant = float(rng.choice([0.0, 0.35, 0.6])) * deep
    w = width / 2
    shape = np.array([[-w, 0.05], [-w + slant, -deep], [w - slant, -deep], [w, 0.05]])
    plan = np.add(shape, [x, y])
    walls = [
        wall(
            a,
            b,
            FOOT,
            height,
            Panes(
                columns_of(float(np.hypot(*(b - a))), 1.3, 0.9, 0.1),
                np.array([[0.8, min(2.1, height - 0.3)]]),
                np.ones((1, 9), bool),
                0.08,
            ),
        )
        for a, b in pairwise(plan)
    ]
    rim = np.column_stack([shape * 1.12 + np.array([x, y]), np.full(4, height)])
    ridge = np.column_stack(
        [shape * [0.5, 0.05] + np.array([x, y]), np.full(4, height + rng.uniform(0.1, 0.9))]
    )
    return joined(*walls, loft(np.stack([rim, ridge])))


def awning(width: float, depth: float, height: float) -> Mesh:
    """A slanting sheet hanging from a wall at y = 0 towards -y."""
    w = width / 2
    return quads(
        np.array(
            [
                [
                    [-w, 0, height + 0.5],
                    [w, 0, height + 0.5],
                    [w, -depth, height],
                    [-w, -depth, height],
                ]
            ]
        )
    )


def porch(rng: Rng, x: float, y: float) -> Mesh:
    """A roof over a door in a front at y, on two posts or on brackets, over steps."""
    deep = float(rng.uniform(0.7, 1.7))
    wide = float(rng.uniform(1.3, 2.6))
    high = float(rng.uniform(2.25, 2.6))
    steps = [[wide, deep, 0.16, x, y - deep / 2, 0.0], [wide, 0.3, 0.4, x, y - 0.1, -0.3]]
    lid = boxes(np.array([[wide, deep, 0.12, x, y - deep / 2, high], *steps]))
    if rng.random() < 0.5:
        w = wide / 2 + 0.1
        eaves = np.array(
            [[x - w, y, high + 0.1], [x, y, high + 0.1 + 0.6 * w], [x + w, y, high + 0.1]]
        )
        lid = joined(lid, loft(np.stack([eaves, eaves - [0, deep + 0.1, 0]])))
    if deep > 1.0:
        return joined(
            lid,
            *(
                place(cylinder(0.08, high + 0.1, 6), x + s * (wide / 2 - 0.12), y - deep + 0.12)
                for s in (-1, 1)
            ),
        )
    return lid


def pipes(rng: Rng, x0: float, x1: float, y: float, height: float) -> Mesh:
    """Downpipes at the ends of a front at y and a gutter along its top."""
    rows = [
        [0.1, 0.1, height, x, y - 0.08, 0.0] for x in (x0 + 0.15, x1 - 0.15) if rng.random() < 0.7
    ]
    rows.append([x1 - x0, 0.12, 0.12, (x0 + x1) / 2, y - 0.08, height - 0.08])
    return boxes(np.array(rows))

"""Bridges over a road: deck, railings, abutments and the banks behind them."""

from __future__ import annotations

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.simulation.meshes.objects import Parts
from semloc_logs.simulation.meshes.world import (
    FENCE,
    ROAD,
    TERRAIN,
    UNLABELLED,
    WALL,
    Mesh,
    box,
    cylinder,
    merge,
    place,
    upright_quads,
)

Rng = np.random.Generator
BANK = 14.0  # m of embankment behind an abutment


def bridge(rng: Rng, half_span: float) -> Parts:
    """A bridge along y over a road along x, its abutments at y = +-``half_span``; bridges have no
    class, what they consist of has.
    """
    wide = rng.uniform(3.5, 10.0)
    clear = rng.uniform(4.4, 5.6)
    thick = rng.uniform(0.5, 1.1)
    end = half_span + BANK
    top = clear + thick
    parts: Parts = [
        (box(wide, 2 * end, thick, z=clear), UNLABELLED),
        (box(wide - 0.8, 2 * end, 0.02, z=top), ROAD),
    ]
    sides = np.array([[x, s * end] for x in (-wide / 2 + 0.1, wide / 2 - 0.1) for s in (-1, 1)])
    if rng.random() < 0.4:
        parts.append((upright_quads(sides[::2], sides[1::2], top, top + 0.9), WALL))
    else:
        posts = np.arange(-end, end + 0.1, 2.0)
        rails = [
            upright_quads(sides[::2], sides[1::2], top + z, top + z + 0.07)
            for z in (0.3, 0.65, 1.0)
        ]
        parts.append(
            (
                merge(
                    *rails,
                    *[box(0.07, 0.07, 1.05, x, y, top) for x in sides[::2, 0] for y in posts],
                ),
                FENCE,
            )
        )
    parts.append(
        (
            merge(*[box(wide, 1.0, clear + 1.5, y=s * (half_span + 0.5), z=-1.5) for s in (-1, 1)]),
            WALL,
        )
    )
    if half_span > 8 and rng.random() < 0.5:  # piers where the pavements are
        foot = cylinder(0.35, clear + 1, 10, z=-1.0)
        corners = [
            (x, y) for x in (-wide / 3, wide / 3) for y in (-half_span + 1.2, half_span - 1.2)
        ]
        parts.append((merge(*[place(foot, x, y) for x, y in corners]), UNLABELLED))
    parts.append((merge(*[_bank(s, half_span, wide, top) for s in (-1.0, 1.0)]), TERRAIN))
    return parts


def _bank(sign: float, edge: float, wide: float, top: float) -> Mesh:
    """Slopes to both sides of the deck behind an abutment, and one that closes the end."""
    foot = wide / 2 + 1.4 * top
    far = edge + BANK
    y0 = sign * (edge + 1.0)
    y1 = sign * far
    y2 = sign * (far + 1.4 * top)
    plan = np.array(
        [
            [-wide / 2, y0, top], [-wide / 2, y1, top], [wide / 2, y1, top], [wide / 2, y0, top],
            [-foot, y0, -1.5], [-foot, y1, -1.5], [-wide / 2, y2, -1.5],
            [wide / 2, y2, -1.5], [foot, y1, -1.5], [foot, y0, -1.5],
        ]
    )  # fmt: skip
    faces = [
        [0, 1, 5],
        [0, 5, 4],
        [3, 9, 8],
        [3, 8, 2],
        [1, 2, 7],
        [1, 7, 6],
        [1, 6, 5],
        [2, 8, 7],
        [0, 4, 9],
        [0, 9, 3],
    ]
    return Mesh(plan, np.array(faces, np.int64))


def footprint(half_span: float) -> F64:
    """Plan points (n, 2) of what a bridge and its banks stand on, the road below left out; some
    metres more than any needs.
    """
    x, y = np.meshgrid(
        np.arange(-14.0, 14.1, 0.4), np.arange(half_span + 0.1, half_span + BANK + 9.0, 0.4)
    )
    one = np.column_stack([x.ravel(), y.ravel()])
    return np.concatenate([one, one * [1, -1]])

"""Fences, walls and guard rails along plan paths (n, 2); they stand on z = 0 and are draped over
the ground.
"""

from __future__ import annotations

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.simulation.meshes.shapes import Parts, Rng, boxes, joined, resample, tubes
from semloc_logs.simulation.meshes.world import FENCE, WALL, Mesh, ribbon, upright_quads

FENCES = ("picket", "board", "rails", "bars", "mesh", "lattice", "gabions")


def fence(rng: Rng, path: F64, kind: str | None = None) -> Parts:
    """A fence of one of ``FENCES``, at random by default; wire mesh lets most rays pass."""
    drawn = str(rng.choice(FENCES[:-1]))
    kind = kind or drawn
    height = float(rng.uniform(0.8, 1.9))
    pitch = 2.5 if kind in ("mesh", "board") else 2.0
    posts = resample(path, pitch)
    meshes = [_posts(posts, 0.06 if kind in ("mesh", "bars") else 0.1, height + 0.08)]
    a = posts[:-1]
    b = posts[1:]
    if kind == "board":
        gap = rng.uniform(0.0, 0.1)
        meshes += [
            upright_quads(a, b, float(z), min(float(z) + 0.3 - gap, height))
            for z in np.arange(0.05, height - 0.1, 0.3)
        ]
        return [(joined(*meshes), FENCE)]
    if kind == "gabions":
        return [
            (
                ribbon(
                    posts, np.array([[-0.25, -0.2], [0.25, -0.2], [0.25, height], [-0.25, height]])
                ),
                WALL,
            )
        ]
    levels: F64 = {
        "rails": np.linspace(0.35, height, 3, dtype=np.float64),
        "mesh": np.arange(0.08, height, 0.2),
        "lattice": np.array([0.1, height]),
    }.get(kind, np.array([0.2, height - 0.12]))
    thin = 0.008 if kind == "mesh" else 0.045
    meshes += [upright_quads(a, b, float(z) - thin, float(z) + thin) for z in levels]
    if kind in ("picket", "bars", "mesh"):
        step, width = {"picket": (0.19, 0.1), "bars": (0.14, 0.03), "mesh": (0.25, 0.012)}[kind]
        fine = resample(path, step)
        along = np.diff(fine, axis=0) * min(1.0, width / step)
        meshes.append(
            upright_quads(
                fine[:-1],
                fine[:-1] + along,
                0.05,
                height + 0.03 * np.arange(len(along), dtype=np.float64) % 0.06,
            )
        )
    if kind == "lattice":
        fine = resample(path, 0.3)
        bottom = np.column_stack([fine, np.full(len(fine), 0.1)])
        top = np.column_stack([fine, np.full(len(fine), height)])
        meshes.append(
            tubes(
                np.concatenate([bottom[:-3], top[:-3]]),
                np.concatenate([top[3:], bottom[3:]]),
                0.015,
                0.015,
                3,
            )
        )
    return [(joined(*meshes), FENCE)]


def _posts(points: F64, width: float, height: float) -> Mesh:
    n = len(points)
    size = np.broadcast_to(np.array([width, width, height + 0.2]), (n, 3))
    return boxes(np.column_stack([size, points, np.full(n, -0.2)]))


def garden_wall(rng: Rng, path: F64) -> Parts:
    """A wall, sometimes with pillars, a coping or a railing on top."""
    height = float(rng.uniform(0.4, 2.1))
    b = float(rng.uniform(0.1, 0.2))
    points = resample(path, 2.5)
    parts: Parts = [
        (ribbon(points, np.array([[-b, -0.3], [b, -0.3], [b, height], [-b, height]])), WALL)
    ]
    if rng.random() < 0.4:
        parts.append((_posts(points, 2 * b + 0.16, height + float(rng.uniform(0.1, 0.35))), WALL))
    if rng.random() < 0.5:
        c = b + 0.06
        parts.append(
            (
                ribbon(
                    points,
                    np.array(
                        [
                            [-c, height],
                            [c, height],
                            [0.4 * c, height + 0.09],
                            [-0.4 * c, height + 0.09],
                        ]
                    ),
                ),
                WALL,
            )
        )
    if height < 1.0 and rng.random() < 0.4:
        fine = resample(path, 0.15)
        bars = upright_quads(
            fine[:-1], fine[:-1] + np.diff(fine, axis=0) * 0.25, height, height + 0.8
        )
        rail = upright_quads(points[:-1], points[1:], height + 0.76, height + 0.82)
        parts.append((joined(bars, rail), FENCE))
    return parts


def retaining_wall(rng: Rng, path: F64) -> Parts:
    """A stout wall of 1.5 to 4 m, with piers; of concrete beside a railway or a bank."""
    height = float(rng.uniform(1.5, 4.0))
    points = resample(path, 3.0)
    wall = ribbon(points, np.array([[-0.25, -0.5], [0.25, -0.5], [0.18, height], [-0.18, height]]))
    return [(joined(wall, _posts(points, 0.6, 0.9 * height)), WALL)]


def guard_rail(rng: Rng, path: F64) -> Parts:
    """A steel rail on posts at 0.75 m, or a low concrete barrier; Cityscapes counts rails as no
    class and networks as a fence.
    """
    points = resample(path, 2.0)
    if rng.random() < 0.25:
        return [
            (ribbon(points, np.array([[-0.3, -0.1], [0.3, -0.1], [0.1, 0.85], [-0.1, 0.85]])), WALL)
        ]
    rail = ribbon(
        points, np.array([[-0.05, 0.45], [0.05, 0.45], [0.09, 0.6], [0.05, 0.75], [-0.05, 0.75]])
    )
    return [(joined(rail, _posts(points, 0.1, 0.75)), FENCE)]


def pedestrian_rail(rng: Rng, path: F64) -> Parts:
    """A waist-high railing beside a pavement or on steps."""
    posts = resample(path, 1.5)
    height = float(rng.uniform(0.9, 1.1))
    lines = [np.column_stack([posts, np.full(len(posts), z)]) for z in (0.5 * height, height)]
    return [
        (
            joined(
                _posts(posts, 0.05, height), *(tubes(x[:-1], x[1:], 0.025, 0.025, 4) for x in lines)
            ),
            FENCE,
        )
    ]

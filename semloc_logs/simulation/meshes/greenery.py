"""Bushes, hedges, ivy, tufts of grass and flower beds. ``bare`` takes the leaves off what loses
them in winter; the wood stays.
"""

from __future__ import annotations

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.simulation.meshes.shapes import Parts, Rng, joined, resample, triangles_of, tubes
from semloc_logs.simulation.meshes.trees import leaves, twigs
from semloc_logs.simulation.meshes.world import VEGETATION, Mesh, ribbon


def bush(rng: Rng, *, bare: bool = False) -> Parts:
    """A bush or a clump of shrubs of 0.5 to 3 m; one in three is evergreen."""
    own = np.random.default_rng(int(rng.integers(2**62)))
    radius = own.uniform(0.35, 1.5)
    height = own.uniform(0.5, 2.6)
    evergreen = own.random() < 0.35
    stems = int(own.integers(6, 15))
    angle = own.uniform(0, 2 * np.pi, stems)
    out = radius * np.sqrt(own.uniform(0.05, 1.0, stems))
    ends = np.column_stack(
        [
            out * np.cos(angle),
            out * np.sin(angle),
            height * own.uniform(0.5, 1.0, stems) * (1 - 0.35 * (out / radius) ** 2),
        ]
    )
    ends[:, :2] *= own.uniform(0.8, 1.3, 2)
    foot = ends * [0.25, 0.25, 0.0] - [0, 0, 0.15]
    wood = tubes(foot, ends, 0.02, 0.01, 3)
    seed = np.random.default_rng(int(own.integers(2**62)))
    if bare and not evergreen:
        return [(joined(wood, twigs(seed, ends, 0.2 + 0.1 * height, each=7)), VEGETATION)]
    count = int(np.clip(75 * radius * height * seed.uniform(0.7, 1.3), 70, 420))
    pick = seed.integers(0, stems, count)
    reach = seed.uniform(0.3, 1.0, count)[:, None]
    centre = (
        foot[pick]
        + (ends - foot)[pick] * reach
        + seed.normal(size=(count, 3)) * (0.12 + 0.14 * radius)
    )
    size = seed.uniform(0.13, 0.28)
    centre[:, 2] = np.maximum(centre[:, 2], 0.8 * size)
    return [(joined(wood, leaves(seed, centre, size)), VEGETATION)]


def hedge(rng: Rng, path: F64, *, bare: bool = False) -> Parts:
    """A hedge along a plan path (n, 2), to be draped: cut and dense, or wild; wild ones and half of
    the cut ones lose their leaves.
    """
    own = np.random.default_rng(int(rng.integers(2**62)))
    points = resample(path, 0.8)
    height = own.uniform(0.7, 2.3)
    width = own.uniform(0.5, 1.1)
    wild = own.uniform(0.1, 0.25) if own.random() < 0.4 else own.uniform(0.02, 0.07)
    evergreen = own.random() < 0.5 and wild < 0.1
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    stems = int(np.clip(3 * length, 4, 400))
    places = own.uniform(0, len(points) - 1, stems)
    up = height * own.uniform(0.6, 1.0 + wild, stems)
    plan = np.column_stack(
        [np.interp(places, np.arange(len(points)), points[:, k]) for k in (0, 1)]
    )
    ends = np.column_stack([plan + own.normal(size=(stems, 2)) * 0.25 * width, up])
    wood = tubes(np.column_stack([plan, np.full(stems, -0.1)]), ends, 0.025, 0.01, 3)
    seed = np.random.default_rng(int(own.integers(2**62)))
    if bare and not evergreen:
        return [
            (
                joined(
                    wood,
                    twigs(
                        seed, np.concatenate([ends, ends * [1, 1, 0.5]]), 0.3 * width + 0.15, each=7
                    ),
                ),
                VEGETATION,
            )
        ]
    return [(joined(wood, _hedge_leaves(seed, points, length, height, width, wild)), VEGETATION)]


def _hedge_leaves(
    rng: Rng, points: F64, length: float, height: float, width: float, wild: float
) -> Mesh:
    b = 0.4 * width
    core = ribbon(points, np.array([[-b, 0], [b, 0], [b, 0.88 * height], [-b, 0.88 * height]]))
    core.vertices[:, :2] += rng.normal(size=(len(core.vertices), 2)) * wild * 0.5
    core.vertices[:, 2] *= 1 + rng.normal(size=len(core.vertices)) * wild * 0.4
    count = int(min(length * (2 * height + width) * (12 + 30 * wild), 4000))
    places = rng.uniform(0, len(points) - 1, count)
    plan = np.column_stack(
        [np.interp(places, np.arange(len(points)), points[:, k]) for k in (0, 1)]
    )
    centre = np.column_stack(
        [
            plan + rng.normal(size=(count, 2)) * (0.42 * width),
            height * np.sqrt(rng.uniform(0.02, 1.08, count)),
        ]
    )
    size = 0.14 + 0.5 * wild
    centre[:, 2] = np.maximum(centre[:, 2], 0.8 * size)
    return joined(core, leaves(rng, centre, size))


def ivy(rng: Rng, width: float, height: float, *, bare: bool = False) -> Parts:
    """Creepers on a wall at y = 0 that looks along -y, over ``width`` about x = 0 and up to
    ``height``; one in three loses its leaves.
    """
    own = np.random.default_rng(int(rng.integers(2**62)))
    feet = own.uniform(-width / 2, width / 2, max(3, int(3 * width)))
    tops = height * own.uniform(0.4, 1.0, len(feet))
    start = np.column_stack([feet, np.full(len(feet), -0.03), np.full(len(feet), -0.1)])
    end = np.column_stack(
        [feet + own.normal(size=len(feet)) * 0.3, np.full(len(feet), -0.03), tops]
    )
    wood = tubes(start, end, 0.02, 0.01, 3)
    if own.random() < 0.35 and bare:
        return [(wood, VEGETATION)]
    count = int(min(14 * width * height, 900))
    pick = own.integers(0, len(feet), count)
    centre = (
        start[pick]
        + (end - start)[pick] * own.uniform(0.05, 1, count)[:, None]
        + own.normal(size=(count, 3)) * [0.3, 0.05, 0.1]
    )
    centre[:, 1] = -np.abs(centre[:, 1]) - 0.03
    corners = centre[:, None] + own.uniform(-1, 1, (count, 3, 3)) * [0.2, 0.08, 0.2]
    corners[..., 1] = np.minimum(corners[..., 1], -0.02)
    corners[..., 2] = np.maximum(corners[..., 2], 0.02)
    return [(joined(wood, triangles_of(corners)), VEGETATION)]


def tufts(rng: Rng, radius: float | None = None) -> Parts:
    """Tall grass, reeds or a flower bed over a disc of ``radius`` metres (0.4 to 2.5 by default);
    it stays in winter.
    """
    own = np.random.default_rng(int(rng.integers(2**62)))
    drawn = own.uniform(0.4, 2.5)
    r = radius or drawn
    count = int(np.clip(45 * r * r, 25, 260))
    angle = own.uniform(0, 2 * np.pi, count)
    out = r * np.sqrt(own.uniform(0, 1, count))
    height = own.uniform(0.25, 0.9) * own.uniform(0.5, 1.1, count)
    foot = np.column_stack([out * np.cos(angle), out * np.sin(angle), np.full(count, -0.05)])
    across = own.normal(size=(count, 3)) * [0.07, 0.07, 0.0]
    tip = foot + np.column_stack([own.normal(size=(count, 2)) * 0.12, height])
    return [(triangles_of(np.stack([foot - across, foot + across, tip], axis=1)), VEGETATION)]

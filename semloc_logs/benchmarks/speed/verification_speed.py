"""Speed of verification by its parts, on a drawn place with a known transform, beside the paper's
ratio for every hypothesis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.hypotheses import Hypothesis, pose_matrix
from semloc_logs.alignment.query_map import Query
from semloc_logs.alignment.refine import coarse_fit, fine_fit
from semloc_logs.alignment.search import search_hypotheses
from semloc_logs.alignment.surface import surface_of
from semloc_logs.alignment.target_map import Target
from semloc_logs.alignment.tau import tau
from semloc_logs.arrays import F64
from semloc_logs.benchmarks.speed.search_speed import timed
from semloc_logs.numerics.transforms import apply, inverse
from semloc_logs.settings import Resolved
from semloc_logs.voxels.grid import BlockMap, Fuser

Figures = dict[str, dict[str, float | str]]
ROAD, BUILDING, POLE, TREE = 0, 2, 5, 8
TRUTH = np.array([0.6, 5.0, -3.0, 0.2])  # target_T_query of the place: yaw, x, y, z


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A place seen twice: ``target`` and its points, the ``query`` in its own frame, hypotheses of
    which the first is near TRUTH.
    """

    target: Target
    points: F64
    query: Query
    hypotheses: list[Hypothesis]


def place(rng: np.random.Generator, density: float) -> tuple[F64, NDArray[np.uint8]]:
    """Points (n, 3) and classes (n,) of a crossing with fronts, poles and trees, about ``density``
    points a square metre.
    """
    parts: list[tuple[F64, int]] = []

    def wall(a: tuple[float, float], b: tuple[float, float], height: float, label: int) -> None:
        n = int(density * np.hypot(b[0] - a[0], b[1] - a[1]) * height)
        along = rng.uniform(0, 1, (n, 1))
        parts.append(
            (
                np.c_[np.array(a) + along * np.subtract(b, a), rng.uniform(-1.7, height - 1.7, n)],
                label,
            )
        )

    parts.append(
        (
            np.c_[
                rng.uniform(-22, 22, (int(density * 1936), 2)), np.full(int(density * 1936), -1.7)
            ],
            ROAD,
        )
    )
    for a, b, height in (
        ((-20, 9), (-3, 9), 6),
        ((6, 8), (20, 10), 8),
        ((-18, -8), (-2, -8), 5),
        ((6, -9), (6, -20), 7),
        ((8, -11), (20, -9), 4),
    ):
        wall((float(a[0]), float(a[1])), (float(b[0]), float(b[1])), float(height), BUILDING)
    for x, y in ((-10.0, 6.0), (3.0, -6.5), (12.0, 6.0)):
        wall((x, y), (x + 0.2, y), 5.0, POLE)
    for x, y in ((-15.0, -5.5), (4.0, 14.0)):
        parts.append((rng.normal((x, y, 2.0), 0.8, (int(30 * density), 3)), TREE))
    points = np.concatenate([p for p, _ in parts])
    return points + rng.normal(0, 0.02, points.shape), np.repeat(
        np.array([c for _, c in parts], np.uint8), [len(p) for p, _ in parts]
    )


def scene(settings: Resolved, density: float = 25.0, hypotheses: int = 96) -> Scene:
    """The place fused twice, each time from points of its own."""
    rng = np.random.default_rng(0)
    truth = pose_matrix(TRUTH)
    v = settings.fusion.voxel_size

    def fused(points: F64, label: NDArray[np.uint8]) -> BlockMap:
        fuser = Fuser(settings.fusion)
        for half in range(2):
            fuser.add(points[half::2], label[half::2], np.zeros(3))
        return fuser.finish()

    there, label = place(rng, density)
    again, label_again = place(rng, density)
    again = apply(inverse(truth), again)
    poses = [
        TRUTH + np.array([0.05, 0.5, -0.4, 0.2]),
        *(
            np.r_[rng.uniform(-np.pi, np.pi), rng.uniform(-12, 12, 2), rng.uniform(-0.5, 0.5)]
            for _ in range(hypotheses - 1)
        ),
    ]
    tried = [
        Hypothesis(0, (float(p[0]), float(p[1]), float(p[2]), float(p[3])), 1, 1.0) for p in poses
    ]
    return Scene(
        Target(fused(there, label), v), there, Query(fused(again, label_again), again, v), tried
    )


def verification_speed(settings: Resolved) -> Figures:
    """Processor milliseconds of the search, of a fit, of what they need of a place, and of the
    paper's ratio for all hypotheses.
    """
    s = scene(settings)
    v = settings.fusion.voxel_size
    blocks = s.target.blocks

    def search() -> list[F64]:
        return [
            c.target_T_query
            for c in search_hypotheses(
                s.hypotheses, {0: s.target}, s.query, settings.descriptor.headings, 6
            )
        ]

    best = search_hypotheses(s.hypotheses, {0: s.target}, s.query, settings.descriptor.headings, 6)[
        0
    ]
    surface = surface_of(s.points, 2 * v)
    start = coarse_fit(best, s.target, s.query).target_T_query
    kappa = settings.closures.kappa * v
    actions = {
        f"search, {len(s.hypotheses)} hypotheses": search,
        "masks of a submap": lambda: Target(blocks, v).mask_grid,
        "coarse fit": lambda: coarse_fit(best, s.target, s.query),
        "surface of a place": lambda: surface_of(s.points, 2 * v),
        "fine fit": lambda: fine_fit(start, surface, s.query),
        f"tau, {len(s.hypotheses)} hypotheses": lambda: [
            tau(s.query.occupied, blocks, v, pose_matrix(np.array(h.pose)), kappa)
            for h in s.hypotheses
        ],
    }
    figures: Figures = {}
    for name, action in actions.items():
        least, median = timed(action, 3)
        figures[name] = {"ours": least, "unit": "processor ms", "median_ms": median}
    return figures

"""Roofs over rectangles (x0, x1, y0, y1) whose walls end at z: gable, cross, hip, half-hip,
mansard, gambrel, lean-to, flat...
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.simulation.meshes.shapes import Rng, boxes, joined, loft, triangles_of
from semloc_logs.simulation.meshes.world import Mesh, gabled_roof, place

Rectangle = tuple[float, float, float, float]
STEEPEST = 8.0  # m that a roof rises at most


def roof(rng: Rng, kind: str, where: Rectangle, z: float) -> tuple[Mesh, float]:
    """A roof of a ``kind`` with its gable walls, and its height over z.

    gable, cross, hip, half-hip, mansard, gambrel, lean-to, flat, saw or barrel.
    """
    x0, x1, y0, y1 = where
    over = float(rng.uniform(0.1, 0.7))
    if kind == "flat":
        return _flat(rng, where, z), 0.0
    turned = kind == "cross"
    length, span = (y1 - y0, x1 - x0) if turned else (x1 - x0, y1 - y0)
    pitch = float(np.tan(np.radians(rng.uniform(24, 50))))
    rise = min(span / 2 * pitch, STEEPEST)
    if kind in ("gable", "cross"):
        mesh = _profiled(np.array([[-span / 2, 0], [0, rise], [span / 2, 0]]), length, over)
    elif kind == "hip":
        hip = min(span / 2, 0.48 * length) * rng.uniform(0.8, 1.0)
        mesh = gabled_roof(length + 2 * over, span + 2 * over, rise, hip=float(hip) + over)
    elif kind == "half-hip":
        mesh = _half_hip(length, span, rise, over)
    elif kind == "mansard":
        rise, mesh = _mansard(rng, length, span)
    elif kind == "gambrel":
        knee = min(rise, 3.5)
        mesh = _profiled(
            np.array(
                [
                    [-span / 2, 0],
                    [-0.33 * span, 0.75 * knee],
                    [0, knee],
                    [0.33 * span, 0.75 * knee],
                    [span / 2, 0],
                ]
            ),
            length,
            over,
        )
    elif kind == "lean-to":
        rise = min(0.25 * span, 2.0)
        mesh = _profiled(np.array([[-span / 2, 0], [span / 2, rise]]), length, over)
    elif kind == "saw":
        teeth = max(2, int(length / 6))
        rise = 1.8
        edges = np.linspace(-length / 2, length / 2, teeth + 1)
        tooth = [
            _solid(np.array([[a, 0.0], [b - 0.05, rise], [b, 0.0]]), span)
            for a, b in pairwise(edges)
        ]
        mesh = place(joined(*tooth), 0, 0, 0, np.pi / 2)
    else:
        angle = np.linspace(np.pi, 0, 8)
        rise = min(0.22 * span, 3.0)
        mesh = _solid(np.column_stack([np.cos(angle) * span / 2, np.sin(angle) * rise]), length)
    return place(mesh, (x0 + x1) / 2, (y0 + y1) / 2, z, np.pi / 2 if turned else 0.0), rise


def _solid(line: F64, length: float) -> Mesh:
    """What lies between z = 0 and a line (k, 2) of (y, z), over ``length`` along x."""
    ends = [np.column_stack([np.full(len(line), x), line]) for x in (-length / 2, length / 2)]
    return loft(np.stack(ends))


def _profiled(line: F64, length: float, over: float) -> Mesh:
    """Slabs over a line (k, 2) of (y, z) that go on by ``over`` at the eaves and the gables, and
    the gable walls.
    """
    slope = (line[1] - line[0]) / np.linalg.norm(line[1] - line[0])
    last = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
    outer = line.copy()
    outer[0] -= over * slope
    outer[-1] += over * last
    section = np.concatenate([outer, np.add(outer[::-1], [0.0, 0.16])])
    a = length / 2 + over
    slabs = loft(np.stack([np.column_stack([np.full(len(section), x), section]) for x in (-a, a)]))
    fans = []
    for x in (-length / 2, length / 2):
        corners = np.column_stack([np.full(len(line), x), line])
        foot = np.array([x, line[-1, 0], 0.0])
        fans += [
            np.stack([corners[0], corners[k], corners[k + 1]]) for k in range(1, len(line) - 1)
        ]
        fans.append(np.stack([corners[0], corners[-1], foot]))
    return joined(_ends_fixed(slabs, len(section)), triangles_of(np.stack(fans)))


def _ends_fixed(slabs: Mesh, k: int) -> Mesh:
    """The slabs with ends closed quad by quad: a fan over a bent section would close the roof's
    inside.
    """
    half = k // 2
    i = np.arange(half - 1, dtype=np.int64)
    strips = [np.column_stack([i, i + 1, k - 2 - i]), np.column_stack([i, k - 2 - i, k - 1 - i])]
    ends = np.concatenate([s + o for s in strips for o in (0, len(slabs.vertices) - k)])
    return Mesh(slabs.vertices, np.concatenate([slabs.triangles[: 2 * k], ends]))


def _half_hip(length: float, span: float, rise: float, over: float) -> Mesh:
    a = length / 2
    b = span / 2 + over
    r = length / 2 - 0.2 * span
    low = -over * rise / (span / 2)
    knee = 0.6 * rise
    y = 0.4 * span / 2
    points = [
        (-a, -b, low),
        (-a, -y, knee),
        (-a, y, knee),
        (-a, b, low),
        (-r, 0, rise),
        (r, 0, rise),
        (a, -b, low),
        (a, -y, knee),
        (a, y, knee),
        (a, b, low),
    ]
    faces = [
        (0, 6, 7),
        (0, 7, 5),
        (0, 5, 4),
        (0, 4, 1),
        (3, 2, 4),
        (3, 4, 5),
        (3, 5, 8),
        (3, 8, 9),
        (1, 4, 2),
        (7, 8, 5),
    ]
    faces += [(0, 1, 2), (0, 2, 3), (6, 8, 7), (6, 9, 8), (0, 3, 9), (0, 9, 6)]
    return Mesh(np.array(points, np.float64), np.array(faces, np.int64))


def _mansard(rng: Rng, length: float, span: float) -> tuple[float, Mesh]:
    first = float(rng.uniform(1.8, 2.8))
    rise = 0.0
    inset = min(float(rng.uniform(0.5, 1.1)), 0.2 * span)
    rise = first + min(0.12 * span, 1.5)

    def ring(by: float, z: float) -> F64:
        a = length / 2 - by
        b = span / 2 - by
        return np.array([[-a, -b, z], [a, -b, z], [a, b, z], [-a, b, z]])

    return rise, loft(
        np.stack(
            [
                ring(-0.25, 0.0),
                ring(-0.25, 0.12),
                ring(inset, first),
                ring(0.42 * min(span, length), rise),
            ]
        )
    )


def _flat(rng: Rng, where: Rectangle, z: float) -> Mesh:
    x0, x1, y0, y1 = where
    cx = (x0 + x1) / 2
    cy = (y0 + y1) / 2
    w = x1 - x0
    d = y1 - y0
    edge = float(rng.uniform(0.05, 0.9)) if rng.random() < 0.7 else 0.0
    rows = [[w, d, 0.1, cx, cy, z - 0.1]]
    if edge:
        rows += [[w, 0.25, edge, cx, y, z] for y in (y0 + 0.12, y1 - 0.12)] + [
            [0.25, d, edge, x, cy, z] for x in (x0 + 0.12, x1 - 0.12)
        ]
    else:
        rows += [[w + 0.8, d + 0.8, 0.22, cx, cy, z]]
    if w > 8 and d > 6:
        rows += [
            [
                rng.uniform(2, 4),
                rng.uniform(2, 4),
                rng.uniform(1.5, 2.8),
                cx + rng.uniform(-0.3, 0.3) * w,
                cy,
                z,
            ]
        ]
        rows += [
            [*rng.uniform(0.6, 2, 2), rng.uniform(0.5, 1.3), cx + u * w, cy + v * d, z]
            for u, v in rng.uniform(-0.35, 0.35, (3, 2))
        ]
    return boxes(np.array(rows))


def dormers(rng: Rng, where: Rectangle, z: float, rise: float) -> Mesh:
    """Dormers on the slope to the front, with gables or lids."""
    x0, x1, y0, y1 = where
    count = int(np.clip(rng.integers(1, 5), 1, max(1, (x1 - x0) // 2.6)))
    wide = float(rng.uniform(1.1, 2.0))
    pointed = rng.random() < 0.6
    top = z + min(0.75 * rise, 2.0)
    front = y0 + rng.uniform(0.4, 0.9)
    middle = (y0 + y1) / 2
    meshes = []
    for x in x0 + (x1 - x0) * (np.arange(count) + 0.5) / count:
        meshes.append(
            boxes(np.array([[wide, middle - front, top - z, x, (front + middle) / 2, z]]))
        )
        if pointed:
            w = wide / 2 + 0.15
            gable = np.array(
                [
                    [x - w, front - 0.2, top - 0.05],
                    [x, front - 0.2, top + 0.55 * w],
                    [x + w, front - 0.2, top - 0.05],
                ]
            )
            meshes.append(loft(np.stack([gable, np.add(gable, [0, middle - front, 0])])))
        else:
            meshes.append(
                boxes(
                    np.array(
                        [
                            [
                                wide + 0.4,
                                middle - front + 0.3,
                                0.14,
                                x,
                                (front + middle) / 2 - 0.15,
                                top,
                            ]
                        ]
                    )
                )
            )
    return joined(*meshes)


def chimneys(rng: Rng, where: Rectangle, z: float, rise: float) -> Mesh:
    """One to three chimneys near the ridge, that stand a metre over it."""
    x0, x1, y0, y1 = where
    rows = []
    for _ in range(int(rng.integers(1, 4))):
        x = x0 + (x1 - x0) * rng.uniform(0.08, 0.92)
        y = (y0 + y1) / 2 + rng.uniform(-0.15, 0.15) * (y1 - y0)
        wide = rng.uniform(0.45, 0.7)
        deep = rng.uniform(0.5, 1.4)
        rows += [
            [wide, deep, rise + 0.9, x, y, z],
            [wide + 0.12, deep + 0.12, 0.14, x, y, z + rise + 0.8],
        ]
    return boxes(np.array(rows))

"""Houses: a jogged plan outline with bays, recessed doors and corners, pulled up, with a roof and what sticks out of it."""

from __future__ import annotations

import numpy as np

from semloc_logs.simulation.shapes import Parts
from semloc_logs.simulation.world import BUILDING, F64, Mesh, box, cylinder, extrude, gabled_roof, merge, place, quads

Rng = np.random.Generator


def _front(rng: Rng, width: float, jog: float) -> F64:
    """The front line from x = -width/2 to width/2 as (n, 2): pieces set back or forward by up to ``jog``, and a recessed door."""
    cuts = [-width / 2]
    while cuts[-1] < width / 2 - 2.5:
        cuts.append(cuts[-1] + rng.uniform(1.2, 5.5))
    cuts[-1] = width / 2
    if len(cuts) == 1:
        cuts = [-width / 2, width / 2]
    depth = np.where(rng.random(len(cuts) - 1) < 0.45, rng.uniform(-jog, jog, len(cuts) - 1), 0.0)
    points = []
    for a, b, d in zip(cuts[:-1], cuts[1:], depth, strict=True):
        points += [[a, d], [b, d]]
    return np.array(points)


def building(rng: Rng, width: float, depth: float, height: float, roof: str) -> Parts:
    """A house whose front lies near y = 0 and looks along -y; its body reaches to y = ``depth``. ``roof``: gable, cross, hip, flat."""
    front = _front(rng, width, min(1.3, 0.12 * depth))
    back = np.array([[width / 2, depth], [-width / 2, depth]])
    if rng.random() < 0.3:
        notch = rng.uniform(0.2, 0.5) * np.array([width, depth])
        back = np.array(
            [[width / 2, depth - notch[1]], [width / 2 - notch[0], depth - notch[1]], [width / 2 - notch[0], depth], [-width / 2, depth]]
        )
    body = _prism(np.concatenate([front, back]), height)
    meshes = [body, _roof(rng, width, depth, height, roof)]
    meshes += _outside(rng, width, height, front)
    if rng.random() < 0.3 and depth > 6:
        wing_width, wing_depth = rng.uniform(2.5, 5.0), rng.uniform(3.0, min(depth - 1.0, 7.0))
        side = rng.choice([-1, 1])
        wing_height = rng.uniform(2.4, 3.2)
        wing = box(
            wing_width,
            wing_depth,
            wing_height + 1.5,
            side * (width / 2 + wing_width / 2 - 0.05),
            rng.uniform(0.5, depth - wing_depth) + wing_depth / 2,
            -1.5,
        )
        meshes.append(wing)
    return [(merge(*meshes), BUILDING)]


def _prism(outline: F64, height: float) -> Mesh:
    """Walls over any outline, from 1.5 m under the ground; the top is closed by a flat cover at the eaves."""
    walls = extrude(outline, -1.5, height)
    n = len(outline)
    return Mesh(walls.vertices, walls.triangles[: 2 * n])


def _roof(rng: Rng, width: float, depth: float, height: float, roof: str) -> Mesh:
    over = rng.uniform(0.1, 0.6)
    if roof == "flat":
        parapet = rng.uniform(0.0, 0.9)
        rim = [box(width, 0.25, parapet + 0.01, 0, y, height) for y in (0.1, depth - 0.1)]
        rim += [box(0.25, depth, parapet + 0.01, x, depth / 2, height) for x in (-width / 2 + 0.1, width / 2 - 0.1)]
        cover = box(width, depth, 0.1, 0, depth / 2, height - 0.1)
        stack = box(rng.uniform(1, 4), rng.uniform(1, 3), rng.uniform(0.8, 2.5), rng.uniform(-0.25, 0.25) * width, depth / 2, height)
        return merge(cover, stack, *rim)
    pitch = np.tan(np.radians(rng.uniform(22, 50)))
    if roof == "cross":
        rise = width / 2 * pitch
        mesh = place(gabled_roof(depth + 2 * over, width + 2 * over, rise), 0, 0, 0, np.pi / 2)
    else:
        rise = depth / 2 * pitch
        mesh = gabled_roof(width + 2 * over, depth + 2 * over, min(rise, 6.0), hip=min(depth / 2, 0.45 * width) if roof == "hip" else 0.0)
    parts = [place(mesh, 0, depth / 2, height - 0.02)]
    if rng.random() < 0.6:
        parts.append(
            box(0.6, 0.8, min(rise, 6.0) + 1.0, rng.uniform(-0.35, 0.35) * width, depth / 2 + rng.uniform(-0.1, 0.1) * depth, height)
        )
    if roof != "cross" and rng.random() < 0.4:
        parts += [box(1.4, 1.8, 1.5, x, 1.6, height) for x in np.linspace(-0.3, 0.3, int(rng.integers(1, 4))) * width]
    return merge(*parts)


def _outside(rng: Rng, width: float, height: float, front: F64) -> list[Mesh]:
    """Porch, balconies, awnings, steps, pipes at the front."""
    meshes: list[Mesh] = []
    line = float(front[:, 1].min())
    if rng.random() < 0.35:
        x = rng.uniform(-0.35, 0.35) * width
        meshes += [box(2.0, 1.3, 0.15, x, line - 0.6, 2.4), place(cylinder(0.07, 2.4, 6), x - 0.9, line - 1.15)]
        meshes += [place(cylinder(0.07, 2.4, 6), x + 0.9, line - 1.15), box(1.6, 1.0, 0.3, x, line - 0.5)]
    if height > 5.5 and rng.random() < 0.45:
        columns = np.arange(-width / 2 + 2.0, width / 2 - 1.5, rng.uniform(3.5, 6.0))
        keep = rng.random(len(columns)) < 0.7
        for x in columns[keep]:
            for z in np.arange(2.9, height - 2.2, 2.9):
                meshes += [box(2.2, 1.1, 0.15, x, line - 0.5, z), box(2.2, 0.06, 0.95, x, line - 1.02, z)]
    if rng.random() < 0.2:
        sheet = awning(rng.uniform(2, max(2.5, 0.7 * width)), rng.uniform(0.9, 1.8), rng.uniform(2.3, 2.8))
        meshes.append(place(sheet, rng.uniform(-0.1, 0.1) * width, line, 0, np.pi))
    meshes += [_windows(rng, width, height, line)] if rng.random() < 0.6 else []
    return meshes


def _windows(rng: Rng, width: float, height: float, line: float) -> Mesh:
    """Sills and shutters a hand's breadth before the wall."""
    pitch, storey = rng.uniform(2.0, 4.0), rng.uniform(2.7, 3.3)
    xs, zs = np.arange(-width / 2 + 1.2, width / 2 - 1.0, pitch), np.arange(0.9, height - 1.4, storey)
    x, z = (g.ravel() for g in np.meshgrid(xs, zs))
    if not len(x):
        return quads(np.array([[[-0.5, line - 0.1, 0.9], [0.5, line - 0.1, 0.9], [0.5, line, 0.9], [-0.5, line, 0.9]]]))
    corners = np.zeros((len(x), 4, 3))
    corners[:, :, 0] = x[:, None] + np.array([-0.6, 0.6, 0.6, -0.6])
    corners[:, :, 1] = line - np.array([0.0, 0.0, 0.22, 0.22])
    corners[:, :, 2] = z[:, None]
    shutters = corners.copy()
    shutters[:, :, 0] = x[:, None] + np.array([0.6, 1.0, 1.0, 0.6])
    shutters[:, :, 1] = line - 0.1
    shutters[:, 2:, 2] += 1.3
    return quads(np.concatenate([corners, shutters]))


def awning(width: float, depth: float, height: float) -> Mesh:
    """A slanting sheet hanging from a wall at y = 0 towards +y."""
    w = width / 2
    return quads(np.array([[[-w, 0, height + 0.5], [w, 0, height + 0.5], [w, depth, height], [-w, depth, height]]]))

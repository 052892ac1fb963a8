"""What stands in a street: vehicles, people, trees, hedges, fences, poles. Each is a list of (mesh, label) about its foot."""

from __future__ import annotations

import numpy as np

from semloc_logs.simulation.world import (
    BICYCLE,
    BUS,
    CAR,
    F64,
    FENCE,
    MOTORCYCLE,
    PERSON,
    POLE,
    TRAFFIC_LIGHT,
    TRAFFIC_SIGN,
    TRUCK,
    UNLABELLED,
    VEGETATION,
    WALL,
    Mesh,
    box,
    cylinder,
    ellipsoid,
    leaf_cloud,
    merge,
    place,
    quads,
    ribbon,
    upright_quads,
)

Parts = list[tuple[Mesh, int]]
Rng = np.random.Generator


def _profile(outline: F64, width: float, taper: float) -> Mesh:
    """A side view (n, 2) of (x, z) swept over ``width``; points above 0.9 m are drawn in by ``taper``."""
    n = len(outline)
    half = np.where(outline[:, 1] > 0.95, width / 2 - taper, width / 2)
    sides = [np.column_stack([outline[:, 0], sign * half, outline[:, 1]]) for sign in (-1, 1)]
    middle = outline.mean(0)
    caps = np.array([[middle[0], -width / 2 + taper / 2, middle[1]], [middle[0], width / 2 - taper / 2, middle[1]]])
    i = np.arange(n, dtype=np.int64)
    j = (i + 1) % n
    triangles = [np.column_stack([i, j, j + n]), np.column_stack([i, j + n, i + n])]
    triangles += [np.column_stack([i, j, np.full(n, 2 * n)]), np.column_stack([i + n, j + n, np.full(n, 2 * n + 1)])]
    return Mesh(np.concatenate([*sides, caps]), np.concatenate(triangles))


def _wheels(length: float, width: float, radius: float) -> list[Mesh]:
    wheel = cylinder(radius, 0.2, 10)
    lying = Mesh(wheel.vertices[:, [0, 2, 1]] + [0, -0.1, radius], wheel.triangles)
    return [place(lying, sx * 0.31 * length, sy * (width / 2 - 0.1)) for sx in (-1, 1) for sy in (-1, 1)]


def car(rng: Rng) -> Parts:
    """A passenger car along +x: hatchback, saloon, estate or off-roader."""
    length, width, height = rng.uniform(3.6, 4.9), rng.uniform(1.65, 1.9), rng.uniform(1.4, 1.75)
    a, bonnet, belt = length / 2, rng.uniform(0.7, 0.85), rng.uniform(0.85, 0.98)
    boot = rng.choice([0.0, 0.0, 0.9]) * rng.uniform(0.6, 1.1)
    cabin = rng.uniform(0.2, 0.32) * length
    tail = [[-a, 0.25], [-a, belt - 0.05], [-a + 0.05 + boot, belt], [-a + 0.45 + boot, height], [0.0, height]]
    front = [[cabin * 0.5, height * 0.98], [cabin * 0.5 + 0.75, belt], [a - 0.15, bonnet], [a, 0.55], [a, 0.25]]
    body = _profile(np.array(tail + front), width, 0.16)
    return [(merge(body, *_wheels(length, width, rng.uniform(0.29, 0.36))), CAR)]


def van(rng: Rng) -> Parts:
    """A delivery van along +x; Cityscapes counts vans as cars."""
    length, width, height = rng.uniform(4.8, 6.2), rng.uniform(1.9, 2.1), rng.uniform(1.9, 2.7)
    a = length / 2
    outline = np.array(
        [[-a, 0.3], [-a, height - 0.1], [-a + 0.1, height], [a - 1.5, height], [a - 0.8, 1.2], [a - 0.1, 1.0], [a, 0.5], [a, 0.3]]
    )
    return [(merge(_profile(outline, width, 0.08), *_wheels(length, width, 0.36)), CAR)]


def truck(rng: Rng) -> Parts:
    """A rigid truck with a box, or a coach, along +x."""
    length, height = rng.uniform(6.5, 10.5), rng.uniform(2.9, 3.6)
    wheels = merge(*_wheels(length, 2.4, 0.48))
    if rng.random() < 0.25:
        return [(merge(box(length + 1.5, 2.5, height - 0.45, z=0.35), wheels), BUS)]
    cargo = box(length - 2.2, 2.45, height - 0.9, x=-1.0, z=0.9)
    cab = box(1.9, 2.3, rng.uniform(1.9, 2.4), x=length / 2 - 1.0, z=0.5)
    return [(merge(cargo, cab, box(length - 0.4, 0.9, 0.4, z=0.5), wheels), TRUCK)]


def person(rng: Rng) -> Parts:
    """A standing or walking person."""
    height, stride = rng.uniform(1.5, 1.9), rng.uniform(0.05, 0.3)
    legs = [place(cylinder(0.08, 0.47 * height, 6), sign * stride / 2, sign * 0.09) for sign in (-1, 1)]
    round_torso = cylinder(0.2, 0.38 * height, 8, 0.17, z=0.45 * height)
    torso = Mesh(round_torso.vertices * [0.65, 1.15, 1.0], round_torso.triangles)
    return [(merge(*legs, torso, ellipsoid((0.1, 0.09, 0.13), 0.92 * height, 4, 6)), PERSON)]


def two_wheeler(rng: Rng) -> Parts:
    """A parked bicycle or motorcycle along +x."""
    motor = rng.random() < 0.4
    radius, gauge, base = (0.3, 0.12, 1.35) if motor else (0.34, 0.04, 1.05)
    wheel = cylinder(radius, gauge, 10)
    lying = Mesh(wheel.vertices[:, [0, 2, 1]] + [0, -gauge / 2, radius], wheel.triangles)
    parts = [place(lying, -base / 2, 0), place(lying, base / 2, 0), box(base, gauge * 1.5, 0.28 if motor else 0.08, z=0.5)]
    parts += [
        box(0.06, 0.6, 0.06, x=base / 2 - 0.15, z=0.98),
        box(0.3, 0.15 + gauge, 0.1, x=-0.25, z=0.82),
        box(0.06, 0.06, 0.6, base / 2 - 0.12, z=0.4),
    ]
    return [(merge(*parts), MOTORCYCLE if motor else BICYCLE)]


def tree(rng: Rng, size: float = 1.0, kind: str | None = None) -> Parts:
    """A round, columnar or conical tree; ``size`` 1 is a full-grown street tree of 8-13 m. Trunks count as vegetation, as in Cityscapes."""
    kind = kind or str(rng.choice(["round", "round", "round", "column", "cone", "spreading"]))
    height = size * rng.uniform(7.0, 13.0)
    if kind == "cone":
        radius, clear = height * rng.uniform(0.16, 0.26), rng.uniform(0.1, 0.9)
        crown = _cone_crown(rng, radius, height - clear, clear)
    else:
        spread = {"round": (0.26, 0.36), "column": (0.09, 0.14), "spreading": (0.38, 0.5)}[kind]
        clear = min(rng.uniform(1.7, 4.0), 0.4 * height)
        radius, half = height * rng.uniform(*spread), (height - clear) / 2 * 1.05
        blobs = []
        for k in range(int(rng.integers(1, 5)) if kind != "column" else 1):
            shrink = 1.0 if k == 0 else rng.uniform(0.4, 0.75)
            radii = (radius * shrink * rng.uniform(0.85, 1.15), radius * shrink * rng.uniform(0.85, 1.15), half * shrink)
            count = int(np.clip(48 * radii[0] * radii[2], 80, 1200) * rng.uniform(0.6, 1.2))
            blob = leaf_cloud(rng, radii, count, rng.uniform(0.25, 0.45))
            offset = np.zeros(3) if k == 0 else rng.normal(size=3) * [0.5 * radius, 0.5 * radius, 0.4 * half]
            blobs.append(Mesh(blob.vertices + offset + [0, 0, clear + half], blob.triangles))
        crown = merge(*blobs)
    trunk_radius = 0.018 * height * rng.uniform(0.7, 1.3) + 0.03
    trunk = cylinder(trunk_radius, clear + 0.35 * (height - clear), 8, 0.6 * trunk_radius, z=-0.3)
    lean = rng.normal(size=2) * 0.02
    whole = merge(trunk, crown)
    whole.vertices[:, :2] += whole.vertices[:, 2:] * lean
    return [(whole, VEGETATION)]


def _cone_crown(rng: Rng, radius: float, height: float, clear: float) -> Mesh:
    count = int(np.clip(40 * radius * height, 150, 1500))
    up = 1 - np.sqrt(rng.uniform(0, 1, count))
    angle, out = rng.uniform(0, 2 * np.pi, count), radius * (1 - up) * rng.uniform(0.55, 1.1, count) ** 0.6
    centre = np.column_stack([out * np.cos(angle), out * np.sin(angle), clear + up * height])
    corners = centre[:, None, :] + rng.uniform(-1, 1, (count, 3, 3)) * [0.35, 0.35, 0.2]
    return Mesh(corners.reshape(-1, 3), np.arange(3 * count, dtype=np.int64).reshape(-1, 3))


def bush(rng: Rng) -> Parts:
    """A bush or a heap of shrubs of 0.5 to 3 m."""
    radius, height = rng.uniform(0.4, 1.6), rng.uniform(0.5, 2.6)
    radii = (radius * rng.uniform(0.8, 1.6), radius, height / 2)
    cloud = leaf_cloud(rng, radii, int(np.clip(90 * radius * height, 80, 500)), rng.uniform(0.18, 0.35), hollow=0.4)
    return [(Mesh(cloud.vertices * [1, 1, 1] + [0, 0, 0.45 * height], cloud.triangles), VEGETATION)]


def pole(rng: Rng, kind: str) -> Parts:
    """``lamp``, ``sign``, ``signals`` (traffic lights), ``bollard`` or ``mast``; arms and faces look along +y."""
    if kind == "bollard":
        return [(cylinder(0.08, rng.uniform(0.7, 1.1), 6), POLE)]
    if kind == "mast":
        height = rng.uniform(7.5, 10.0)
        return [(merge(cylinder(0.15, height, 8, 0.1), box(0.12, 1.6, 0.12, z=height - 0.6)), POLE)]
    if kind == "lamp":
        height, arm = rng.uniform(4.0, 9.0), rng.uniform(0.0, 2.2)
        head = box(0.3, 0.7, 0.18, y=arm, z=height - 0.1)
        bar = box(0.08, arm + 0.1, 0.08, y=arm / 2, z=height - 0.1)
        return [(merge(cylinder(0.09, height, 8, 0.05), bar, head), POLE)]
    if kind == "sign":
        height, size = rng.uniform(2.0, 2.9), rng.uniform(0.45, 0.8)
        shape = cylinder(size / 2, 0.03, int(rng.choice([3, 4, 8, 12])))
        turned = Mesh(shape.vertices[:, [2, 0, 1]] + [0.05, 0, height + size / 2 - 0.1], shape.triangles)
        return [(cylinder(0.035, height + size, 6), POLE), (place(turned, 0, 0, 0, rng.normal() * 0.15), TRAFFIC_SIGN)]
    height, arm = rng.uniform(2.9, 3.4), float(rng.choice([0.0, 0.0, rng.uniform(2.5, 4.5)]))
    if arm:
        high = 5.6
        light = box(0.3, 0.35, 0.95, y=arm, z=high - 0.6)
        return [(merge(cylinder(0.12, high + 0.3, 8), box(0.12, arm, 0.12, y=arm / 2, z=high)), POLE), (light, TRAFFIC_LIGHT)]
    return [(cylinder(0.07, height, 8), POLE), (box(0.3, 0.32, 0.95, x=-0.12, z=height - 1.0), TRAFFIC_LIGHT)]


def street_clutter(rng: Rng) -> Parts:
    """A bin, a cabinet, a bench or a skip: occupied, of no class."""
    kind = rng.integers(4)
    if kind == 0:
        return [(merge(box(0.55, 0.6, 1.0, z=0.05), box(0.6, 0.65, 0.08, z=1.03)), UNLABELLED)]
    if kind == 1:
        return [(box(rng.uniform(0.6, 1.4), 0.4, rng.uniform(0.9, 1.5)), UNLABELLED)]
    if kind == 2:
        return [
            (
                merge(
                    box(1.6, 0.45, 0.06, z=0.42), box(1.6, 0.06, 0.45, y=-0.22, z=0.45), box(0.1, 0.4, 0.42, -0.6), box(0.1, 0.4, 0.42, 0.6)
                ),
                UNLABELLED,
            )
        ]
    return [(box(rng.uniform(1.2, 3.5), 1.5, 1.2), UNLABELLED)]


def resample(path: F64, spacing: float) -> F64:
    """The plan path (n, 2) with points every ``spacing`` metres, ends kept."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.linspace(0, along[-1], max(2, int(np.ceil(along[-1] / spacing)) + 1))
    return np.column_stack([np.interp(at, along, path[:, k]) for k in range(path.shape[1])])


def hedge(rng: Rng, path: F64) -> Parts:
    """A cut or a wild hedge along a plan path; drape it."""
    points = resample(path, 0.8)
    height, width, wild = rng.uniform(0.8, 2.4), rng.uniform(0.6, 1.2), rng.uniform(0.03, 0.2)
    b = width / 2 * 0.8
    core = ribbon(points, np.array([[-b, 0], [b, 0], [b, 0.9 * height], [-b, 0.9 * height]]))
    core.vertices[:, :2] += rng.normal(size=(len(core.vertices), 2)) * wild * 0.5
    core.vertices[:, 2] *= 1 + rng.normal(size=len(core.vertices)) * wild * 0.4
    area = len(points) * 0.8 * (2 * height + width)
    count = int(min(area * 12, 4000))
    pick = rng.integers(0, len(points), count)
    centre = np.column_stack([points[pick] + rng.normal(size=(count, 2)) * (0.45 * width), height * np.sqrt(rng.uniform(0, 1.1, count))])
    centre[:, :2] += rng.uniform(-0.4, 0.4, (count, 2)) * np.gradient(points, axis=0)[pick]
    corners = centre[:, None, :] + rng.uniform(-1, 1, (count, 3, 3)) * (0.15 + wild * 0.6)
    leaves = Mesh(corners.reshape(-1, 3), np.arange(3 * count, dtype=np.int64).reshape(-1, 3))
    return [(merge(core, leaves), VEGETATION)]


def fence(rng: Rng, path: F64) -> Parts:
    """A picket, board or wire fence along a plan path; drape it."""
    height, kind = rng.uniform(0.8, 1.9), rng.choice(["picket", "board", "rails", "bars"])
    posts = resample(path, 2.2)
    meshes = [box(0.1, 0.1, height + 0.1, x, y) for x, y in posts]
    if kind == "board":
        meshes.append(upright_quads(posts[:-1], posts[1:], 0.05, height))
        return [(merge(*meshes), FENCE)]
    levels = (0.15, height - 0.1) if kind != "rails" else np.linspace(0.3, height, 3)
    meshes += [upright_quads(posts[:-1], posts[1:], z - 0.04, z + 0.04) for z in levels]
    if kind != "rails":
        pitch, width = (0.2, 0.12) if kind == "picket" else (0.14, 0.04)
        fine = resample(path, pitch)
        step = np.diff(fine, axis=0) * min(1.0, width / pitch)
        meshes.append(upright_quads(fine[:-1], fine[:-1] + step, 0.05, height))
    return [(merge(*meshes), FENCE)]


def garden_wall(rng: Rng, path: F64) -> Parts:
    """A wall along a plan path, sometimes with pillars or a railing on top; drape it."""
    height, b = rng.uniform(0.4, 2.1), rng.uniform(0.1, 0.18)
    points = resample(path, 2.5)
    wall = ribbon(points, np.array([[-b, -0.3], [b, -0.3], [b, height], [-b, height]]))
    parts: Parts = [(wall, WALL)]
    if rng.random() < 0.4:
        parts.append((merge(*[box(0.45, 0.45, height + 0.3, x, y) for x, y in points[::2]]), WALL))
    if height < 1.0 and rng.random() < 0.4:
        fine = resample(path, 0.15)
        bars = upright_quads(fine[:-1], fine[:-1] + np.diff(fine, axis=0) * 0.25, height, height + 0.8)
        rail = upright_quads(points[:-1], points[1:], height + 0.76, height + 0.82)
        parts.append((merge(bars, rail), FENCE))
    return parts


def awning(width: float, depth: float, height: float) -> Mesh:
    """A slanting sheet hanging from a wall at y = 0 towards +y."""
    w = width / 2
    return quads(np.array([[[-w, 0, height + 0.5], [w, 0, height + 0.5], [w, depth, height], [-w, depth, height]]]))

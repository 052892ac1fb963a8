"""Roadworks and building sites, which stay in a street for some weeks."""

from __future__ import annotations

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.simulation.meshes import objects
from semloc_logs.simulation.meshes.objects import Parts
from semloc_logs.simulation.meshes.world import (
    BUILDING,
    FENCE,
    POLE,
    TERRAIN,
    TRAFFIC_SIGN,
    TRUCK,
    UNLABELLED,
    Mesh,
    box,
    cylinder,
    ellipsoid,
    merge,
    place,
    upright_quads,
)
from semloc_logs.simulation.town.setting import Rng, Setting
from semloc_logs.simulation.town.sides import Side
from semloc_logs.simulation.town.terrain import CLEAR


def put_roadworks(setting: Setting, side: Side) -> None:
    """Sites along one side of a road, as many as the session has: a strip of ground dug up, and
    what belongs to it.
    """
    rng = setting.works
    road = side.road
    inner = min(0.0, road.lane + CLEAR + 0.6 - road.half_width)  # the lane stays open
    depth = float(road.sidewalk - inner + (1.5 if road.sidewalk < 1 else 0.0))
    edge = road.half_width + 8.0
    for _ in range(rng.poisson(setting.condition.roadworks * side.length / 2000)):
        u = float(rng.uniform(edge, max(edge + 1, side.length - edge)))
        state = int(rng.integers(2**31))
        # a long one does not fit into a bend
        for length in float(rng.uniform(8, 22)) * np.array([1.0, 0.7, 0.5]):
            fits = depth > 1.0 and length / 2 + 2 < u < side.length - length / 2 - 2
            x, y, yaw = side.at(u, inner)
            parts = roadworks(np.random.default_rng(state), float(length), depth)
            if fits and setting.put(parts, x, y, yaw, moving=True):
                ends = u - length / 2, u + length / 2
                setting.ground.close(
                    side.area(ends[0] - 1, ends[1] + 1, inner - 0.3, inner + depth + 0.3)
                )
                setting.ground.dig(
                    side.area(
                        ends[0] + 0.8,
                        ends[1] - 0.4 * length,
                        inner + 0.6,
                        inner + min(1.8, depth - 0.3),
                    )
                )
                break


def roadworks(rng: Rng, length: float, depth: float) -> Parts:
    """A site ``length`` m along x and ``depth`` m along -y, traffic passing at y > 0: barriers,
    cones, a heap and what else fits in.
    """
    parts: Parts = [(_barriers(length, depth), FENCE)]
    parts.append(
        (
            merge(*[place(cone(rng), x, 0.1) for x in np.arange(-length / 2, length / 2, 2.5)]),
            UNLABELLED,
        )
    )
    parts.append(
        (
            merge(
                *[
                    place(cylinder(0.03, 1.3, 6), x, -0.2)
                    for x in (-length / 2 - 0.6, length / 2 + 0.6)
                ]
            ),
            POLE,
        )
    )
    parts.append(
        (
            merge(
                *[box(0.05, 0.5, 0.5, x, -0.2, 1.1) for x in (-length / 2 - 0.6, length / 2 + 0.6)]
            ),
            TRAFFIC_SIGN,
        )
    )
    x = -length / 2 + 1.5
    if depth > 2.2:
        heap = ellipsoid((rng.uniform(1.0, 2.0), min(1.2, depth / 2 - 0.2), rng.uniform(0.5, 1.1)))
        parts.append((place(heap, x + 1.5, -depth / 2), TERRAIN))
        x += 5.0
    for make, room, wide in ((excavator, 6.0, 2.7), (container, 7.0, 2.8)):
        if depth > wide and x + room < length / 2 and rng.random() < 0.8:
            parts += [(place(mesh, x + room / 2, -depth / 2), label) for mesh, label in make(rng)]
            x += room
    return parts


def _barriers(length: float, depth: float) -> Mesh:
    corners = np.array(
        [
            [-length / 2, -0.15],
            [length / 2, -0.15],
            [length / 2, -depth],
            [-length / 2, -depth],
            [-length / 2, -0.15],
        ]
    )
    line = objects.resample(corners, 2.0)
    boards = [upright_quads(line[:-1], line[1:], z, z + 0.2) for z in (0.15, 0.85)]
    return merge(*boards, *[box(0.06, 0.06, 1.05, px, py) for px, py in line])


def cone(rng: Rng) -> Mesh:
    """A traffic cone, which has no class."""
    height = rng.uniform(0.5, 0.75)
    return merge(box(0.38, 0.38, 0.04), cylinder(0.14, height, 8, 0.03))


def container(rng: Rng) -> Parts:
    """A site office or a skip, 6 m along x."""
    if rng.random() < 0.5:
        return [(box(6.0, 2.4, 2.5, z=0.15), UNLABELLED)]
    sides = [box(4.5, 0.1, 1.4, y=y, z=0.2) for y in (-0.9, 0.9)] + [
        box(0.1, 1.8, 1.2, x=x, z=0.2) for x in (-2.2, 2.2)
    ]
    return [(merge(box(4.5, 1.8, 0.1, z=0.2), *sides), UNLABELLED)]


def excavator(rng: Rng) -> Parts:
    """A small excavator, its arm along +x; construction vehicles count as trucks."""
    tracks = [box(2.4, 0.45, 0.7, y=y) for y in (-0.8, 0.8)]
    cab = place(
        merge(box(2.2, 1.9, 0.9, x=-0.3, z=0.8), box(1.1, 0.95, 1.0, x=0.3, y=0.4, z=1.7)),
        0,
        0,
        0,
        rng.normal() * 0.2,
    )
    reach = rng.uniform(1.8, 2.6)
    high = rng.uniform(2.2, 3.2)
    boom = _beam(np.array([0.7, -0.2, 1.4]), np.array([reach * 0.7, -0.2, high]), 0.3)
    stick = _beam(np.array([reach * 0.7, -0.2, high]), np.array([reach + 0.5, -0.2, 0.9]), 0.25)
    return [
        (merge(*tracks, cab, boom, stick, box(0.6, 0.9, 0.6, x=reach + 0.4, y=-0.2, z=0.4)), TRUCK)
    ]


def _beam(start: F64, end: F64, width: float) -> Mesh:
    """A square beam between two points in a plane of equal y."""
    along = end - start
    unit = box(
        float(np.linalg.norm(along)), width, width, x=float(np.linalg.norm(along)) / 2, z=-width / 2
    )
    c, s = along[[0, 2]] / np.linalg.norm(along)
    turned = unit.vertices @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return Mesh(turned + start, unit.triangles)


def scaffolding(width: float, depth: float, height: float) -> Parts:
    """Scaffolds before the front (y = 0, looking along -y) and the sides of a house: decks, posts
    and nets.
    """
    line = objects.resample(
        np.array(
            [
                [-width / 2 - 0.9, depth * 0.8],
                [-width / 2 - 0.9, -0.9],
                [width / 2 + 0.9, -0.9],
                [width / 2 + 0.9, depth * 0.8],
            ]
        ),
        2.4,
    )
    levels = np.arange(2.0, height + 1.0, 2.0)
    posts = merge(*[box(0.06, 0.06, height + 1.2, px, py) for px, py in line])
    rails = [
        upright_quads(line[:-1], line[1:], z + lift, z + lift + 0.12)
        for z in levels
        for lift in (0.0, 1.0)
    ]
    nets = upright_quads(line[:-1:2], line[1::2][: len(line[:-1:2])], 0.4, height + 0.8)
    return [(merge(posts, *rails, nets), FENCE)]


def shell(width: float, depth: float, height: float) -> Parts:
    """A house that is being built: pillars, floors and a part of the walls, its front at y = 0."""
    floors = [box(width, depth, 0.25, 0, depth / 2, z) for z in np.arange(2.8, height + 1.0, 2.9)]
    pillars = [
        box(0.35, 0.35, height, x, y)
        for x in np.linspace(-width / 2 + 0.2, width / 2 - 0.2, 4)
        for y in (0.2, depth - 0.2)
    ]
    return [(merge(box(width, 0.2, height * 0.8, 0, depth - 0.1), *floors, *pillars), BUILDING)]

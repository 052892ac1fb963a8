"""Vehicles that drive through a simulated street while the sensor does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import inverse
from semloc_logs.simulation.drives.trajectory import poses_along
from semloc_logs.simulation.meshes import objects
from semloc_logs.simulation.meshes.world import Mesh, MeshBuilder, Scene
from semloc_logs.simulation.town.road_network import left_of
from semloc_logs.simulation.town.terrain import Ground

KEEP_OFF = 6.5  # m between the centres of the own and another vehicle


@dataclass(frozen=True, slots=True, eq=False)
class Traffic:
    """``vehicles`` each with a line (n, 2) that it drives, its place on it at time 0 in metres and
    its speed in m/s.
    """

    ground: Ground
    vehicles: tuple[tuple[objects.Parts, F64, float, float], ...]

    def scene(self, seconds: float, world_T_base: F64) -> Scene | None:
        """All vehicles at a time, without those that the own vehicle at ``world_T_base`` (4, 4)
        would touch; None if there are none.
        """
        builder = MeshBuilder(self.ground.height)
        base_T_world = inverse(world_T_base)
        for parts, line, start, speed in self.vehicles:
            length = 0.5 * (len(line) - 1)
            distance = (start + speed * seconds) % length
            pose = poses_along(
                line,
                np.array([distance]),
                self.ground.slope_height,
                np.random.default_rng(0),
                shake=0.0,
            )[0]
            offset = (base_T_world @ pose)[:3, 3]
            # long vehicles keep off by what they are longer than a car
            longer = max(0.0, max(float(mesh.vertices[:, 0].max()) for mesh, _ in parts) - 2.5)
            if np.hypot(max(0.0, abs(offset[0]) - longer), 3 * offset[1]) < KEEP_OFF:
                continue
            for mesh, label in parts:
                builder.add(
                    Mesh(mesh.vertices @ pose[:3, :3].T + pose[:3, 3], mesh.triangles),
                    label,
                    ground="none",
                )
        world = builder.build()
        return Scene(world) if len(world.triangles) else None


def random_traffic(
    rng: np.random.Generator, ground: Ground, lines: list[F64], density: float
) -> Traffic:
    """About ``density`` vehicles, and walkers beside them, every 100 m of smooth lines (n, 2) with
    points every half metre.

    Such lines come from :func:`trajectory.smooth_line`.
    """
    vehicles = []
    for line in lines:
        length = 0.5 * (len(line) - 1)
        vehicles += [
            (
                objects.moving_vehicle(rng),
                line,
                float(rng.uniform(0, length)),
                float(rng.uniform(4, 11)),
            )
            for _ in range(rng.poisson(density * length / 100))
        ]
        beside = pavement(ground, line)
        for _ in range(rng.poisson(0.7 * density * length / 100)):
            way = beside if rng.random() < 0.5 else beside[::-1]
            vehicles.append(
                (
                    objects.person(rng),
                    way,
                    float(rng.uniform(0, length)),
                    float(rng.uniform(0.7, 1.8)),
                )
            )
    return Traffic(ground, tuple(vehicles))


def pavement(ground: Ground, line: F64) -> F64:
    """The line (n, 2) that walkers take to the right of a driven line (n, 2) with points every half
    metre.
    """
    tangent = np.gradient(line, axis=0)
    right = -left_of(tangent / np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9))
    steps = np.arange(1.5, 9.0, 0.25)
    points = line[:, None] + steps[:, None] * right[:, None]
    off = (
        ground.beside[ground.cell(points[..., 0].ravel(), points[..., 1].ravel())] > 0.6
    ).reshape(points.shape[:2])
    distance = np.where(off.any(1), steps[off.argmax(1)], 4.0)
    return np.asarray(line + gaussian_filter1d(distance, 6.0, mode="nearest")[:, None] * right)

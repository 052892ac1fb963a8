"""Lidar sweeps through a triangle world, with range noise and drop-outs, and the errors that a labelling network would make."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semloc_logs.simulation.world import F64, Scene

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class LidarModel:
    """A spinning lidar: beam elevations in degrees from the top, columns a turn, height over ground and longest range in metres."""

    name: str
    elevations_deg: tuple[float, ...]
    columns: int
    height: float
    max_range: float
    noise: float = 0.02


def _even(top: float, bottom: float, beams: int) -> tuple[float, ...]:
    return tuple(float(e) for e in np.linspace(top, bottom, beams))


MODELS = {
    "hdl64": LidarModel("hdl64", _even(2.0, -8.33, 32) + _even(-8.83, -24.8, 32), 1900, 1.73, 80.0),
    "hdl32": LidarModel("hdl32", _even(10.67, -30.67, 32), 1500, 1.9, 70.0),
    "vlp32": LidarModel("vlp32", (15.0, 10.3, 7.0, *_even(4.67, -4.67, 22), -6.0, -7.3, -9.0, -11.3, -14.0, -18.0, -25.0), 1500, 1.9, 90.0),
    "vlp16": LidarModel("vlp16", _even(15.0, -15.0, 16), 1800, 1.8, 80.0),
}


def beam_directions(model: LidarModel, columns: int, sector: tuple[float, float] | None = None) -> tuple[F32, NDArray[np.uint16], F64]:
    """Unit directions (n, 3) in the sensor frame, ring (n,) from the top, and share of the turn (n,); ``sector`` = azimuths in radians."""
    turn = (np.arange(columns) + 0.5) / columns
    azimuth = np.pi - 2 * np.pi * turn
    keep = np.ones(columns, bool) if sector is None else (azimuth >= sector[0]) & (azimuth <= sector[1])
    elevation = np.radians(np.asarray(model.elevations_deg))
    a, e = np.meshgrid(azimuth[keep], elevation, indexing="ij")
    directions = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(-1, 3)
    ring = np.tile(np.arange(len(elevation), dtype=np.uint16), int(keep.sum()))
    return directions.astype(np.float32), ring, np.repeat(turn[keep], len(elevation))


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """Points (n, 3) float32 in the sensor frame in metres, Cityscapes train ids (n,), ring (n,), share of the turn (n,)."""

    points: F32
    labels: U8
    ring: NDArray[np.uint16]
    turn: F64


def full_sweep(
    scene: Scene,
    world_T_lidar: F64,
    rng: np.random.Generator,
    model: LidarModel,
    *,
    columns: int | None = None,
    max_range: float | None = None,
    sector: tuple[float, float] | None = None,
) -> Sweep:
    """One turn of the sensor standing at ``world_T_lidar`` (4, 4); fewer ``columns``, a shorter range, an azimuth ``sector`` if asked."""
    directions, ring, turn = beam_directions(model, columns or model.columns, sector)
    far = min(max_range or model.max_range, model.max_range)
    rotation = world_T_lidar[:3, :3].astype(np.float32)
    rays = directions @ rotation.T
    origin = np.broadcast_to(world_T_lidar[:3, 3].astype(np.float32), rays.shape)
    distance, triangle, normal = scene.cast(origin, rays)
    hit = np.flatnonzero((distance > 0.8) & (distance < far))
    distance, triangle, ray, normal = distance[hit], triangle[hit], rays[hit], normal[hit]
    length = np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    cosine = np.abs(np.einsum("ij,ij->i", normal, ray)) / length
    # the echo weakens with the square of the range and with the cosine of incidence; weak ones are lost at random
    strength = np.clip(cosine, 0.02, 1) * (25.0 / np.maximum(distance, 5.0)) ** 2
    kept = rng.random(len(hit)) < 0.985 * (1 - np.exp(-9.0 * strength))
    hit, distance, triangle, cosine = hit[kept], distance[kept], triangle[kept], cosine[kept]
    distance = distance + rng.normal(size=len(hit)) * model.noise * (1 + 0.5 * (1 - cosine))
    points = (directions[hit] * distance[:, None]).astype(np.float32)
    return Sweep(points, scene.labels[triangle], ring[hit], turn[hit])


def sweep(scene: Scene, world_T_lidar: F64, rng: np.random.Generator, model: LidarModel, **options: object) -> tuple[F32, U8]:
    """Points (n, 3) in the sensor frame and labels (n,) of :func:`full_sweep`, which has the options."""
    result = full_sweep(scene, world_T_lidar, rng, model, **options)  # type: ignore[arg-type]
    return result.points, result.labels

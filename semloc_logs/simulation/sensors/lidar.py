"""Lidar sweeps through a triangle world, with what a sensor adds to them: lost echoes, mixed edges,
bias and noise.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32, F64, U8
from semloc_logs.numerics.transforms import interpolate
from semloc_logs.simulation.meshes.world import Scene
from semloc_logs.simulation.sensors.echoes import beyond_edges, is_heard, mixed_ranges, reflectance
from semloc_logs.simulation.sensors.lidar_models import LidarModel, beam_directions, is_blocked


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """Points (n, 3) float32 in the sensor frame in metres, Cityscapes train ids (n,), ring (n,),
    share of the turn (n,).

    ``beyond`` (n,): the class on the other side of a depth edge beside the point, else its own.
    """

    points: F32
    labels: U8
    ring: NDArray[np.uint16]
    turn: F64
    beyond: U8 | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SweepOptions:
    """How one turn of a sensor differs from a whole one of a standing sensor on a dry road.

    Fewer ``columns``, a shorter ``max_range`` (m), an azimuth ``sector`` (rad). ``traffic`` is a
    second scene, of what moves, that hides the first where it is nearer. With a ``path``
    (k, 4, 4), poses of the sensor in the world at even moments from the turn's start to its end,
    the sensor moves and each point is in the frame of its own moment, as real ones are.
    ``moment``: seconds into its pattern at which the sensor begins (None: at random); ``wet`` in
    [0, 1]: how wet the road is.
    """

    columns: int | None = None
    max_range: float | None = None
    sector: tuple[float, float] | None = None
    traffic: Scene | None = None
    path: F64 | None = None
    moment: float | None = None
    wet: float = 0.0


def full_sweep(
    scene: Scene,
    world_T_lidar: F64,
    rng: np.random.Generator,
    model: LidarModel,
    options: SweepOptions = SweepOptions(),
) -> Sweep:
    """One turn of the sensor standing at ``world_T_lidar`` (4, 4)."""
    moment = float(rng.uniform(0, 1000)) if options.moment is None else options.moment
    count = options.columns or model.columns
    directions, ring, turn = beam_directions(model, count, options.sector, moment)
    beams = len(model.elevations_deg)
    far = min(options.max_range or model.max_range, model.max_range)
    lift = np.zeros((beams, 3), np.float32)
    if model.lift:
        lift[:, 2] = model.lift
    rays, origin = _rays(
        _pointed(rng, directions, beams, model.pointing_deg),
        lift,
        ring,
        turn,
        world_T_lidar,
        options.path,
    )
    distance, labels, normal = _cast(scene, options.traffic, origin, rays)
    distance[is_blocked(model, directions)] = np.inf
    grid = distance.reshape(-1, beams)
    # an edge is cut by the beams of the columns on both sides of it; in a rosette columns follow
    # each other at about a third of a degree
    gap = np.radians(0.35 if model.pattern == "rosette" else model.width_deg / count)
    beyond = beyond_edges(grid, labels.reshape(-1, beams)).reshape(-1)
    measured = (
        mixed_ranges(rng, grid, float(gap), model.divergence).reshape(-1)
        if model.divergence > 0
        else distance
    )
    hit = np.flatnonzero((measured > model.min_range) & (measured < far))
    ray = rays[hit]
    normal = normal[hit]
    seen = labels[hit]
    cosine = np.abs(np.einsum("ij,ij->i", normal, ray)) / np.maximum(
        np.linalg.norm(normal, axis=1), 1e-12
    )
    end = origin[hit] + ray * measured[hit, None]
    kept = is_heard(rng, measured[hit], cosine, reflectance(end, seen, options.wet), seen)
    hit = hit[kept]
    cosine = cosine[kept]
    noise = rng.normal(size=len(hit)) * model.noise * (1 + 0.5 * (1 - cosine))
    bias = (
        np.random.default_rng(zlib.crc32(model.name.encode())).normal(size=beams) * model.beam_bias
    )
    reported = measured[hit] + noise + bias[ring[hit]]
    points = (directions[hit] * reported[:, None] + lift[ring[hit]]).astype(np.float32)
    return Sweep(points, labels[hit], ring[hit], turn[hit], beyond[hit])


def _cast(scene: Scene, traffic: Scene | None, origin: F32, rays: F32) -> tuple[F32, U8, F64]:
    """Distance, class and normal of the first hits in both scenes."""
    distance, triangle, normal = scene.cast(origin, rays)
    labels = np.where(triangle >= 0, scene.labels[triangle], 255).astype(np.uint8)
    if traffic is not None:
        nearer, moving, moving_normal = traffic.cast(origin, rays)
        first = nearer < distance
        distance = np.where(first, nearer, distance)
        labels = np.where(first, traffic.labels[moving], labels)
        normal = np.where(first[:, None], moving_normal, normal)
    return distance, labels, normal


def _pointed(rng: np.random.Generator, directions: F32, beams: int, sigma_deg: float) -> F32:
    """Where the beams really point when their columns are reported at ``directions`` (n, 3)."""
    if sigma_deg <= 0:
        return directions
    off = np.repeat(
        np.radians(sigma_deg) * rng.normal(size=len(directions) // beams), beams
    ).astype(np.float32)
    return directions + np.stack(
        [-directions[:, 1] * off, directions[:, 0] * off, np.zeros_like(off)], 1
    )


def _rays(
    directions: F32, lift: F32, ring: NDArray[np.uint16], turn: F64, start: F64, path: F64 | None
) -> tuple[F32, F32]:
    """Directions and origins (n, 3) in the world for rays of a sensor that stands at ``start`` or
    moves along ``path``.

    ``lift`` (beams, 3) are the origins of the beams in the sensor frame.
    """
    if path is None:
        rotation = start[:3, :3].astype(np.float32)
        return directions @ rotation.T, (lift @ rotation.T + start[:3, 3].astype(np.float32))[ring]
    # poses are a hundred microseconds apart at most: half a millimetre at 5 m/s
    moments = np.linspace(0, 1, 1001)
    stamps = np.linspace(0, 10**9, len(path)).astype(np.int64)
    poses = interpolate(stamps, path, (moments * 1e9).astype(np.int64)).astype(np.float32)
    poses = poses[np.round(turn * 1000).astype(np.int64)]
    rotation = poses[:, :3, :3]
    return np.einsum("nij,nj->ni", rotation, directions), rotation[:, :, 2] * lift[
        ring, 2:
    ] + poses[:, :3, 3]

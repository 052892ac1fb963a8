"""Lidar sweeps through a triangle world, with range noise and drop-outs, and the errors that a labelling network would make."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semloc_logs.geometry import interpolate
from semloc_logs.simulation.world import BUILDING, CAR, F64, Scene

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
    min_range: float = 1.0


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
    traffic: Scene | None = None,
    world_T_end: F64 | None = None,
) -> Sweep:
    """One turn of the sensor standing at ``world_T_lidar`` (4, 4); fewer ``columns``, a shorter range, an azimuth ``sector`` if asked.

    ``traffic`` is a second scene, of what moves, that hides the first where it is nearer.
    With ``world_T_end`` the sensor moves during the turn and each point is in the frame of its own moment, as real ones are.
    """
    directions, ring, turn = beam_directions(model, columns or model.columns, sector)
    far = min(max_range or model.max_range, model.max_range)
    rays, origin = _rays(directions, turn, world_T_lidar, world_T_end)
    distance, triangle, normal = scene.cast(origin, rays)
    labels = np.where(triangle >= 0, scene.labels[triangle], 255).astype(np.uint8)
    if traffic is not None:
        nearer, moving, moving_normal = traffic.cast(origin, rays)
        first = nearer < distance
        distance, labels = np.where(first, nearer, distance), np.where(first, traffic.labels[moving], labels)
        normal = np.where(first[:, None], moving_normal, normal)
    hit = np.flatnonzero((distance > model.min_range) & (distance < far))
    distance, labels, ray, normal = distance[hit], labels[hit], rays[hit], normal[hit]
    length = np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    cosine = np.abs(np.einsum("ij,ij->i", normal, ray)) / length
    # the echo weakens with the square of the range and with the cosine of incidence; weak ones are lost at random
    strength = np.clip(cosine, 0.02, 1) * (25.0 / np.maximum(distance, 5.0)) ** 2
    end = origin[hit] + ray * distance[:, None]
    kept = rng.random(len(hit)) < 0.985 * (1 - np.exp(-9.0 * strength)) * np.where(_glass(end, labels), 0.35, 1.0)
    hit, distance, labels, cosine = hit[kept], distance[kept], labels[kept], cosine[kept]
    distance = distance + rng.normal(size=len(hit)) * model.noise * (1 + 0.5 * (1 - cosine))
    points = (directions[hit] * distance[:, None]).astype(np.float32)
    return Sweep(points, labels, ring[hit], turn[hit])


def _rays(directions: F32, turn: F64, start: F64, end: F64 | None) -> tuple[F32, F32]:
    """Directions and origins (n, 3) in the world for rays of a sensor that stands at ``start`` or moves from there to ``end``."""
    if end is None:
        return directions @ start[:3, :3].T.astype(np.float32), np.broadcast_to(start[:3, 3].astype(np.float32), directions.shape)
    moments, inverse = np.unique(turn, return_inverse=True)
    poses = interpolate(np.array([0, 10**9]), np.stack([start, end]), (moments * 1e9).astype(np.int64))[inverse].astype(np.float32)
    return np.einsum("nij,nj->ni", poses[:, :3, :3], directions), np.ascontiguousarray(poses[:, :3, 3])


def sweep(scene: Scene, world_T_lidar: F64, rng: np.random.Generator, model: LidarModel, **options: object) -> tuple[F32, U8]:
    """Points (n, 3) in the sensor frame and labels (n,) of :func:`full_sweep`, which has the options."""
    result = full_sweep(scene, world_T_lidar, rng, model, **options)  # type: ignore[arg-type]
    return result.points, result.labels


def _glass(world_points: F64, labels: U8) -> NDArray[np.bool_]:
    """Which points (n, 3) lie on panes, that mostly give no echo: fixed patches of facades and of vehicles."""
    patch = _hash(np.floor(world_points / [1.1, 1.1, 1.3]).astype(np.int64)) % 100
    pane: NDArray[np.bool_] = ((labels == BUILDING) & (patch < 14)) | ((labels >= CAR) & (labels <= CAR + 2) & (patch < 40))
    return pane


def _hash(cells: NDArray[np.int64], seed: int = 0) -> NDArray[np.int64]:
    """A number in [0, 2^31) for each integer cell (n, 3)."""
    mixed = cells @ np.array([73856093, 19349663, 83492791]) + seed * 2654435761
    mixed ^= mixed >> 15
    mixed *= 2246822519
    mixed ^= mixed >> 13
    mixed *= 3266489917
    return np.asarray((mixed ^ (mixed >> 16)) & 0x7FFFFFFF)


# what a labelling network takes a class for when it is wrong
CONFUSIONS: dict[int, tuple[int, ...]] = {
    0: (1, 9, 1),
    1: (0, 9, 0),
    2: (3, 4, 8, 255),
    3: (2, 4, 8),
    4: (3, 8, 2),
    5: (8, 7, 2, 255),
    6: (5, 7, 8),
    7: (5, 2, 8),
    8: (9, 4, 2, 255),
    9: (8, 1, 0),
    11: (12, 8, 5),
    12: (11, 18, 17),
    13: (14, 2, 15),
    14: (13, 15, 2),
    15: (14, 13, 2),
    16: (15, 14, 2),
    17: (18, 13, 11),
    18: (17, 8, 4),
    255: (2, 8, 3),
}


def corrupt_labels(points: NDArray[np.floating], labels: U8, seed: int, rate: float) -> U8:
    """The labels (n,) with about the share ``rate`` of them wrong as a network's are: in patches of 0.5 m and 2.5 m and single points.

    Patches follow from ``points`` (n, 3) and ``seed``: points in a fixed frame and the same seed give the same errors in every sweep.
    """
    table = np.full((256, 12), 255, np.uint8)
    for label, wrong in CONFUSIONS.items():
        table[label] = np.resize(np.asarray(wrong, np.uint8), 12)
    out = labels.copy()
    single = np.arange(len(points), dtype=np.int64)[:, None] * np.array([1, 0, 0])
    scales = [np.floor(np.asarray(points, np.float64) / size).astype(np.int64) for size in (2.5, 0.5)] + [single]
    for k, (cells, share) in enumerate(zip(scales, (0.45, 0.4, 0.15), strict=True)):
        # the class takes part in the hash, so that a patch is a piece of one object
        draw = _hash(np.column_stack([cells[:, :2], cells[:, 2] * 256 + labels]), seed * 3 + k)
        wrong_here = (draw % 4096) < 4096 * share * rate
        out[wrong_here] = table[labels[wrong_here], (draw[wrong_here] >> 12) % 12]
    return out

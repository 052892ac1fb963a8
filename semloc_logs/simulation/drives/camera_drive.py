"""What the cameras of a vehicle record while it drives through a world: pairs of pictures, or
pictures with depth, and label images.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from semloc_logs.arrays import F32, F64, U8
from semloc_logs.numerics.transforms import apply, interpolate
from semloc_logs.simulation.conditions import Condition
from semloc_logs.simulation.drives.traffic import Traffic
from semloc_logs.simulation.drives.trajectory import Trajectory
from semloc_logs.simulation.meshes.world import Scene, World
from semloc_logs.simulation.sensors.camera import (
    CAMERAS,
    CameraModel,
    Hits,
    base_T_camera,
    first_hits,
    measure,
    pixel_rays,
)
from semloc_logs.simulation.sensors.label_errors import corrupt_labels
from semloc_logs.simulation.sensors.rendered_images import Painter
from semloc_logs.simulation.sensors.sensor import Sensor

SKY = 10  # Cityscapes train id
_SHIFT = 2.0  # px by which masks miss edges at a share of 0.1 of wrong labels


@dataclass(frozen=True, slots=True, eq=False)
class CameraShot:
    """What the cameras record at ``stamp_ns``: RGB pictures (h, w, 3) of the left or only camera
    and of the right one, which sits ``model.baseline`` further right, or depth (h, w) in metres
    with 0 for holes; ``labels`` (h, w) Cityscapes train ids of the left.
    """

    stamp_ns: int
    model: CameraModel
    base_T_camera: F64
    picture: U8
    right: U8 | None
    depth: F32 | None
    labels: U8


def simulate_cameras(
    world: World,
    trajectory: Trajectory,
    sensor: Sensor,
    *,
    seed: int = 0,
    condition: Condition | None = None,
    traffic: Traffic | None = None,
) -> Iterator[CameraShot]:
    """Shots of a ``stereo`` pair or a camera with ``depth`` along a trajectory, one at a time.

    ``condition`` gives light and season of the pictures.
    """
    model = CAMERAS[sensor.name]
    mounted = base_T_camera(model)
    painter = Painter(Scene(world), condition)
    rng = np.random.default_rng([seed, 43])
    rays = pixel_rays(model)
    stamps = trajectory.stamps_ns
    first = int(stamps[0])
    for number, stamp in enumerate(range(first, int(stamps[-1]) + 1, round(1e9 / sensor.rate_hz))):
        pose = interpolate(stamps, trajectory.world_T_base, np.array([stamp]))[0]
        moving = traffic.scene((stamp - first) * 1e-9, pose) if traffic else None
        left = pose @ mounted
        hits = first_hits(painter.scene, left, rays, moving)
        picture = painter.picture(left, rng, model, traffic=moving, hits=hits)
        right = None
        depth = None
        if sensor.name == "depth":
            depth = measure(hits, rays, left, rng, model).depth
        else:
            other = left.copy()
            other[:3, 3] += model.baseline * left[:3, 0]
            right = painter.picture(other, rng, model, traffic=moving)
        labels = wrong_label_image(hits, rays, left, seed, sensor.label_noise, number)
        yield CameraShot(stamp, model, mounted, picture, right, depth, labels)


def wrong_label_image(
    hits: Hits, rays: F32, world_T_camera: F64, seed: int, rate: float, frame: int
) -> U8:
    """The label image (h, w), sky 10, as a network makes it that is wrong about a share ``rate`` of
    the pixels: objects taken for others by patches of the world, and masks whose edges miss those
    of the picture by some pixels.
    """
    seen = np.isfinite(hits.depth)
    labels = np.where(seen, hits.labels, np.uint8(SKY))
    if rate <= 0:
        return labels
    points = apply(world_T_camera, rays[seen] * hits.depth[seen][:, None])
    labels[seen] = corrupt_labels(points, labels[seen], seed, 0.85 * rate, frame=frame)
    rng = np.random.default_rng([seed, 44, frame])
    height, width = labels.shape
    coarse = rng.standard_normal((2, height // 16 + 2, width // 16 + 2), np.float32) * np.float32(
        _SHIFT * min(1.0, rate / 0.1)
    )
    shift = [cv2.resize(c, (width, height), interpolation=cv2.INTER_CUBIC) for c in coarse]
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float32)
    return np.asarray(
        cv2.remap(
            labels,
            columns + shift[0],
            rows + shift[1],
            cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_REPLICATE,
        ),
        np.uint8,
    )

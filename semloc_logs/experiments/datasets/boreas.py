"""Boreas (Burnett et al., IJRR 2023): a folder such as ``boreas-2021-08-05-13-34/`` with
``lidar/UTIME.bin`` and ``applanix/lidar_poses.csv``, perhaps ``camera/UTIME.png`` with
``calib/P_camera.txt`` and ``calib/T_camera_lidar.txt``.

Times are microseconds, of a sweep its middle; poses are of the LIDAR in a frame east, north, up.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from semloc_logs.experiments.datasets.recording import (
    CameraFiles,
    CloudFile,
    Recording,
    Track,
    numbered,
    read_numbers,
    read_records,
    sequences_with,
)
from semloc_logs.numerics.transforms import inverse

_TO_NS = 1000  # from microseconds
_FIELDS = 6  # x y z intensity laser time


def boreas_recordings(folder: Path) -> list[Recording]:
    """The sequence of a folder, or all sequences in it. LogError without any."""
    sequences = sequences_with(folder, "lidar", "a sequence such as boreas-2021-08-05-13-34")
    return [_recording(sequence) for sequence in sequences]


def _recording(sequence: Path) -> Recording:
    values = read_numbers(sequence / "applanix" / "lidar_poses.csv", range(10), ",")
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    # Rx(-roll) Ry(-pitch) Rz(-yaw), as the development kit has it (get_transform)
    poses[:, :3, :3] = Rotation.from_euler("XYZ", -values[:, 7:10]).as_matrix()
    poses[:, :3, 3] = values[:, 1:4]
    track = Track(values[:, 0].astype(np.int64) * _TO_NS, poses)
    files = numbered(sequence / "lidar", ".bin")
    return Recording(
        sequence.resolve().name.replace("-", "_"),
        track,
        track,
        partial(_sweeps, files),
        cameras=_cameras(sequence),
    )


def _sweeps(files: list[tuple[int, Path]]) -> Iterator[CloudFile]:
    for utime, path in files:
        points = read_records(path, "<f4", _FIELDS)
        seconds = points[:, 5].astype(float)
        first = float(seconds.min()) if len(seconds) else 0.0
        stamp_ns = utime * _TO_NS + round(first * 1e9)
        offset = np.round((seconds - first) * 1e9).astype(np.uint32)
        yield CloudFile(stamp_ns, points[:, :3], offset_ns=offset)


def _cameras(sequence: Path) -> list[CameraFiles]:
    """The camera, where it has pictures and a calibration."""
    calibration = sequence / "calib"
    files = numbered(sequence / "camera", ".png")
    projection = calibration / "P_camera.txt"
    mounting = calibration / "T_camera_lidar.txt"
    if not files or not projection.exists() or not mounting.exists():
        return []
    matrix = read_numbers(projection)[:3, :3]
    lidar_T_camera = inverse(read_numbers(mounting)[:4, :4])
    stamped = [(utime * _TO_NS, path) for utime, path in files]
    return [CameraFiles("front", matrix, lidar_T_camera, stamped)]

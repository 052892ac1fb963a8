"""KITTI odometry (Geiger, Lenz, Urtasun, CVPR 2012) and SemanticKITTI (Behley et al., ICCV 2019).

``sequences/NN/`` with ``velodyne/``, ``times.txt``, ``calib.txt``, perhaps ``image_2/`` and
``image_3/`` (else ``image_0/`` and ``image_1/``); poses of the left grey camera in
``poses/NN.txt``, of SemanticKITTI in ``sequences/NN/poses.txt``, with ``labels/``. The sweeps are
rectified by the data set: points have no times.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError
from semloc_logs.experiments.datasets.recording import (
    CameraFiles,
    CloudFile,
    Recording,
    Track,
    numbered,
    read_bytes,
    read_numbers,
    read_records,
)
from semloc_logs.numerics.transforms import inverse

_START_NS = 1_317_000_000_000_000_000  # September 2011: times.txt begins at 0
_PAIRS = ((2, 3), (0, 1))  # cameras, left and right: colour, else grey


def kitti_recordings(folder: Path) -> list[Recording]:
    """All sequences with poses below a folder of KITTI odometry. LogError without any."""
    return _recordings(folder, semantic=False)


def semantickitti_recordings(folder: Path) -> list[Recording]:
    """All sequences with labels and poses below a folder of SemanticKITTI. LogError without any."""
    return _recordings(folder, semantic=True)


def _recordings(folder: Path, *, semantic: bool) -> list[Recording]:
    sequences = sorted(p for p in (folder / "sequences").glob("*") if (p / "velodyne").is_dir())
    if semantic:
        sequences = [p for p in sequences if (p / "labels").is_dir()]
    recordings = [(p, _poses_file(folder, p, semantic=semantic)) for p in sequences]
    out = [_recording(p, poses, semantic=semantic) for p, poses in recordings if poses is not None]
    if not out:
        wanted = "velodyne/, labels/ and poses.txt" if semantic else "velodyne/ and poses/NN.txt"
        raise LogError(f"{folder} has no sequences/NN/ with {wanted}: give the folder above them.")
    return out


def _poses_file(folder: Path, sequence: Path, *, semantic: bool) -> Path | None:
    """SemanticKITTI's poses are more accurate; KITTI's lie beside the sequences."""
    choices = [sequence / "poses.txt", folder / "poses" / f"{sequence.name}.txt"]
    return next((p for p in (choices if semantic else choices[::-1]) if p.exists()), None)


def _recording(sequence: Path, poses_file: Path, *, semantic: bool) -> Recording:
    calibration = _calibration(sequence / "calib.txt")
    times = read_numbers(sequence / "times.txt")[:, 0]
    stamps = _START_NS + np.round(times * 1e9).astype(np.int64)
    values = read_numbers(poses_file, range(12))[:, :12].reshape(-1, 3, 4)
    count = min(len(values), len(stamps))
    camera_poses = np.tile(np.eye(4), (count, 1, 1))
    camera_poses[:, :3] = values[:count]
    # the base is the LIDAR: z up, while KITTI's poses are of a camera with y down
    camera_T_lidar = calibration["Tr"]
    track = Track(stamps[:count], inverse(camera_T_lidar) @ camera_poses @ camera_T_lidar)
    name = f"{'semantickitti' if semantic else 'kitti'}_{sequence.name}"
    return Recording(
        name,
        track,
        track,
        partial(_sweeps, sequence, stamps, semantic=semantic),
        cameras=_cameras(sequence, calibration, stamps),
        label_space="semantickitti" if semantic else "",
    )


def _calibration(path: Path) -> dict[str, F64]:
    """P0 to P3 and Tr as (4, 4)."""
    out = {}
    for line in read_bytes(path).decode("ascii", "replace").splitlines():
        name, _, text = line.partition(":")
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            continue
        if len(values) == 12:
            out[name.strip()] = np.vstack([values.reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    missing = {"P0", "Tr"} - set(out)
    if missing:
        raise LogError(f"{path} has no {min(missing)}: give the calibration of KITTI odometry.")
    return out


def _sweeps(sequence: Path, stamps: NDArray[np.int64], *, semantic: bool) -> Iterator[CloudFile]:
    for number, path in numbered(sequence / "velodyne", ".bin"):
        if number >= len(stamps):
            continue
        points = read_records(path, "<f4", 4)[:, :3]
        label = None
        if semantic:
            labels = sequence / "labels" / f"{path.stem}.label"
            label = read_records(labels, "<u4")[:, 0]
            if len(label) != len(points):
                raise LogError(f"{labels} has {len(label)} labels for {len(points)} points.")
        yield CloudFile(int(stamps[number]), points, label)


def _cameras(
    sequence: Path, calibration: dict[str, F64], stamps: NDArray[np.int64]
) -> list[CameraFiles]:
    """A pair of rectified cameras, where both have pictures."""
    for left, right in _PAIRS:
        names = (f"P{left}", f"P{right}")
        folders = [sequence / f"image_{k}" for k in (left, right)]
        if not all(name in calibration for name in names) or not all(f.is_dir() for f in folders):
            continue
        places = [_place(calibration[name]) for name in names]
        lidar_T_camera0 = inverse(calibration["Tr"])
        baseline = float(places[1][0, 3] - places[0][0, 3])
        return [
            CameraFiles(
                name,
                calibration[names[k]][:3, :3],
                lidar_T_camera0 @ places[k],
                [
                    (int(stamps[number]), path)
                    for number, path in numbered(folders[k], ".png")
                    if number < len(stamps)
                ],
                baseline if k else 0.0,
            )
            for k, name in enumerate(("left", "right"))
        ]
    return []


def _place(projection: F64) -> F64:
    """``camera0_T_camera`` (4, 4) of P = K [I | t]: the camera sits at -t."""
    out = np.eye(4)
    out[:3, 3] = -np.linalg.solve(projection[:3, :3], projection[:3, 3])
    return out

"""NCLT (Carlevaris-Bianco, Ushani, Eustice, IJRR 2016): a folder such as ``2012-01-08/`` with
``velodyne_sync/UTIME.bin`` and ``odometry_mu_100hz.csv``, and ``groundtruth_2012-01-08.csv`` in it
or beside it.

Points and poses are of a body with x ahead, y right, z down, in a world north, east, down; the log
has y left and z up. Its pictures need the undistortion maps of the data set and are left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError
from semloc_logs.experiments.datasets.recording import (
    CloudFile,
    Recording,
    Track,
    numbered,
    read_numbers,
    read_records,
    sequences_with,
)
from semloc_logs.numerics.transforms import interpolate

_HIT = np.dtype([("x", "<u2"), ("y", "<u2"), ("z", "<u2"), ("intensity", "u1"), ("laser", "u1")])
_STEP_M, _OFFSET_M = 0.005, -100.0
_UP = np.diag([1.0, -1.0, -1.0, 1.0])  # of a frame with z down, seen with z up
_TO_NS = 1000  # from microseconds


def nclt_recordings(folder: Path) -> list[Recording]:
    """The session of a folder, or all sessions in it. LogError without any."""
    sessions = sequences_with(folder, "velodyne_sync", "a session such as 2012-01-08")
    return [_recording(session) for session in sessions]


def _recording(session: Path) -> Recording:
    name = session.resolve().name
    file = f"groundtruth_{name}.csv"
    truth = next((p for p in (session / file, session.parent / file) if p.exists()), None)
    if truth is None:
        raise LogError(f"{session} has no {file}, neither in it nor beside it: download it.")
    true = _track(truth)
    odometry = _track(session / "odometry_mu_100hz.csv")
    sweeps = numbered(session / "velodyne_sync", ".bin")
    if sweeps:
        true = _at_ends(true, sweeps)
    return Recording(f"nclt_{name}", odometry, true, partial(_sweeps, sweeps))


def _track(path: Path) -> Track:
    """utime, x, y, z, roll, pitch, heading (m, rad); rows with gaps are left out."""
    values = read_numbers(path, range(7), ",")
    values = values[np.isfinite(values[:, :7]).all(axis=1)]
    if not len(values):
        raise LogError(f"{path} has no whole rows.")
    _, first = np.unique(values[:, 0], return_index=True)
    values = values[first]
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("xyz", values[:, 4:7]).as_matrix()
    poses[:, :3, 3] = values[:, 1:4]
    return Track(values[:, 0].astype(np.int64) * _TO_NS, _UP @ poses @ _UP)


def _at_ends(track: Track, sweeps: list[tuple[int, Path]]) -> Track:
    """The track, and its poses at the sweeps within it."""
    stamps = np.array([utime * _TO_NS for utime, _ in sweeps], np.int64)
    inside = stamps[(stamps >= track.stamps_ns[0]) & (stamps <= track.stamps_ns[-1])]
    every = np.union1d(track.stamps_ns, inside)
    return Track(every, interpolate(track.stamps_ns, track.poses, every))


def _sweeps(files: list[tuple[int, Path]]) -> Iterator[CloudFile]:
    for utime, path in files:
        hits = read_records(path, "V8")[:, 0].view(_HIT)
        points: F64 = np.stack([hits[axis] for axis in "xyz"], axis=1) * _STEP_M + _OFFSET_M
        yield CloudFile(utime * _TO_NS, (points @ _UP[:3, :3]).astype(np.float32))

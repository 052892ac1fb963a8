"""The direction of up from the accelerometer: at rest and on average it measures gravity only."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.frames import ImuSample
from semloc_logs.logs.poses.base_frame import BasePoses
from semloc_logs.logs.poses.track import is_time

# beyond, every second sample is forgotten and only every 2nd (4th, ...) taken: the whole log at
# bounded memory
MAX_SAMPLES = 16_384
# of the mean; some drivers report g instead of m/s^2, linear acceleration without gravity is near 0
_MIN_FORCE, _MAX_FORCE = 0.5, 30.0


class Accelerometer:
    """Specific force over a log, evenly thinned; the ``frame_id`` of the first sample counts."""

    def __init__(self) -> None:
        self.frame_id: str | None = None
        self._stamps: list[int] = []
        self._forces: list[F64] = []
        self._every = 1
        self._seen = 0

    def add(self, sample: ImuSample) -> None:
        """Takes a sample; one of another frame or with NaN is left out."""
        if self.frame_id is None:
            self.frame_id = sample.header.frame_id
        is_number = np.isfinite(sample.acceleration).all() and is_time(sample.header.stamp_ns)
        if sample.header.frame_id != self.frame_id or not is_number:
            return
        self._seen += 1
        if self._seen % self._every:
            return
        self._stamps.append(sample.header.stamp_ns)
        self._forces.append(sample.acceleration)
        if len(self._stamps) >= MAX_SAMPLES:
            del self._stamps[::2], self._forces[::2]
            self._every *= 2

    def up(
        self,
        rotations_at: Callable[[NDArray[np.int64]], tuple[F64, NDArray[np.bool_]]] | None = None,
    ) -> F64 | None:
        """Unit vector (3,) of the mean force in the IMU frame, or turned by ``rotations_at``.

        ``rotations_at`` gives rotations (m, 3, 3) at stamps (m,) and which are known. None without
        enough samples.
        """
        if not self._stamps:
            return None
        forces = np.array(self._forces, float)
        if rotations_at is not None:
            rotations, known = rotations_at(np.array(self._stamps, np.int64))
            forces = np.einsum("nij,nj->ni", rotations[known], forces[known])
        return _robust_direction(forces)


def up_in_base(accelerometer: Accelerometer, where: BasePoses) -> F64 | None:
    """Unit vector (3,) that points up in the base frame; None without a usable IMU."""
    base_T_imu = _base_T_imu(accelerometer, where)
    up = accelerometer.up()
    return None if base_T_imu is None or up is None else base_T_imu[:3, :3] @ up


def up_in_session(accelerometer: Accelerometer, where: BasePoses) -> F64 | None:
    """As :func:`up_in_base`, in the session frame.

    Every sample is turned by the pose at its time, so the base may tilt.
    """
    base_T_imu = _base_T_imu(accelerometer, where)
    if base_T_imu is None or not len(where.track):
        return None
    base_R_imu = base_T_imu[:3, :3]

    def rotations_at(stamps_ns: NDArray[np.int64]) -> tuple[F64, NDArray[np.bool_]]:
        poses, known = where.track.at_many(stamps_ns)
        return poses[:, :3, :3] @ base_R_imu, known

    return accelerometer.up(rotations_at)


def _base_T_imu(accelerometer: Accelerometer, where: BasePoses) -> F64 | None:
    frame_id = accelerometer.frame_id
    return None if frame_id is None else where.base_T(frame_id, where.track.end_ns or 0)


def _robust_direction(forces: F64) -> F64 | None:
    if len(forces) == 0:
        return None
    median = np.median(forces, axis=0)
    distance = np.linalg.norm(forces - median, axis=1)
    # braking, bumps and curves are outliers; half of the samples stay in any case
    mean = forces[distance <= np.median(distance) + 1e-9].mean(axis=0)
    force = float(np.linalg.norm(mean))
    return mean / force if _MIN_FORCE <= force <= _MAX_FORCE else None

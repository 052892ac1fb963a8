"""How far interpolated poses are off, by the poses themselves.

Between two poses the way is straight, and the turn steady. What that leaves out is half of the
second derivative times the times to both of them; the derivative shows in three poses each.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64, I64
from semloc_logs.logs.poses.track import PoseTrack

_FEWEST = 5  # poses that show how the motion changes
# s: between poses nearer than this no vehicle is far off, and their noise looks like a motion
_SHORT = 0.3
# of the longer time to a neighbour is the shorter one at least: poses in bursts show their noise
_EVEN = 0.5


def interpolation_errors(track: PoseTrack, stamps_ns: I64) -> tuple[F64, F64]:
    """Errors (n,) of the positions (m) and the rotations (rad) at ``stamps_ns`` (n,).

    0 at the stamp of a pose, outside of the poses, where gaps leave too few of them, and between
    poses that follow each other soon or come in bursts.
    """
    meters = np.zeros(len(stamps_ns))
    radians = np.zeros(len(stamps_ns))
    stamps = track.stamps_ns
    if len(stamps) < _FEWEST:
        return meters, radians
    left = np.searchsorted(stamps, stamps_ns, side="right") - 1
    rows = np.flatnonzero((left >= 0) & (left < len(stamps) - 1))
    left = left[rows]
    before = (stamps_ns[rows] - stamps[left]) * 1e-9
    after = (stamps[left + 1] - stamps_ns[rows]) * 1e-9
    apart = before + after
    is_within = (apart <= track.gap_limit_ns() * 1e-9) & (apart >= _SHORT)
    needed = np.unique(np.clip(np.concatenate([left, left + 1]), 1, len(stamps) - 2))
    bends = _bends(track, needed)
    of_both = [
        bends[np.searchsorted(needed, np.clip(pose, 1, len(stamps) - 2))]
        for pose in (left, left + 1)
    ]
    errors = np.mean(of_both, axis=0) * (before * after * is_within)[:, None]
    meters[rows] = errors[:, 0]
    radians[rows] = errors[:, 1]
    return meters, radians


def _bends(track: PoseTrack, poses: I64) -> F64:
    """Half of the second derivatives (n, 2) at poses (n,): m/s^2, rad/s^2; 0 beside a gap, and in
    a burst.
    """
    stamps = track.stamps_ns
    before = (stamps[poses] - stamps[poses - 1]) * 1e-9
    after = (stamps[poses + 1] - stamps[poses]) * 1e-9
    longer = np.maximum(before, after)
    is_known = longer <= track.gap_limit_ns() * 1e-9
    is_known &= np.minimum(before, after) >= _EVEN * longer
    bends = []
    written = track.poses
    for steps in (_moves, _turns):
        change = steps(written[poses], written[poses - 1]) / before[:, None]
        change += steps(written[poses], written[poses + 1]) / after[:, None]
        bends.append(np.linalg.norm(change, axis=1) / (before + after))
    return np.where(is_known[:, None], np.stack(bends, axis=1), 0.0)


def _moves(poses: F64, others: F64) -> F64:
    """Translations (n, 3) from poses to others."""
    return np.asarray(others[:, :3, 3] - poses[:, :3, 3])


def _turns(poses: F64, others: F64) -> F64:
    """Rotation vectors (n, 3) from poses to others."""
    back = np.swapaxes(poses[:, :3, :3], 1, 2)
    return np.asarray(Rotation.from_matrix(back @ others[:, :3, :3]).as_rotvec())

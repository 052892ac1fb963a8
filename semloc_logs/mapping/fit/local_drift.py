"""How far poses drift over the road that a map of a place is made from, as range data show it.

Keyframes some way apart are registered with each other, there and back, from the motion that the
poses give; what the registration changes is drift, less what both ways differ.
"""

from __future__ import annotations

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.mapping.drift import Drift
from semloc_logs.mapping.fit.keyframe_pairs import LEAST_SHARE, Clouds, Registrar, motion
from semloc_logs.mapping.fit.model import difference
from semloc_logs.numerics.evenly import evenly
from semloc_logs.numerics.transforms import inverse

WAY = 40.0  # voxels between both keyframes: about the road of a query
LONGEST_WAY = 1.5  # of it: where keyframes are sparse, or poses jump
PAIRS = 16
LEAST_PAIRS = 8
LOOKED_AT = 64  # keyframes that pairs are looked for at
LONGEST_NS = 3_000_000_000  # from keyframe to keyframe: in a gap poses may have jumped
# registrations that differ there and back by more than so many times the usual went wrong
AGREE = 3.0
JUMP = 4.0  # times the usual change of a pair: poses were corrected there
# of the way: registrations of more noise than this tell less than is known anyway
MOST_NOISE = 0.003


def local_drift(clouds: Clouds) -> Drift | None:
    """The drift of the poses of one stream's keyframes; None where these do not show it."""
    numbers = apart(clouds)
    registrar = Registrar(clouds)
    met = []
    for target, source in numbers:
        given = motion(clouds, target, source)
        there = registrar.fit(target, source, [given])
        back = registrar.fit(source, target, [inverse(given)])
        if min(there.share, back.share) >= LEAST_SHARE:
            met.append((given, there.target_T_source, inverse(back.target_T_source)))
    if len(met) < LEAST_PAIRS:
        return None
    motions = np.array(met)
    return drift_of(motions[:, 0], motions[:, 1], motions[:, 2])


def drift_of(given: F64, there: F64, back: F64) -> Drift | None:
    """The drift of ``given`` motions (n, 4, 4), registered twice; None where both ways differ."""
    off = np.stack([difference(there, given), difference(back, given)])
    noise = 0.5 * (off[0] - off[1])
    lengths = np.linalg.norm(noise[:, :3], axis=1)
    changes = np.linalg.norm(off.mean(0)[:, :3], axis=1)
    usual = np.median(lengths)
    agree = (lengths <= AGREE * usual) & (changes <= JUMP * np.median(changes) + usual)
    way = float(np.sqrt(np.mean(np.sum(given[agree, :3, 3] ** 2, axis=1))))
    noise_squares = np.mean(noise[agree] ** 2, axis=0)
    if float(np.sqrt(noise_squares[:3].max())) > MOST_NOISE * way:
        return None
    squares = np.mean(off.mean(0)[agree] ** 2, axis=0)
    # the mean of n squares of noise is itself known to a share of (2 / n)^0.5
    unknown = np.sqrt(2.0 / np.count_nonzero(agree)) * noise_squares
    return Drift.of(np.sqrt(np.maximum(squares - noise_squares, 0.0) + unknown) / way)


def apart(clouds: Clouds) -> list[tuple[int, int]]:
    """Numbers of the target and the source of at most :data:`PAIRS` pairs, evenly spread."""
    way = WAY * clouds.voxel
    poses = [clouds.pose(number) for number in range(len(clouds.rows))]
    known = [number for number, pose in enumerate(poses) if pose is not None]
    positions = np.array([pose[:3, 3] for pose in poses if pose is not None])
    chosen = []
    stamps_ns = clouds.stamps_ns()[known]
    breaks = np.flatnonzero(np.diff(stamps_ns) > LONGEST_NS) + 1
    ends = np.append(breaks, len(known))  # of the stretches without a gap
    for k in evenly(len(known), LOOKED_AT).tolist():
        end = int(ends[np.searchsorted(ends, k, side="right")])
        lengths = np.linalg.norm(positions[k + 1 : end] - positions[k], axis=1)
        far = np.flatnonzero(lengths >= way)
        if len(far) and lengths[far[0]] <= LONGEST_WAY * way:
            chosen.append((known[k], known[k + 1 + int(far[0])]))
    return [chosen[i] for i in evenly(len(chosen), PAIRS)]

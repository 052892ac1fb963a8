"""Pairs of clouds that contradict the poses, or each other, where no fault explains it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.logs.messages.stamps import time_range
from semloc_logs.mapping.fit.findings import WRONG, Finding, Severity, StreamFit
from semloc_logs.mapping.fit.keyframe_pairs import (
    LEAST_SHARE,
    Clouds,
    Registered,
    choose,
    noise,
    registered,
)
from semloc_logs.mapping.fit.model import (
    MEDIAN_OF_6,
    PARAMETERS,
    PosesAt,
    difference,
    pose_motion,
)

# registrations with a smaller share of points on planes may have ended anywhere; a sensor with few
# lines has so few on planes everywhere, which tell where it brings far more onto them
TELLING = 0.2
FEW_TELLING, FEW_CONTRADICT = 0.08, 1.5
# a pair contradicts its poses when registration brings so many times the points onto planes
CONTRADICTS = 1.15
CONTRADICTION = 50.0  # and its squared distance is larger
LEAST_CONTRADICTIONS = 2  # one after the other
WRONG_TURN = 0.03  # rad, within a pair: a submap of 20 m would be bent by 15 degrees
LEAST_DRIFT = np.radians(0.3)  # rad/m, worth a word: odometry drifts by a tenth of it
STEADY = 0.9  # of the turns of contradicting pairs, summed up, where poses drift to one side
# a camera's clouds move otherwise in the median: voxels, and radians
MOST_OFF, MOST_TURNED = 2.5, 0.045
UNEXPLAINED = 30.0  # times the noise of registration, of squared distances in the median
# clouds usually have so many times the least share of points on planes of the ones beside them; so
# many pairs in a row that have less are more than one damaged cloud
USUALLY_ALIKE, LEAST_STRANGERS = 5.0, 3


def add_strangers(
    stream: StreamFit, clouds: Clouds, numbers: Sequence[tuple[int, int]], given: Registered
) -> None:
    """Names the time where clouds fit none beside them, from any start, although most others do."""
    if float(np.median(given.share)) < USUALLY_ALIKE * LEAST_SHARE:
        return
    fitting = {(target, source) for target, source in given.numbers.tolist()}
    lost = [pair for pair in numbers if pair not in fitting]
    if not lost:
        return
    # of the pairs between the chosen ones, the ones beside these
    everything = choose(clouds, len(clouds.rows))
    place = {pair: number for number, pair in enumerate(everything)}
    beside = {place[pair] + step for pair in lost for step in (-1, 1)}
    untold = [everything[n] for n in sorted(beside) if 0 <= n < len(everything)]
    untold = [pair for pair in untold if pair not in numbers]
    registered_pairs = registered(clouds, untold).numbers.tolist() if untold else []
    lost += [pair for pair in untold if list(pair) not in registered_pairs]
    rows = np.array(sorted(place[pair] for pair in lost), np.int64)
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    rows = np.concatenate([run for run in runs if len(run) >= LEAST_STRANGERS] or [rows[:0]])
    if not len(rows):
        return
    stamps_ns = clouds.stamps_ns()[np.array([everything[row] for row in rows])]
    when = time_range(int(stamps_ns.min()), int(stamps_ns.max()))
    stream.findings.append(
        Finding(
            Severity.WRONG,
            f"{len(rows)} pairs of its clouds, one after the other, have no surfaces in common"
            f" ({when}), which the others have: the sensor measured nothing but noise there, or was"
            " covered; cut the log there",
        )
    )


def add_unexplained(
    stream: StreamFit, registration: Registered, poses_at: PosesAt, clouds: Clouds
) -> None:
    """Names a camera most of whose pairs move otherwise than the poses, far beyond its noise."""
    squares = registration.pairs.squares(
        pose_motion(registration.pairs, poses_at, np.zeros(PARAMETERS))
    )
    is_off = stream.translation_m > MOST_OFF * clouds.voxel or stream.rotation_rad > MOST_TURNED
    usual = float(np.nanmedian(squares))
    if not is_off or usual < UNEXPLAINED or usual < UNEXPLAINED * noise(clouds, registration):
        return
    stream.findings.append(
        Finding(
            Severity.WRONG,
            f"most of its clouds move otherwise than the poses, by {stream.translation_m:.2f} m and"
            f" {np.degrees(stream.rotation_rad):.1f} degrees in the median of"
            f" {len(registration.pairs)} pairs, and no offset of a clock or a mounting explains it:"
            " its calibration (CameraInfo, K, baseline, unit of depth) or the poses are wrong",
        )
    )


def add_contradictions(
    stream: StreamFit,
    registration: Registered,
    poses_at: PosesAt,
    clouds: Clouds,
    severity: Severity,
) -> None:
    """Names the time where clouds move otherwise than the poses, and nothing else explains it."""
    predicted = pose_motion(registration.pairs, poses_at, np.zeros(PARAMETERS))
    squares = registration.pairs.squares(predicted)
    off = difference(registration.pairs.measured, predicted)
    meters = np.linalg.norm(off[:, :3], axis=1)
    radians = np.linalg.norm(off[:, 3:], axis=1)
    with np.errstate(invalid="ignore"):
        gain = registration.share / np.maximum(registration.given_share, 1e-9)
        is_other = (gain > CONTRADICTS) & (registration.share > TELLING)
        is_other |= (gain > FEW_CONTRADICT) & (registration.share > FEW_TELLING)
        is_other &= squares > CONTRADICTION
        is_other &= (meters > WRONG * clouds.voxel) | (radians > WRONG_TURN)
    if not is_other.any():
        return
    # where most pairs are off, their median does not show the noise
    usual = float(np.nanmedian(squares)) / MEDIAN_OF_6
    excess = max(1.0, min(usual, noise(clouds, registration)))
    rows = np.flatnonzero(is_other & (squares > CONTRADICTION * excess))
    # single ones are registrations that went wrong
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    rows = np.concatenate([run for run in runs if len(run) >= LEAST_CONTRADICTIONS] or [rows[:0]])
    if not len(rows):
        return
    first = int(registration.pairs.stamps_ns[rows].min())
    last = int(registration.pairs.stamps_ns[rows].max())
    farthest = float(meters[rows].max())
    most_turned = float(np.degrees(radians[rows].max()))
    stream.findings.append(
        Finding(
            severity,
            f"{len(rows)} of {len(registration.pairs)} pairs of its clouds move otherwise than the"
            f" poses, by up to {farthest:.1f} m and {most_turned:.0f} degrees"
            f" ({time_range(first, last)}): the poses are wrong"
            f" there{_drift_text(off[rows], predicted[rows])}; cut the log, or give others with"
            " --poses FILE",
        )
    )


def _drift_text(off: F64, predicted: F64) -> str:
    """How fast poses drift that turn wrongly everywhere and to the same side; else empty."""
    way = np.linalg.norm(predicted[:, :3, 3], axis=1).sum()
    turns = off[:, 3:]
    together = float(np.linalg.norm(turns.sum(0)))
    is_steady = together >= STEADY * float(np.linalg.norm(turns, axis=1).sum())
    if not is_steady or together < LEAST_DRIFT * way:
        return ""
    return f", their rotation drifts by {np.degrees(together) / way:.1f} degrees a metre"

"""How far clouds of a pair lie apart, searched along the way that the poses give.

Along a street the ground and the walls lie on themselves at any distance, so that a registration
from a wrong distance ends where it began. What stands across the way shows the right one, but only
from nearby: it is searched in small steps.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.mapping.fit.keyframe_pairs import (
    Clouds,
    Registered,
    Registrar,
    Start,
    covariance_of,
    motion,
)
from semloc_logs.mapping.fit.model import Pairs
from semloc_logs.numerics.evenly import evenly

TRIED = 6  # pairs that show the distance together
FEWEST = 3
LEAST_WAY = 3.0  # voxels between both clouds of such a pair
STEP = 0.3  # voxels, of the search: points lie on planes within a third of a voxel
FARTHEST = 40.0  # voxels; clouds that lie farther apart have little in common
MOST = 4.0  # times as far as by the poses
# the distance is another one when so many times as much across the way lies on planes there; at the
# right one it is about five times as much as anywhere else
BETTER = 1.8
SLIPPED = 0.3, 1.8  # as far as by the poses, at least and at most, where odometry slips
FAR_BETTER = 1.15  # times as many points lie on planes at such a distance


def other_distance(clouds: Clouds, registration: Registered) -> Start | None:
    """Motions so many times as long as by the poses, where these fit far better.

    Than the ``registration`` from the poses.
    """
    ways = np.array(
        [float(np.linalg.norm(_way(clouds, pair))) for pair in registration.numbers.tolist()]
    )
    rows = np.flatnonzero(ways >= LEAST_WAY * clouds.voxel)
    if len(rows) < FEWEST:
        return None
    rows = rows[evenly(len(rows), TRIED)]
    usual = float(np.median(ways[rows]))
    step = STEP * clouds.voxel / usual
    factors = np.arange(step, min(MOST, FARTHEST * clouds.voxel / usual), step)
    registrar = Registrar(clouds)
    shares = np.zeros(len(factors))
    found_share = 0.0
    for row in rows.tolist():
        target, source = registration.numbers[row].tolist()
        given = motion(clouds, target, source)
        direction = given[:3, 3] / ways[row]
        tried = [_lengthened(given, factor) for factor in factors]
        shares += registrar.shares_along(target, source, tried, direction)
        measured = [registration.pairs.measured[row]]
        found_share += float(registrar.shares_along(target, source, measured, direction)[0])
    best = int(np.argmax(shares)) if len(shares) else 0
    if not len(shares) or shares[best] <= max(BETTER * found_share, 1e-9):
        return None
    return _start(clouds, float(factors[best]))


def searched(clouds: Clouds, registration: Registered) -> Registered:
    """The pairs, registered again where at another distance far more across the way fits.

    Odometry that slips for a while is wrong in a few pairs only. A pair is replaced where far more
    of its points lie on planes then.
    """
    registrar = Registrar(clouds)
    measured = registration.pairs.measured.copy()
    covariance = registration.pairs.covariance.copy()
    share = registration.share.copy()
    for row, (target, source) in enumerate(registration.numbers.tolist()):
        given = motion(clouds, target, source)
        way = float(np.linalg.norm(given[:3, 3]))
        if way < LEAST_WAY * clouds.voxel:
            continue
        factors = np.arange(SLIPPED[0], SLIPPED[1], STEP * clouds.voxel / way)
        starts = [_lengthened(given, factor) for factor in factors]
        direction = given[:3, 3] / way
        shares = registrar.shares_along(target, source, [measured[row], *starts], direction)
        best = int(np.argmax(shares))
        if shares[best] <= BETTER * shares[0]:
            continue
        fit = registrar.fit(target, source, [starts[best - 1]])
        if fit.share > FAR_BETTER * share[row]:
            measured[row] = fit.target_T_source
            covariance[row] = covariance_of(fit, clouds.voxel)
            share[row] = fit.share
    pairs = Pairs(registration.pairs.stamps_ns, measured, covariance)
    return Registered(pairs, registration.numbers, share, registration.given_share)


def _way(clouds: Clouds, pair: list[int]) -> F64:
    """The translation (3,) of a pair by the poses."""
    return motion(clouds, *pair)[:3, 3]


def _lengthened(given: F64, factor: float) -> F64:
    """A motion (4, 4) of another length."""
    out = given.copy()
    out[:3, 3] *= factor
    return out


def _start(clouds: Clouds, factor: float) -> Callable[[int, int], F64]:
    return lambda target, source: _lengthened(motion(clouds, target, source), factor)

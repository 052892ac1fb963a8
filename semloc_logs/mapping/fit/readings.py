"""Other readings of poses and clouds: conventions in which they were written.

A reading gives other motions of the pairs without a parameter to fit: poses inverted, quaternions
in another order, positions or clouds of a left-handed frame, clouds moved already.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64, Bools
from semloc_logs.mapping.fit.keyframe_pairs import Clouds
from semloc_logs.mapping.fit.model import Pairs, PosesAt, cost_of, scatter
from semloc_logs.numerics.evenly import evenly
from semloc_logs.numerics.transforms import inverse, yaw_transform

FAR_OFF = 40.0  # squared distances in the median beyond which far readings are tried
MUCH_NEARER = 0.05  # a far reading explains the pairs when it lowers the median to this share
# a hypothesis explains much: it lowers half of chi squared by so much
LEAST_GAIN = 12.0
LOOKED_AT = 5  # keyframes that show where the points of clouds lie
CARRIED = 0.5  # of the way of the vehicle by which points of the fixed frame move at least
LONGEST_LAG, LAG_STEP = 2.0, 0.1  # s, between positions and rotations; of its search
LEAST_WAY = 30.0  # voxels; on a shorter way other surroundings look like such a motion

# positions in x, y, z, w of the parts of a quaternion that were written as w, x, y, z, and of one
# that was written the other way round
_ORDERS = {
    "w, x, y, z": (1, 2, 3, 0),
    "y, z, w, x": (3, 0, 1, 2),
}
# axes of the positions that were written as x, y, z: signs and numbers of the axes meant
_AXES = {
    "z, -x, -y": ((1, 2), (-1, 0), (-1, 1)),  # of an optical frame, with rotations of a body
    "-y, -z, x": ((-1, 1), (-1, 2), (1, 0)),
    "y, x, z": ((1, 1), (1, 0), (1, 2)),  # north and east
    "y, x, -z": ((1, 1), (1, 0), (-1, 2)),
}
# of :func:`otherwise_written` and :func:`with_other_axes` together
CONVENTIONS = len(_ORDERS) + 5 + len(_AXES)
_FIXED = (
    "its clouds do not move although the vehicle does: they are in the fixed frame already, and the"
    " motion of the vehicle is applied twice; use the clouds as the sensor measures them"
)
_INVERTED = (
    "the poses fit when they are inverted: they are of the fixed frame in the frame of the vehicle;"
    " record or give the poses of the vehicle"
)
_INVERTED_OR_TURNED = (
    "the poses fit when they are inverted, and when the mounting is turned by 180 degrees about"
    " {axis}, which the drive does not tell apart: correct the transform of the sensor, or give the"
    " poses of the vehicle in the fixed frame"
)


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """``motion`` (n, 4, 4) of the pairs, nan where the poses are not known, and what it means.

    ``lead``: by so much it has to explain the pairs better than faults do.
    """

    motion: F64
    text: str
    lead: float = 0.0


def far_reading(pairs: Pairs, poses_at: PosesAt, squares: F64, clouds: Clouds) -> str:
    """Clouds in the fixed frame, or inverted poses, where one of them explains the pairs; or "".

    ``squares`` (n,) are the squared distances of the pairs to the poses as they are.
    """
    far = float(np.nanmedian(squares))
    if far < FAR_OFF:
        return ""
    poses, known = pairs.poses(poses_at)
    fixed = np.tile(np.eye(4), (len(pairs), 1, 1))
    inverted = Reading(_where(known, poses[:, 0] @ inverse(poses[:, 1])), _INVERTED)
    readings = [inverted]
    if _are_carried(clouds):
        readings.insert(0, Reading(_where(known, fixed), _FIXED))
    nears = [float(np.nanmedian(pairs.squares(reading.motion))) for reading in readings]
    best = int(np.argmin(nears))
    if nears[best] >= FAR_OFF or nears[best] >= MUCH_NEARER * far:
        return ""
    if readings[best] is not inverted:
        return readings[best].text
    return _inverted_or_turned(pairs, poses_at, inverted)


def _inverted_or_turned(pairs: Pairs, poses_at: PosesAt, inverted: Reading) -> str:
    """A straight drive the other way is also a drive backwards: with a mounting turned about."""
    motion, known = pairs.motion(poses_at, 0)
    costs = {}
    for axis, name in enumerate("xyz"):
        turn = np.diag([1.0 if k in (axis, 3) else -1.0 for k in range(4)])
        costs[name] = cost_of(pairs.residuals(_where(known, turn @ motion @ turn)))
    axis_name = min(costs, key=lambda name: (costs[name], name != "z"))
    least = costs[axis_name]
    cost = cost_of(pairs.residuals(inverted.motion))
    excess = max(1.0, scatter(pairs.squares(inverted.motion)))
    if (cost - least) / excess >= LEAST_GAIN:
        return ""  # the mounting is turned, which its fault names with the angle
    if (least - cost) / excess >= LEAST_GAIN:
        return inverted.text
    return _INVERTED_OR_TURNED.format(axis=axis_name)


def _lagging(pairs: Pairs, poses_at: PosesAt) -> Iterator[Reading]:
    """Poses whose rotations, or positions, are of another time than the rest of them."""
    given, known = pairs.poses(poses_at)
    for part, rest in (("rotations", "positions"), ("positions", "rotations")):

        def reading(seconds: float, part: str = part) -> F64:
            other, is_reached = pairs.poses(poses_at, round(seconds * 1e9))
            poses = given.copy()
            columns = slice(3) if part == "rotations" else slice(3, 4)
            # beyond the ends of the poses they stay as they are: no pair is lost by a lag
            poses[is_reached, :, :3, columns] = other[is_reached, :, :3, columns]
            return _where(known, _motion(poses))

        best = 0.0
        for reach, step in ((LONGEST_LAG, LAG_STEP), (LAG_STEP, LAG_STEP / 5)):
            tried = best + np.arange(-reach, reach + step / 2, step)
            costs = [cost_of(pairs.residuals(reading(seconds))) for seconds in tried]
            best = float(tried[int(np.argmin(costs))])
        if abs(best) > LONGEST_LAG - LAG_STEP:  # not found within the range of the search
            continue
        side = "behind" if best > 0 else "ahead of"
        yield Reading(
            reading(best),
            f"the poses fit when their {part} are taken {abs(best):.2f} s "
            f"{'later' if best > 0 else 'earlier'}: the {part} are {side} the {rest}, as from a"
            " filter or another receiver; give poses whose parts are of one time",
            LEAST_GAIN,
        )


def near_reading(pairs: Pairs, poses_at: PosesAt, none: float, most: float) -> str:
    """Another order of quaternions, or a mirrored axis, where it explains more than faults; or "".

    ``none``: the cost of the poses as they are; ``most``: the cost of what faults leave. Only turns
    show such a reading, to the side or up and down.
    """
    if none < LEAST_GAIN:  # no reading could explain so much
        return ""
    least = np.inf
    text = ""
    for reading in _near_readings(pairs, poses_at):
        cost = cost_of(pairs.residuals(reading.motion))
        excess = max(1.0, scatter(pairs.squares(reading.motion)))
        # the first one of readings that the drive does not tell apart
        if (
            cost + reading.lead * excess <= most
            and (none - cost) / excess >= LEAST_GAIN
            and cost < least - 1.0
        ):
            least = cost
            text = reading.text
    return text


def _near_readings(pairs: Pairs, poses_at: PosesAt) -> Iterator[Reading]:
    motion, known = pairs.motion(poses_at, 0)
    for axis, name in enumerate("xyz"):
        flip = _flip(axis)
        yield Reading(
            _where(known, flip @ motion @ flip),
            f"its clouds are mirrored along {name} of the base frame against the poses: they turn"
            " the other way than the vehicle; correct the sign of the coordinate in the clouds, or"
            f" give poses of a right-handed frame ({name} and the turns about the other axes"
            " change their signs)",
        )
    poses, known = pairs.poses(poses_at)
    for motions, text in otherwise_written(poses):
        yield Reading(_where(known, motions), text)
    for motions, text in with_other_axes(poses):
        # a straight drive shows a mounting that is turned alike
        yield Reading(_where(known, motions), text, LEAST_GAIN)
    yield from _lagging(pairs, poses_at)


def otherwise_written(poses: F64) -> Iterator[tuple[F64, str]]:
    """Motions (n, 4, 4) of pairs of poses (n, 2, 4, 4) that were written by another convention.

    With the sentence that names it.
    """
    quaternions = Rotation.from_matrix(poses[..., :3, :3].reshape(-1, 3, 3)).as_quat()
    for order, parts in _ORDERS.items():
        yield (
            _motion(_turned(poses, quaternions[:, parts])),
            f"the poses fit when their quaternions are read as {order}: they were written in"
            " another order than x, y, z, w; give the poses in this order",
        )
    conjugate = quaternions * [-1.0, -1.0, -1.0, 1.0]
    yield (
        _motion(_turned(poses, conjugate)),
        "the poses fit when their rotations are inverted, but not their positions: the rotations"
        " are of the fixed frame in the frame of the vehicle; give the rotations of the vehicle",
    )
    yield (
        _motion(_headed(poses)),
        "the poses fit when their yaw is read as a compass heading, clockwise from north: positions"
        " are east, north, up; give the yaw counter-clockwise from east (90 degrees less the"
        " heading)",
    )
    for axis, name in enumerate("xyz"):
        other_side = poses.copy()
        other_side[..., axis, 3] *= -1.0
        yield (
            _motion(other_side),
            f"the poses fit when {name} of their positions has the other sign: positions and"
            " rotations are not of one right-handed frame; give both in the same",
        )


def with_other_axes(poses: F64) -> Iterator[tuple[F64, str]]:
    """As :func:`otherwise_written`: axes of the positions are not the ones of the rotations."""
    for names, axes in _AXES.items():
        out = poses.copy()
        for axis, (sign, other) in enumerate(axes):
            out[..., axis, 3] = sign * poses[..., other, 3]
        yield (
            _motion(out),
            f"the poses fit when {names} of their positions are read as x, y, z: positions and"
            " rotations are not of one frame; give both in the same",
        )


def _flip(axis: int) -> F64:
    return np.diag([-1.0 if k == axis else 1.0 for k in range(4)])


def _headed(poses: F64) -> F64:
    """Poses (n, 2, 4, 4) whose yaw is 90 degrees less the one that was written."""
    quarter = yaw_transform(np.pi / 2, (0.0, 0.0, 0.0))[:3, :3]
    out = poses.copy()
    out[..., :3, :3] = quarter @ np.swapaxes(poses[..., :3, :3], -1, -2)
    return out


def _turned(poses: F64, quaternions: F64) -> F64:
    """Poses (n, 2, 4, 4) with other rotations: quaternions (2 n, 4)."""
    out = poses.copy()
    out[..., :3, :3] = Rotation.from_quat(quaternions).as_matrix().reshape(-1, 2, 3, 3)
    return out


def _motion(poses: F64) -> F64:
    """``target_T_source`` (n, 4, 4) of pairs of poses (n, 2, 4, 4)."""
    return np.asarray(inverse(poses[:, 0]) @ poses[:, 1])


def _where(known: Bools, motion: F64) -> F64:
    """Motions (n, 4, 4), nan where the poses are not known."""
    return np.where(known[:, None, None], motion, np.nan)


def _are_carried(clouds: Clouds) -> bool:
    """Whether the points move along with the vehicle, as points of the fixed frame do.

    Clouds that a registration could not move, or that a driver repeats, stay where they are.
    """
    numbers = [n for n in range(len(clouds.rows)) if clouds.pose(n) is not None]
    numbers = [numbers[i] for i in evenly(len(numbers), LOOKED_AT)]
    middles = []
    places = []
    for number in numbers:
        pose = clouds.pose(number)
        assert pose is not None, "only keyframes with poses are chosen"
        middles.append(np.median(clouds.points(number), axis=0))
        places.append(pose[:3, 3])
    ways = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    carried = np.linalg.norm(np.diff(middles, axis=0), axis=1).sum()
    return bool(ways < LEAST_WAY * clouds.voxel or carried >= CARRIED * ways)

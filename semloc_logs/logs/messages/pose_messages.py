"""Messages with poses and transforms, inertial and satellite measurements."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.frames import Frame, Header, ImuSample, NavSatSample, PoseSample, TransformSample
from semloc_logs.logs.log import Message
from semloc_logs.logs.messages.definitions import UndecodableError
from semloc_logs.logs.messages.headers import (
    BAD_VALUES,
    Convert,
    foxglove,
    quaternion,
    ros,
    transform,
    unit_transform,
    vector,
)

# sensor_msgs/NavSatStatus: not yet set; -1: no fix
_STATUS_UNKNOWN = -2
_HIGHEST = 1e6  # m above the ellipsoid: nothing that drives is higher

# -- poses and transforms


def _pose(header: Header, m: Any) -> Iterator[Frame]:
    yield PoseSample(header, "", unit_transform(m.pose.position, m.pose.orientation))


def _pose_with_covariance(header: Header, m: Any) -> Iterator[Frame]:
    yield from _pose(header, m.pose)


def _odometry(header: Header, m: Any) -> Iterator[Frame]:
    pose = m.pose.pose
    yield PoseSample(header, m.child_frame_id, unit_transform(pose.position, pose.orientation))


def _transform(header: Header, m: Any) -> Iterator[Frame]:
    pose = transform(m.transform.translation, m.transform.rotation)
    yield TransformSample(header, m.child_frame_id, pose, _is_static(header))


def _foxglove_transform(header: Header, m: Any) -> Iterator[Frame]:
    yield TransformSample(
        header,
        str(m.child_frame_id or ""),
        transform(m.translation, m.rotation),
        _is_static(header),
    )


def _foxglove_odometry(header: Header, m: Any) -> Iterator[Frame]:
    child = str(m.body_frame_id or "")
    yield PoseSample(header, child, unit_transform(m.pose.position, m.pose.orientation))


def _is_static(header: Header) -> bool:
    return header.topic.rstrip("/").endswith("tf_static")


def _each(convert: Convert) -> Convert:
    """Converts all transforms that make sense, then raises the error of the first bad one.

    One bad edge does not cost the others.
    """

    def convert_all(m: Any, message: Message) -> Iterator[Frame]:
        transforms = m.transforms or ()
        damage: list[Exception] = []
        for one in transforms:
            try:
                yield from convert(one, message)
            except (UndecodableError, *BAD_VALUES) as error:
                damage.append(error)
        if damage:
            raise UndecodableError(
                f"{len(damage)} of its {len(transforms)} transforms cannot be used ({damage[0]})"
            )

    return convert_all


# -- inertial and satellite


def _imu(header: Header, m: Any) -> Iterator[Frame]:
    acceleration = vector(m.linear_acceleration)
    if _is_unknown(m, "linear_acceleration_covariance"):
        acceleration = np.full(3, np.nan)
    elif not np.isfinite(acceleration).all():
        raise UndecodableError("its measurements are not finite")
    rate = vector(m.angular_velocity)
    if _is_unknown(m, "angular_velocity_covariance") or not np.isfinite(rate).all():
        rate = np.full(3, np.nan)
    yield ImuSample(header, acceleration, rate, _imu_orientation(m))


def _is_unknown(m: Any, name: str) -> bool:
    """Whether a covariance of sensor_msgs/Imu marks its measurement as missing: it starts with -1.

    A definition in the log may leave the covariance out.
    """
    covariance = getattr(m, name, None)
    return covariance is not None and len(covariance) > 0 and float(covariance[0]) == -1.0


def _imu_orientation(m: Any) -> F64 | None:
    """The quaternion xyzw of an IMU that reports one, else None.

    Without one the first element of its covariance is -1, or its length is not 1.
    """
    q = getattr(m, "orientation", None)
    if q is None or _is_unknown(m, "orientation_covariance"):
        return None
    orientation = quaternion(q)
    return orientation if abs(math.hypot(*orientation) - 1.0) < 0.1 else None


def _nav_sat(header: Header, m: Any, *, has_fix: bool = True) -> Iterator[Frame]:
    latitude = _number(m.latitude)
    longitude = _number(m.longitude)
    if not has_fix:
        yield NavSatSample(header, latitude, longitude, math.nan, has_fix=False)
        return
    if not (abs(latitude) <= 90 and abs(longitude) <= 360):
        raise UndecodableError("its latitude or longitude is not on Earth")
    altitude = _number(m.altitude)
    if not abs(altitude) <= _HIGHEST:
        altitude = math.nan
    yield NavSatSample(header, latitude, longitude, altitude, _fix_covariance(m))


def _number(value: Any) -> float:
    """A number; NaN where the message leaves it out."""
    return math.nan if value is None else float(value)


def _fix_covariance(m: Any) -> F64 | None:
    """``position_covariance`` where its type is not "unknown" and it can be one.

    NaN for up where only the height is uncertain without bounds.
    """
    recorded = getattr(m, "position_covariance", None)
    kind = getattr(m, "position_covariance_type", 0)
    # some write the names of enumerations in JSON
    is_unknown = not kind or str(kind) == "UNKNOWN"
    if is_unknown or recorded is None or len(recorded) != 9:
        return None
    covariance = np.array(recorded, float).reshape(3, 3)
    is_known = np.isfinite(covariance[:2, :2]).all() and (np.diag(covariance)[:2] >= 0).all()
    if not is_known:
        return None
    if not (np.isfinite(covariance).all() and covariance[2, 2] >= 0):
        covariance[2] = covariance[:, 2] = np.nan
    return covariance


def _nav_sat_fix(header: Header, m: Any) -> Iterator[Frame]:
    status = int(m.status.status)
    is_placed = bool(m.latitude) or bool(m.longitude)
    # a driver that never sets its status leaves STATUS_UNKNOWN with a position
    has_fix = status >= 0 or (status == _STATUS_UNKNOWN and is_placed)
    yield from _nav_sat(header, m, has_fix=has_fix)


CONVERTERS: dict[str, Convert] = {
    "sensor_msgs/msg/Imu": ros(_imu),
    "sensor_msgs/msg/NavSatFix": ros(_nav_sat_fix),
    "nav_msgs/msg/Odometry": ros(_odometry),
    "geometry_msgs/msg/PoseStamped": ros(_pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ros(_pose_with_covariance),
    "geometry_msgs/msg/TransformStamped": ros(_transform),
    "tf2_msgs/msg/TFMessage": _each(ros(_transform)),
    "tf/msg/tfMessage": _each(ros(_transform)),
    "foxglove.PoseInFrame": foxglove(_pose),
    "foxglove.Odometry": foxglove(_foxglove_odometry),
    "foxglove.FrameTransform": foxglove(_foxglove_transform, "parent_frame_id"),
    "foxglove.FrameTransforms": _each(foxglove(_foxglove_transform, "parent_frame_id")),
    "foxglove.LocationFix": foxglove(_nav_sat),
}

"""Messages to frames: one small function for each message type, found in a table by the type's name."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np

from semloc_logs import geometry
from semloc_logs.frames import (
    F64,
    Camera,
    DepthFrame,
    Frame,
    Header,
    ImageFrame,
    ImuSample,
    LabelNames,
    LidarFrame,
    NavSatSample,
    PoseSample,
    TransformSample,
)
from semloc_logs.logs import images, livox
from semloc_logs.logs.clouds import Field, Layout, decode_points
from semloc_logs.logs.definitions import Parser, UndecodableError, binary, json_type, parser
from semloc_logs.logs.livox import livox_parser
from semloc_logs.logs.log import Definition, Message
from semloc_logs.logs.point_times import SWEEP_NS, PointTimes
from semloc_logs.logs.problems import Problems

Convert = Callable[[Any, Message], Iterator[Frame]]

# what hostile values in a well-formed message may raise in the functions of this module
_BAD_VALUES = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, MemoryError, cv2.error)
_POINT_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField
_FOXGLOVE_KINDS = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}  # foxglove.PackedElementField


class Decoder:
    """Decodes the messages of one log; what it cannot decode is counted in ``problems`` by topic."""

    def __init__(self, problems: Problems) -> None:
        self._problems = problems
        self._parsers: dict[tuple[str, str, int], Parser | UndecodableError] = {}
        self._definitions: list[Definition] = []  # keeps those alive whose id is a key
        self._times = PointTimes()

    def frames(self, message: Message) -> list[Frame]:
        """The frames in ``message``; none when its type is of no use here, or when it cannot be decoded."""
        convert = CONVERTERS.get(json_type(message.type) if message.encoding in ("protobuf", "json") else message.type)
        if convert is None or (convert is _text and not message.topic.endswith("/label_space")):  # any other text is of no use here
            return []
        found: list[Frame] = []  # keeps what a message gives before its damaged part
        try:
            _check_time(message.log_time_ns)
            frames = convert(self._parse(message), message)
            found.extend(self._times.checked(frame) if isinstance(frame, LidarFrame) else frame for frame in frames)
            return found
        except UndecodableError as error:
            reason = str(error)
        except _BAD_VALUES as error:
            reason = f"its values make no sense ({type(error).__name__}: {str(error)[:120]})"
        self._problems.skip("decoding", message.topic, f"{message.type} at log time {message.log_time_ns} ns: {reason}")
        return found

    def _parse(self, message: Message) -> Any:
        key = (message.encoding, message.type, id(message.definition))
        known = self._parsers.get(key)
        if known is None:
            try:
                make = livox_parser if message.type in livox.TYPES else parser
                known = make(message.encoding, message.type, message.definition)
            except UndecodableError as error:
                known = error
            self._parsers[key] = known
            self._definitions.append(message.definition)
        if isinstance(known, UndecodableError):
            raise known
        return known(message.data)


# -- parts that several messages share


def _check_time(time_ns: int) -> int:
    """Nanoseconds that fit 64-bit integers, also after a difference of two."""
    if abs(time_ns) >= 1 << 62:
        raise UndecodableError(f"its time of {time_ns} ns is impossible")
    return time_ns


def _stamp_ns(time: Any, message: Message) -> int:
    """Nanoseconds of a ROS time, a protobuf timestamp or a JSON {sec, nsec}; log time where a message has none."""
    if time is None:
        return message.log_time_ns
    for seconds, nanoseconds in (("sec", "nanosec"), ("seconds", "nanos"), ("sec", "nsec")):
        s, n = getattr(time, seconds, None), getattr(time, nanoseconds, None)
        if s is not None and n is not None:
            return _check_time(int(s) * 1_000_000_000 + int(n))
    raise UndecodableError("its time stamp has neither seconds nor nanoseconds")


def _header(ros_message: Any, message: Message) -> Header:
    header = ros_message.header
    return Header(message.topic, _stamp_ns(header.stamp, message), message.log_time_ns, header.frame_id)


def _foxglove_header(m: Any, message: Message, frame_id: Any) -> Header:
    if not isinstance(frame_id, str):
        frame_id = ""
    return Header(message.topic, _stamp_ns(m.timestamp, message), message.log_time_ns, frame_id)


def _vector(v: Any) -> F64:
    return np.array([v.x or 0.0, v.y or 0.0, v.z or 0.0], float)


def _transform(translation: Any, rotation: Any) -> F64:
    t = _vector(translation)
    q = np.array([rotation.x or 0.0, rotation.y or 0.0, rotation.z or 0.0, rotation.w or 0.0], float)
    norm = math.hypot(*q)
    if not (np.isfinite(t).all() and math.isfinite(norm)):
        raise UndecodableError("its pose has values that are not finite")
    if norm < 1e-6:
        raise UndecodableError("the quaternion of its pose is zero")
    return geometry.transform(t, q)


# -- poses


def _odometry(m: Any, message: Message) -> Iterator[Frame]:
    pose = m.pose.pose
    yield PoseSample(_header(m, message), m.child_frame_id, _transform(pose.position, pose.orientation))


def _pose_stamped(m: Any, message: Message) -> Iterator[Frame]:
    yield PoseSample(_header(m, message), "", _transform(m.pose.position, m.pose.orientation))


def _pose_with_covariance(m: Any, message: Message) -> Iterator[Frame]:
    pose = m.pose.pose
    yield PoseSample(_header(m, message), "", _transform(pose.position, pose.orientation))


def _transform_stamped(m: Any, message: Message) -> Iterator[Frame]:
    static = message.topic.rstrip("/").endswith("tf_static")
    pose = _transform(m.transform.translation, m.transform.rotation)
    yield TransformSample(_header(m, message), m.child_frame_id, pose, static)


def _good_ones(convert: Convert, transforms: Any, message: Message) -> Iterator[Frame]:
    """The transforms that make sense, and then the error of the first that does not: one bad edge does not cost the others."""
    damage: list[Exception] = []
    for transform in transforms:
        try:
            yield from convert(transform, message)
        except (UndecodableError, *_BAD_VALUES) as error:
            damage.append(error)
    if damage:
        raise UndecodableError(f"{len(damage)} of its {len(transforms)} transforms cannot be used ({damage[0]})")


def _tf(m: Any, message: Message) -> Iterator[Frame]:
    yield from _good_ones(_transform_stamped, m.transforms, message)


def _foxglove_pose(m: Any, message: Message) -> Iterator[Frame]:
    pose = _transform(m.pose.position, m.pose.orientation)
    yield PoseSample(_foxglove_header(m, message, m.frame_id), "", pose)


def _foxglove_transform(m: Any, message: Message) -> Iterator[Frame]:
    static = message.topic.rstrip("/").endswith("tf_static")
    pose = _transform(m.translation, m.rotation)
    yield TransformSample(_foxglove_header(m, message, m.parent_frame_id), str(m.child_frame_id or ""), pose, static)


def _foxglove_transforms(m: Any, message: Message) -> Iterator[Frame]:
    yield from _good_ones(_foxglove_transform, m.transforms or (), message)


# -- inertial and satellite


def _imu(m: Any, message: Message) -> Iterator[Frame]:
    acceleration, rate = _vector(m.linear_acceleration), _vector(m.angular_velocity)
    if not (np.isfinite(acceleration).all() and np.isfinite(rate).all()):
        raise UndecodableError("its measurements are not finite")
    yield ImuSample(_header(m, message), acceleration, rate, _imu_orientation(m))


def _imu_orientation(m: Any) -> F64 | None:
    """The quaternion of an IMU that reports one: without, the first element of its covariance is -1, or it is no unit quaternion."""
    q, covariance = getattr(m, "orientation", None), getattr(m, "orientation_covariance", None)
    if q is None or (covariance is not None and len(covariance) and float(covariance[0]) == -1.0):
        return None
    orientation = np.array([q.x or 0.0, q.y or 0.0, q.z or 0.0, q.w or 0.0], float)
    return orientation if abs(math.hypot(*orientation) - 1.0) < 0.1 else None


def _nav_sat(header: Header, m: Any) -> Iterator[Frame]:
    latitude, longitude, altitude = float(m.latitude or 0.0), float(m.longitude or 0.0), float(m.altitude or 0.0)
    if not (abs(latitude) <= 90 and abs(longitude) <= 360 and math.isfinite(altitude)):
        raise UndecodableError("its latitude, longitude or altitude is no number on Earth")
    yield NavSatSample(header, latitude, longitude, altitude, _fix_covariance(m))


def _fix_covariance(m: Any) -> F64 | None:
    """``position_covariance`` where its type is not "unknown" and it can be one."""
    recorded = getattr(m, "position_covariance", None)
    if not getattr(m, "position_covariance_type", 0) or recorded is None or len(recorded) != 9:
        return None
    covariance = np.array(recorded, float).reshape(3, 3)
    return covariance if np.isfinite(covariance).all() and (np.diag(covariance) >= 0).all() else None


def _nav_sat_fix(m: Any, message: Message) -> Iterator[Frame]:
    if m.status.status >= 0:  # below: the receiver itself says that it has no fix
        yield from _nav_sat(_header(m, message), m)


def _location_fix(m: Any, message: Message) -> Iterator[Frame]:
    yield from _nav_sat(_foxglove_header(m, message, m.frame_id), m)


# -- point clouds


def _point_cloud2(m: Any, message: Message) -> Iterator[Frame]:
    header = _header(m, message)
    fields = [Field(f.name, f.offset, _POINT_KINDS[f.datatype]) for f in m.fields if f.datatype in _POINT_KINDS]
    layout = Layout(m.width, m.height, m.point_step, m.row_step, bool(m.is_bigendian))
    p = decode_points(binary(m.data), layout, fields, header.stamp_ns)
    yield LidarFrame(header, p.points, p.label, p.offset_ns, p.ring, p.not_finite if m.is_dense else 0, p.remark)


def _foxglove_cloud(m: Any, message: Message) -> Iterator[Frame]:
    header = _foxglove_header(m, message, m.frame_id)
    step, data = int(m.point_stride or 0), binary(m.data)
    fields = [Field(str(f.name), int(f.offset or 0), _FOXGLOVE_KINDS[f.type]) for f in m.fields or () if f.type in _FOXGLOVE_KINDS]
    count = len(data) // step if step > 0 else 0
    p = decode_points(data, Layout(count, 1, step, 0), fields, header.stamp_ns)
    points = p.points
    if m.pose is not None and m.pose.orientation is not None and m.pose.position is not None:
        rotation = m.pose.orientation
        if any((rotation.x, rotation.y, rotation.z, rotation.w)):  # left out by writers that mean the identity
            frame_T_cloud = _transform(m.pose.position, rotation)
            if not np.array_equal(frame_T_cloud, np.eye(4)):
                points = geometry.apply(frame_T_cloud, points).astype(np.float32)
    yield LidarFrame(header, points, p.label, p.offset_ns, p.ring, remark=p.remark)


def _livox(m: Any, message: Message) -> Iterator[Frame]:
    header = Header(message.topic, _check_time(m.sec * 1_000_000_000 + m.nanosec), message.log_time_ns, m.frame_id)
    offset = m.points["offset_time"].astype(np.int64)
    start = m.timebase_ns - header.stamp_ns  # the base of the times is the stamp unless the sensor has a clock of its own
    if abs(start) < SWEEP_NS:
        offset += start
    xyz = np.stack([m.points[axis] for axis in "xyz"], axis=1).astype(np.float32)
    finite = np.isfinite(xyz).all(axis=1)
    kept = finite & ((xyz[:, 0] != 0) | (xyz[:, 1] != 0) | (xyz[:, 2] != 0))
    yield LidarFrame(header, xyz[kept], None, offset[kept], m.points["line"][kept].astype(np.uint16), int((~finite).sum()))


def _old_cloud(m: Any, message: Message) -> Iterator[Frame]:
    """sensor_msgs/PointCloud: a list of points, and channels of float32 beside it."""
    header = _header(m, message)
    channels = {str(c.name).lower(): np.asarray(c.values, np.float32) for c in m.channels}
    columns = {name: values for name, values in channels.items() if len(values) == len(m.points)}
    fields = [Field(n, 4 * k, "f4") for k, n in enumerate(("x", "y", "z", *columns))]
    rows = np.empty((len(m.points), len(fields)), "<f4")
    rows[:, :3] = np.array([(p.x, p.y, p.z) for p in m.points], float).reshape(-1, 3)
    for k, values in enumerate(columns.values()):
        rows[:, 3 + k] = values
    p = decode_points(rows.tobytes(), Layout(len(rows), 1, 4 * len(fields), 0), fields, header.stamp_ns)
    yield LidarFrame(header, p.points, p.label, p.offset_ns, p.ring, remark=p.remark)


# -- pictures


def _picture(header: Header, pixels: Any, encoding: str, depth: bool) -> Iterator[Frame]:
    if depth:
        yield DepthFrame(header, images.depth_metres(pixels))
    else:
        yield ImageFrame(header, pixels, encoding)


def _raw(header: Header, m: Any) -> Iterator[Frame]:
    encoding = str(m.encoding)
    big_endian = bool(getattr(m, "is_bigendian", False))
    pixels = images.decode_raw(binary(m.data), int(m.width or 0), int(m.height or 0), int(m.step or 0), encoding, big_endian)
    yield from _picture(header, pixels, encoding, images.is_depth(header.topic, encoding))


def _compressed(header: Header, m: Any) -> Iterator[Frame]:
    format_ = str(m.format or "")
    data = binary(m.data)
    if "compresseddepth" in format_.lower() or header.topic.endswith("/compressedDepth"):
        yield DepthFrame(header, images.decode_compressed_depth(data, format_))
        return
    pixels = images.decode_compressed(data)
    depth = pixels.ndim == 2 and pixels.dtype == np.uint16
    recorded = format_.partition(";")[0].strip()  # image_transport names the encoding before compression first
    depth = depth and images.is_depth(header.topic, recorded if ";" in format_ else "mono16")
    yield from _picture(header, pixels, format_, depth)


def _image(m: Any, message: Message) -> Iterator[Frame]:
    yield from _raw(_header(m, message), m)


def _foxglove_image(m: Any, message: Message) -> Iterator[Frame]:
    yield from _raw(_foxglove_header(m, message, m.frame_id), m)


def _compressed_image(m: Any, message: Message) -> Iterator[Frame]:
    yield from _compressed(_header(m, message), m)


def _foxglove_compressed(m: Any, message: Message) -> Iterator[Frame]:
    yield from _compressed(_foxglove_header(m, message, m.frame_id), m)


def _camera(header: Header, m: Any) -> Iterator[Frame]:
    def values(name: str, shape: tuple[int, int] | None) -> F64:
        recorded = getattr(m, name, None)
        recorded = getattr(m, name.lower(), ()) if recorded is None else recorded
        array = np.array(() if recorded is None else recorded, float)
        if not np.isfinite(array).all():
            raise UndecodableError(f"its matrix {name} is not finite")
        if shape is None:
            return array.reshape(-1)
        return array.reshape(shape) if array.size else np.zeros(shape)

    K, D, R, P = values("K", (3, 3)), values("D", None), values("R", (3, 3)), values("P", (3, 4))
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        raise UndecodableError("its camera is not calibrated (the focal length is zero)")
    if len(D) > 14:  # no model of the field has more
        raise UndecodableError(f"it has {len(D)} distortion coefficients")
    if not R.any():
        R = np.eye(3)
    if not P.any():
        P = np.hstack([K, np.zeros((3, 1))])
    yield Camera(header, int(m.width or 0), int(m.height or 0), K, D, R, P, str(m.distortion_model or ""))


def _camera_info(m: Any, message: Message) -> Iterator[Frame]:
    yield from _camera(_header(m, message), m)


def _camera_calibration(m: Any, message: Message) -> Iterator[Frame]:
    yield from _camera(_foxglove_header(m, message, m.frame_id), m)


# -- what labels mean


def _label_info(m: Any, message: Message) -> Iterator[Frame]:
    yield LabelNames(_header(m, message), names={int(c.class_id): str(c.class_name) for c in m.class_map})


def _text(m: Any, message: Message) -> Iterator[Frame]:
    yield LabelNames(Header(message.topic, message.log_time_ns, message.log_time_ns, ""), space=str(m.data).strip())


CONVERTERS: dict[str, Convert] = {
    **dict.fromkeys(livox.TYPES, _livox),
    "sensor_msgs/msg/PointCloud2": _point_cloud2,
    "sensor_msgs/msg/PointCloud": _old_cloud,
    "sensor_msgs/msg/Image": _image,
    "sensor_msgs/msg/CompressedImage": _compressed_image,
    "sensor_msgs/msg/CameraInfo": _camera_info,
    "sensor_msgs/msg/Imu": _imu,
    "sensor_msgs/msg/NavSatFix": _nav_sat_fix,
    "nav_msgs/msg/Odometry": _odometry,
    "geometry_msgs/msg/PoseStamped": _pose_stamped,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose_with_covariance,
    "geometry_msgs/msg/TransformStamped": _transform_stamped,
    "tf2_msgs/msg/TFMessage": _tf,
    "tf/msg/tfMessage": _tf,
    "vision_msgs/msg/LabelInfo": _label_info,
    "std_msgs/msg/String": _text,
    "foxglove.PointCloud": _foxglove_cloud,
    "foxglove.RawImage": _foxglove_image,
    "foxglove.CompressedImage": _foxglove_compressed,
    "foxglove.CameraCalibration": _camera_calibration,
    "foxglove.PoseInFrame": _foxglove_pose,
    "foxglove.FrameTransform": _foxglove_transform,
    "foxglove.FrameTransforms": _foxglove_transforms,
    "foxglove.LocationFix": _location_fix,
}

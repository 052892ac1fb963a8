"""The decoded frames of a log: small frozen types.

Stamps are integer nanoseconds, lengths metres. ``stamp_ns`` is the sensor time of the message
header, ``log_time_ns`` the receive time of the log. Arrays are never written to.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32, F64


@dataclass(frozen=True, slots=True, eq=False)
class Header:
    """Topic, times and coordinate frame of a message.

    ``lacks_stamp``: the message has no stamp, or 0, and takes the log time instead. ``publisher``
    tells publishers of one topic apart, "" where the log does not.
    """

    topic: str
    stamp_ns: int
    log_time_ns: int
    frame_id: str
    lacks_stamp: bool = False
    publisher: str = ""


class PointTimeRemark(Enum):
    """What is unusual about the recorded point times of a sweep."""

    OTHER_CLOCK = "other clock"  # the first point is taken to be measured at the header's time
    UNUSABLE = "unusable"  # no unit and origin makes them times within a sweep
    OTHER_UNIT = "other unit"  # as they are defined, points would be measured too fast
    OFF_STAMP = "off stamp"  # they are used, but none of them is near to the header's time


@dataclass(frozen=True, slots=True, eq=False)
class LidarFrame:
    """One sweep: ``points`` (n, 3) in the sensor frame.

    Rows with NaN, infinity or exactly zero are already gone. ``lost`` counts the points that were
    not finite although their cloud calls itself dense, ``without_return`` the ones that are gone
    because they all have one range, ``unclaimed`` the ones that width and height leave out.
    ``origin`` (3,) is the sensor's centre in its frame; None: the frame's own origin.
    """

    header: Header
    points: F32
    label: NDArray[np.uint32] | None = None  # ids exactly as recorded
    offset_ns: NDArray[np.int64] | None = None  # time of each point minus header.stamp_ns
    ring: NDArray[np.uint16] | None = None
    lost: int = 0
    remark: PointTimeRemark | None = None
    origin: F32 | None = None
    without_return: int = 0
    unclaimed: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class ImageFrame:
    """A decoded picture: (h, w) or (h, w, 3) RGB, uint8 or uint16."""

    header: Header
    image: NDArray[np.uint8] | NDArray[np.uint16]
    encoding: str


@dataclass(frozen=True, slots=True, eq=False)
class DepthFrame:
    """Depth along the optical axis in metres (h, w) float32; 0 where nothing was measured.

    ``step`` (m) of one step of the recorded values, by the definition of their encoding.
    """

    header: Header
    depth: F32
    step: float = 0.001


class Region(NamedTuple):
    """A part of a picture (px): ``width`` or ``height`` 0 stand for all of it."""

    x_offset: int = 0
    y_offset: int = 0
    width: int = 0
    height: int = 0


WHOLE_PICTURE = Region()


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A CameraInfo or CameraCalibration, as recorded.

    ``K`` (3, 3), ``P`` (3, 4), ``R`` (3, 3), distortion coefficients ``D`` of ``model``. All are of
    the full picture of the sensor: the recorded picture is its part ``roi``, and ``binning`` (x, y)
    pixels of the sensor make one of it.
    """

    header: Header
    width: int
    height: int
    K: F64
    D: F64
    R: F64
    P: F64
    model: str
    binning: tuple[int, int] = (1, 1)
    roi: Region = WHOLE_PICTURE


@dataclass(frozen=True, slots=True, eq=False)
class PoseSample:
    """``frame_T_child`` (4, 4): pose of ``child_frame_id`` in ``header.frame_id``.

    ``child_frame_id`` is "" for a PoseStamped.
    """

    header: Header
    child_frame_id: str
    frame_T_child: F64


@dataclass(frozen=True, slots=True, eq=False)
class TransformSample:
    """An edge of the TF tree: ``frame_T_child`` (4, 4)."""

    header: Header
    child_frame_id: str
    frame_T_child: F64
    static: bool


@dataclass(frozen=True, slots=True, eq=False)
class ImuSample:
    """Specific force in m/s^2 and angular rate in rad/s, in the IMU frame.

    ``orientation`` is the quaternion xyzw of the IMU frame in east, north, up (REP 103, 105); None
    when the IMU does not report one. A force or rate that it does not report is NaN.
    """

    header: Header
    acceleration: F64
    angular_velocity: F64
    orientation: F64 | None = None


@dataclass(frozen=True, slots=True, eq=False)
class NavSatSample:
    """WGS 84 latitude and longitude in degrees, ellipsoid height in metres (NaN: not measured).

    ``covariance`` (3, 3) of east, north, up in m^2; None when the receiver does not know it, and
    NaN for up where it knows the others. ``has_fix``: False where the receiver reports no fix.
    """

    header: Header
    latitude_deg: float
    longitude_deg: float
    altitude: float
    covariance: F64 | None = None
    has_fix: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class LabelNames:
    """The meaning of the ids of a label topic: ``names`` of classes by id, or a label ``space``."""

    header: Header
    space: str = ""
    names: dict[int, str] = field(default_factory=dict)


Frame = (
    LidarFrame
    | ImageFrame
    | DepthFrame
    | Camera
    | PoseSample
    | TransformSample
    | ImuSample
    | NavSatSample
    | LabelNames
)


class LabelForm(Enum):
    """How the labels of a cloud are recorded."""

    IDS = "ids"
    COLOURS = "colours"  # packed: red in bits 16 to 23, green in 8 to 15, blue in 0 to 7


@dataclass(frozen=True, slots=True, eq=False)
class PosedCloud:
    """Points of one sensor at one time in the base frame, with or without labels: fusion's input.

    ``points`` (n, 3) float32 and ``origin`` (3,), the sensor's centre, in the base frame;
    ``session_T_base`` (4, 4) or None in a log without poses; ``label`` (n,) as recorded, in
    ``label_form``, on the label image topic ``label_topic`` (None: in the cloud itself); ``sigma``
    (n,) standard deviation of the measured range along the ray in metres, None where it is small
    beside a voxel (LIDAR).
    """

    header: Header
    points: F32
    origin: F32
    session_T_base: F64 | None
    label: NDArray[np.uint32] | None = None
    label_topic: str | None = None
    label_form: LabelForm = LabelForm.IDS
    sigma: F32 | None = None

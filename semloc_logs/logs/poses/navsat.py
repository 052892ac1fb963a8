"""Poses from satellite fixes and an IMU, for logs without a pose stream: WGS 84 -> a local
east-north-up frame about the first fix.

Geodetic coordinates become Earth-centred ones in closed form, these a tangent frame
(Hofmann-Wellenhof et al., GNSS, 2008, section 8.2; constants of WGS 84: NGA.STND.0036). Orientation
is that of the IMU (REP 103 and 105: relative to east, north, up) where it reports one and TF says
how it is mounted, else the course over ground, with roll and pitch from the accelerometer. Single
fixes are a metre or so off, which a map shows: any other source of poses is better.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from semloc_logs.frames import F64, Frame, ImuSample, NavSatSample
from semloc_logs.logs.log import Stream
from semloc_logs.logs.poses.track import PoseTrack, is_time
from semloc_logs.logs.roles import Roles
from semloc_logs.numerics.transforms import rotation_between, transform, yaw_transform

# m; a fix that is less certain than this, horizontally, says nothing about a street's width
MAX_SIGMA = 5.0
MIN_SPEED = 1.0  # m/s; slower, the course over ground is noise, and the last one holds
WINDOW_NS = 1_500_000_000  # fixes to either side that course and acceleration are fitted to
_IMU_LATE_NS = 1_000_000_000  # a fix waits so long for the IMU
# a course that turns by more between two fixes is that of driving backwards
_REVERSE = np.radians(120.0)
# an IMU heading that is off the course by more is not relative to east
_OFF_HEADING = np.radians(20.0)
_GRAVITY = np.array([0.0, 0.0, 9.80665])
_MOST_WAITING = 100_000  # fixes; beyond, the oldest are forgotten
_SEMI_MAJOR = 6378137.0
_FLATTENING = 1.0 / 298.257223563
_E2 = _FLATTENING * (2.0 - _FLATTENING)


def earth_centred(latitude_deg: float, longitude_deg: float, height: float) -> F64:
    """WGS 84 degrees and ellipsoid height (m) -> Earth-centred, Earth-fixed coordinates (3,) in
    metres.
    """
    lat = np.radians(latitude_deg)
    lon = np.radians(longitude_deg)
    n = _SEMI_MAJOR / np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
    around = (n + height) * np.cos(lat)
    return np.array(
        [around * np.cos(lon), around * np.sin(lon), (n * (1.0 - _E2) + height) * np.sin(lat)]
    )


class LocalFrame:
    """East, north, up (m) about a point on WGS 84 (degrees, m)."""

    def __init__(self, latitude_deg: float, longitude_deg: float, height: float) -> None:
        self.datum = (latitude_deg, longitude_deg, height)
        self._origin = earth_centred(*self.datum)
        lat = np.radians(latitude_deg)
        lon = np.radians(longitude_deg)
        self._enu_R_earth = np.array(
            [
                [-np.sin(lon), np.cos(lon), 0.0],
                [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
                [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
            ]
        )

    def position(self, latitude_deg: float, longitude_deg: float, height: float) -> F64:
        """East, north, up (3,) in metres."""
        return np.asarray(
            self._enu_R_earth @ (earth_centred(latitude_deg, longitude_deg, height) - self._origin)
        )


def navsat_poses(roles: Roles, streams: Sequence[Stream]) -> NavSatPoses | None:
    """A source of poses where the log has fixes and no pose topic, or the fixes are named as that
    (``--topic pose=/fix``).
    """
    if roles.gnss is None or roles.pose not in (None, roles.gnss):
        return None
    return NavSatPoses(roles.gnss, sum(s.count for s in streams if s.topic == roles.gnss))


class NavSatPoses:
    """Poses of the base frame in the local frame from the fixes on ``topic``, of which ``count``
    are recorded, and the IMU's samples.
    """

    session_frame = "enu"
    child = ""

    def __init__(self, topic: str, count: int) -> None:
        self.name = topic
        self.notes: list[str] = []
        self.is_over = False
        self.local: LocalFrame | None = None
        self._count, self._seen, self._refused, self._used = count, 0, 0, 0
        # stamp, antenna, its frame
        self._fixes: deque[tuple[int, F64, str]] = deque(maxlen=_MOST_WAITING)
        # fixes within the window behind the next one to give
        self._past: deque[tuple[int, F64]] = deque()
        self._newest: int | None = None
        self._imu = PoseTrack(keep_seconds=60.0)
        self._forces: deque[tuple[int, F64]] = deque(maxlen=16_384)
        self._imu_frame: str | None = None
        self._has_orientation = False
        self._heading: float | None = None
        # fixes before the first course is known
        self._held: deque[tuple[int, F64]] = deque(maxlen=_MOST_WAITING)
        self._off: list[float] = []

    def take(self, frame: Frame) -> None:
        """A fix or a sample of the IMU; other frames are none of its business."""
        stamp_ns = frame.header.stamp_ns
        if isinstance(frame, NavSatSample) and frame.header.topic == self.name:
            self._seen += 1
            sigma = (
                0.0
                if frame.covariance is None
                else float(np.sqrt(np.diag(frame.covariance)[:2].max()))
            )
            is_late = self._newest is not None and stamp_ns <= self._newest
            if sigma > MAX_SIGMA or is_late or not is_time(stamp_ns):
                self._refused += 1
                return
            if self.local is None:
                self.local = LocalFrame(frame.latitude_deg, frame.longitude_deg, frame.altitude)
            position = self.local.position(frame.latitude_deg, frame.longitude_deg, frame.altitude)
            self._fixes.append((stamp_ns, position, frame.header.frame_id))
            self._newest = stamp_ns
        elif isinstance(frame, ImuSample) and is_time(stamp_ns):
            if self._imu_frame is None:
                self._imu_frame = frame.header.frame_id
            self._forces.append((stamp_ns, frame.acceleration))
            if frame.orientation is not None:
                self._has_orientation = True
                self._imu.append(stamp_ns, transform(np.zeros(3), frame.orientation))

    def poses(self, base_T: Callable[[str, int], F64 | None]) -> Iterator[tuple[int, F64]]:
        """Stamps and ``enu_T_base`` that are new since the last call."""
        while self._fixes and self._is_ready(self._fixes[0][0]):
            stamp_ns, antenna, frame_id = self._fixes.popleft()
            course, acceleration = self._motion(stamp_ns, antenna)
            base_T_antenna = base_T(frame_id, stamp_ns)
            lever = np.zeros(3) if base_T_antenna is None else base_T_antenna[:3, 3]
            mounting = None if self._imu_frame is None else base_T(self._imu_frame, stamp_ns)
            if base_T_antenna is None:
                self._note(
                    f"No transform leads from '{frame_id}', the antenna of {self.name}, to the base frame: it is taken to sit there."
                )
            if self._has_orientation and mounting is not None:
                rotation = self._imu_rotation(stamp_ns, mounting, course)
                if rotation is not None:
                    yield self._pose(stamp_ns, antenna, lever, rotation)
                continue
            if self._imu_frame is not None and mounting is None:
                self._note(
                    f"No transform leads from '{self._imu_frame}', the IMU's frame, to the base frame: headings are courses over ground."
                )
            tilt_force = None if mounting is None else self._force(stamp_ns, mounting)
            yield from self._along_course(
                stamp_ns, antenna, lever, course, acceleration, tilt_force
            )

    def finish(self) -> None:
        """All frames of the log have been seen."""
        self.is_over = True

    @property
    def problems(self) -> list[str]:
        """Sentences about what was left out."""
        told = []
        silent = max(self._count - self._seen, 0) if self.is_over else 0
        for count, why in (
            (silent, "say that there is no fix"),
            (self._refused, f"are less certain than {MAX_SIGMA:g} m or out of order"),
        ):
            if count:
                told.append(
                    f"{self.name}: {count} of {self._count} messages {why}; they were left out."
                )
        if self._held:
            told.append(
                f"{self.name} never moves faster than {MIN_SPEED:g} m/s and no IMU with a known mounting says the heading: its "
                f"{len(self._held)} fixes give no pose; use --odometry lidar, or give poses with --poses FILE."
            )
        off = float(np.angle(np.mean(np.exp(1j * np.array(self._off))))) if self._off else 0.0
        if abs(off) > _OFF_HEADING:
            told.append(
                f"The IMU's heading is off the course over ground by {np.degrees(off):.0f} degrees: it is not relative to east (REP 103), "
                f"or TF turns the IMU; take headings from the course with --topic imu=none."
            )
        return told

    def to_json(self) -> dict[str, object]:
        """For session.json."""
        datum = None if self.local is None else list(self.local.datum)
        told: dict[str, object] = {
            "kind": "navsat",
            "topic": self.name,
            "datum_lat_lon_height": datum,
            "fixes": self._used,
        }
        return told | {"heading": "imu" if self._heading is None else "course"}

    def _note(self, sentence: str) -> None:
        if sentence not in self.notes:
            self.notes.append(sentence)

    def _is_ready(self, stamp_ns: int) -> bool:
        """Whether the fixes and the IMU have come far enough beyond a fix, or will not any more."""
        newest = self._fixes[-1][0]
        if self.is_over:
            return True
        if newest < stamp_ns + WINDOW_NS:
            return False
        imu_end = self._imu.end_ns if self._has_orientation else None
        return (
            imu_end is None or imu_end >= stamp_ns or newest >= stamp_ns + WINDOW_NS + _IMU_LATE_NS
        )

    def _motion(self, stamp_ns: int, antenna: F64) -> tuple[float | None, F64]:
        """Course (rad from east; None when slow) and acceleration (3,): of a parabola through the
        fixes around this one.
        """
        self._past.append((stamp_ns, antenna))
        while self._past[0][0] < stamp_ns - WINDOW_NS:
            self._past.popleft()
        near = [*self._past]
        for later in self._fixes:
            if later[0] > stamp_ns + WINDOW_NS:
                break
            near.append(later[:2])
        t = np.array([(s - stamp_ns) * 1e-9 for s, _ in near])
        if len(near) < 2:
            return None, np.zeros(3)
        degree = 2 if len(near) > 3 else 1
        fitted, *_ = np.linalg.lstsq(
            np.vander(t, degree + 1, increasing=True), np.array([p for _, p in near]), rcond=None
        )
        velocity = fitted[1]
        acceleration = 2.0 * fitted[2] if degree == 2 else np.zeros(3)
        is_moving = np.hypot(*velocity[:2]) >= MIN_SPEED
        return (float(np.arctan2(velocity[1], velocity[0])) if is_moving else None), acceleration

    def _imu_rotation(self, stamp_ns: int, base_T_imu: F64, course: float | None) -> F64 | None:
        enu_T_imu = self._imu.at(stamp_ns)
        if enu_T_imu is None:
            return None
        rotation = enu_T_imu[:3, :3] @ base_T_imu[:3, :3].T
        if course is not None and len(self._off) < _MOST_WAITING:
            self._off.append(float(np.arctan2(rotation[1, 0], rotation[0, 0])) - course)
        return rotation

    def _force(self, stamp_ns: int, base_T_imu: F64) -> F64 | None:
        """Mean specific force (3,) in the base frame around a time."""
        while self._forces and self._forces[0][0] < stamp_ns - WINDOW_NS:
            self._forces.popleft()
        near = []
        for s, force in self._forces:
            if s > stamp_ns + WINDOW_NS:
                break
            near.append(force)
        return base_T_imu[:3, :3] @ np.mean(near, axis=0) if near else None

    def _along_course(
        self,
        stamp_ns: int,
        antenna: F64,
        lever: F64,
        course: float | None,
        acceleration: F64,
        force: F64 | None,
    ) -> Iterator[tuple[int, F64]]:
        """The pose that looks along the course; fixes before the first one take it, because the
        vehicle stood.
        """
        if course is not None:
            turned = (
                None
                if self._heading is None
                else float(np.angle(np.exp(1j * (course - self._heading))))
            )
            self._heading = course if turned is None or abs(turned) < _REVERSE else course + np.pi
        tilt = None
        if (
            force is not None
            and np.linalg.norm(force) > 0.5 * _GRAVITY[2]
            and self._heading is not None
        ):
            felt = yaw_transform(-self._heading)[:3, :3] @ acceleration + _GRAVITY
            tilt = rotation_between(force, felt)
        if self._heading is None:
            self._held.append((stamp_ns, antenna))
            return
        level = yaw_transform(self._heading)[:3, :3]
        for before_ns, before in self._held:
            yield self._pose(before_ns, before, lever, level)
        self._held.clear()
        yield self._pose(stamp_ns, antenna, lever, level if tilt is None else level @ tilt)

    def _pose(self, stamp_ns: int, antenna: F64, lever: F64, rotation: F64) -> tuple[int, F64]:
        self._used += 1
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_matrix(rotation).as_matrix()
        pose[:3, 3] = antenna - pose[:3, :3] @ lever
        return stamp_ns, pose

"""Poses from satellite fixes and an IMU, for logs without a pose stream.

WGS 84 -> a local east-north-up frame about the first fix.
Geodetic coordinates become Earth-centred ones in closed form, these a tangent frame
(Hofmann-Wellenhof et al., GNSS, 2008, section 8.2; constants of WGS 84: NGA.STND.0036). The
orientation comes from the IMU (REP 103 and 105: relative to east, north, up) where it reports one
and TF has its mounting, else from the course over ground, with roll and pitch from the
accelerometer. Single fixes are a metre or so off, which a map shows: any other source of poses is
better.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64
from semloc_logs.frames import Frame, ImuSample, NavSatSample
from semloc_logs.logs.log import Stream
from semloc_logs.logs.poses.track import PoseTrack, is_time
from semloc_logs.logs.problems import Problem, ProblemKind, Problems
from semloc_logs.logs.roles import Roles
from semloc_logs.numerics.transforms import rotation_between, transform, yaw_transform
from semloc_logs.numerics.wgs84 import E2, FLATTENING, SEMI_MAJOR

# m; a fix that is less certain than this, horizontally, does not resolve a street's width
MAX_SIGMA = 5.0
MIN_SPEED = 1.0  # m/s; slower, the course over ground is noise, and the last one holds
WINDOW_NS = 1_500_000_000  # fixes to either side that course and acceleration are fitted to
_IMU_LATE_NS = 1_000_000_000  # a fix waits so long for the IMU
# a course that turns by more between two fixes means driving backwards
_REVERSE = np.radians(120.0)
# an IMU heading that is off the course by more is not relative to east
_OFF_HEADING = np.radians(20.0)
_GRAVITY = np.array([0.0, 0.0, 9.80665])
_LEAST_FORCE = 0.5 * _GRAVITY[2]  # m/s^2; a smaller mean force is not gravity
_LONGEST_WAIT_NS = 5_000_000_000  # for a fix with an altitude; frames wait for their poses
_MOST_WAITING = 100_000  # fixes; beyond, the oldest are forgotten


def earth_centred(latitude_deg: float, longitude_deg: float, height: float) -> F64:
    """WGS 84 degrees and ellipsoid height (m) -> Earth-centred, Earth-fixed coordinates (3,), m."""
    lat = np.radians(latitude_deg)
    lon = np.radians(longitude_deg)
    n = SEMI_MAJOR / np.sqrt(1.0 - E2 * np.sin(lat) ** 2)
    around = (n + height) * np.cos(lat)
    return np.array(
        [around * np.cos(lon), around * np.sin(lon), (n * (1.0 - E2) + height) * np.sin(lat)]
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

    def geodetic(self, positions: F64) -> F64:
        """Latitudes and longitudes (degrees) and heights (m) of positions (n, 3) of the frame.

        Bowring, Survey Review 28, 1985: below a millimetre for heights up to 10 km.
        """
        x, y, z = (positions @ self._enu_R_earth + self._origin).T
        semi_minor = SEMI_MAJOR * (1.0 - FLATTENING)
        around = np.hypot(x, y)
        parametric = np.arctan2(z * SEMI_MAJOR, around * semi_minor)
        for _ in range(2):
            latitude = np.arctan2(
                z + E2 / (1.0 - E2) * semi_minor * np.sin(parametric) ** 3,
                around - E2 * SEMI_MAJOR * np.cos(parametric) ** 3,
            )
            parametric = np.arctan2((1.0 - FLATTENING) * np.sin(latitude), np.cos(latitude))
        curvature = SEMI_MAJOR / np.sqrt(1.0 - E2 * np.sin(latitude) ** 2)
        height = (
            around * np.cos(latitude)
            + (z + E2 * curvature * np.sin(latitude)) * np.sin(latitude)
            - curvature
        )
        return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), height], axis=1)


def navsat_poses(roles: Roles, streams: Sequence[Stream]) -> NavSatPoses | None:
    """A source of poses where the log has fixes and no pose topic.

    Also where the fixes are named as the pose topic (``--topic pose=/fix``).
    """
    if roles.gnss is None or roles.pose not in (None, roles.gnss):
        return None
    return NavSatPoses(roles.gnss, sum(s.count for s in streams if s.topic == roles.gnss))


class _Motion(NamedTuple):
    """``course`` over ground (rad from east; None when slow) and ``acceleration`` (3,) in m/s^2."""

    course: float | None
    acceleration: F64


class _Heights:
    """Heights (m) of fixes, interpolated in time where the receiver did not measure them.

    A fix waits for the next height, but no longer than 5 s: the one before serves.
    Where none was known so far, heights are counted from the first one to come.
    """

    def __init__(self) -> None:
        self._waiting: deque[NavSatSample] = deque(maxlen=_MOST_WAITING)
        self._known: tuple[int, float] | None = None  # stamp and height of the last that was known
        self._start: float | None = None  # the height that counts as 0
        self._given = 0

    @property
    def is_constant(self) -> bool:
        """Whether heights were given although none is known."""
        return self._given > 0 and self._known is None

    def add(self, fix: NavSatSample) -> None:
        """The next fix, with or without altitude."""
        self._waiting.append(fix)

    def take(self, *, is_over: bool) -> Iterator[tuple[NavSatSample, float]]:
        """The fixes whose height will not change any more; ``is_over``: no more will come."""
        newest = self._waiting[-1] if self._waiting else None
        if newest is None:
            return
        is_known = math.isfinite(newest.altitude)
        waited_ns = newest.header.stamp_ns - self._waiting[0].header.stamp_ns
        if not (is_known or is_over or waited_ns > _LONGEST_WAIT_NS):
            return
        if is_known and self._start is None:
            # where fixes were given without any height, they were given at 0
            self._start = newest.altitude if self._given else 0.0
        before = self._known
        after = None
        if is_known:
            after = (newest.header.stamp_ns, newest.altitude - (self._start or 0.0))
            self._known = after
        while self._waiting:
            fix = self._waiting.popleft()
            self._given += 1
            yield fix, _height_between(before, after, fix.header.stamp_ns)


def _height_between(
    before: tuple[int, float] | None, after: tuple[int, float] | None, stamp_ns: int
) -> float:
    """The height at a time between two stamps with known heights; 0 where none is known."""
    if before is None or after is None:
        known = before or after
        return 0.0 if known is None else known[1]
    share = (stamp_ns - before[0]) / (after[0] - before[0])
    return before[1] + share * (after[1] - before[1])


class NavSatPoses:
    """Poses of the base frame in the local frame, from fixes and the samples of an IMU.

    ``count`` fixes are recorded on ``topic``.
    """

    session_frame = "enu"
    child = ""

    def __init__(self, topic: str, count: int) -> None:
        self.name = topic
        self._assumptions = Problems()
        self.is_over = False
        self.local: LocalFrame | None = None
        self._count = count
        self._seen = 0
        self._without_fix = 0
        self._refused = 0
        self._used = 0
        self._heights = _Heights()
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
        self._heading_errors: list[float] = []  # rad, IMU heading minus course

    def take(self, frame: Frame) -> None:
        """Takes a fix or a sample of the IMU; other frames are ignored."""
        if isinstance(frame, NavSatSample) and frame.header.topic == self.name:
            self._take_fix(frame)
        elif isinstance(frame, ImuSample) and is_time(frame.header.stamp_ns):
            self._take_imu(frame)

    def _take_fix(self, fix: NavSatSample) -> None:
        self._seen += 1
        if not fix.has_fix:
            self._without_fix += 1
            return
        stamp_ns = fix.header.stamp_ns
        sigma = 0.0 if fix.covariance is None else float(np.sqrt(np.diag(fix.covariance)[:2].max()))
        is_late = self._newest is not None and stamp_ns <= self._newest
        if sigma > MAX_SIGMA or is_late or not is_time(stamp_ns):
            self._refused += 1
            return
        self._newest = stamp_ns
        self._heights.add(fix)
        self._place_fixes()

    def _place_fixes(self) -> None:
        """Turns the fixes whose heights are known into positions."""
        for fix, height in self._heights.take(is_over=self.is_over):
            if self.local is None:
                self.local = LocalFrame(fix.latitude_deg, fix.longitude_deg, height)
            position = self.local.position(fix.latitude_deg, fix.longitude_deg, height)
            self._fixes.append((fix.header.stamp_ns, position, fix.header.frame_id))

    def _take_imu(self, sample: ImuSample) -> None:
        stamp_ns = sample.header.stamp_ns
        if self._imu_frame is None:
            self._imu_frame = sample.header.frame_id
        if np.isfinite(sample.acceleration).all():
            self._forces.append((stamp_ns, sample.acceleration))
        if sample.orientation is not None:
            self._has_orientation = True
            self._imu.append(stamp_ns, transform(np.zeros(3), sample.orientation))

    def poses(self, base_T: Callable[[str, int], F64 | None]) -> Iterator[tuple[int, F64]]:
        """Stamps and ``enu_T_base`` that are new since the last call."""
        while self._fixes and self._is_ready(self._fixes[0][0]):
            stamp_ns, antenna, frame_id = self._fixes.popleft()
            motion = self._motion(stamp_ns, antenna)
            lever = self._lever(base_T(frame_id, stamp_ns), frame_id)
            mounting = None if self._imu_frame is None else base_T(self._imu_frame, stamp_ns)

            if self._has_orientation and mounting is not None:
                rotation = self._imu_rotation(stamp_ns, mounting, motion.course)
                if rotation is not None:
                    yield self._pose(stamp_ns, antenna, lever, rotation)
                continue

            if self._imu_frame is not None and mounting is None:
                self._assume(
                    f"No transform leads from '{self._imu_frame}', the IMU's frame, to the base "
                    f"frame: headings are courses over ground.",
                    is_harmless=True,
                )
            force = None if mounting is None else self._force(stamp_ns, mounting)
            yield from self._along_course(stamp_ns, antenna, lever, motion, force)

    def finish(self) -> None:
        """All frames of the log have been seen."""
        self.is_over = True
        self._place_fixes()

    @property
    def problems(self) -> list[Problem]:
        """Fixes that give no pose (lost), and assumptions about mounting and heading."""
        problems = Problems()
        for count, reason in (
            (self._without_fix, "report a missing fix"),
            (self._refused, f"are less certain than {MAX_SIGMA:g} m or out of order"),
        ):
            if count:
                self._lose(
                    problems,
                    f"{self.name}: {count} of {self._count} messages {reason}; they were left out.",
                )
        if self._held:
            self._lose(
                problems,
                f"{self.name} never moves faster than {MIN_SPEED:g} m/s, and no IMU with a known "
                f"mounting gives the heading: its {len(self._held)} fixes give no pose; "
                f"use --odometry lidar, or give poses with --poses FILE.",
            )
        if self._heights.is_constant:
            problems.assume(
                f"No fix of {self.name} has an altitude: its heights are taken as constant; "
                f"give poses with --poses FILE where the ground is not level.",
                topic=self.name,
                kind=ProblemKind.POSE,
            )
        errors = np.array(self._heading_errors)
        mean_error = float(np.angle(np.mean(np.exp(1j * errors)))) if len(errors) else 0.0
        if abs(mean_error) > _OFF_HEADING:
            self._lose(
                problems,
                f"The IMU's heading is off the course over ground by "
                f"{np.degrees(mean_error):.0f} degrees on average, while REP 103 wants it from "
                f"east: take headings from the course with --topic imu=none.",
            )
        return [*problems, *self._assumptions]

    def to_json(self) -> dict[str, object]:
        """For session.json."""
        datum = None if self.local is None else list(self.local.datum)
        return {
            "kind": "navsat",
            "topic": self.name,
            "datum_lat_lon_height": datum,
            "fixes": self._used,
            "heading": "imu" if self._heading is None else "course",
        }

    def _lose(self, problems: Problems, text: str) -> None:
        problems.add(text, topic=self.name, kind=ProblemKind.POSE)

    def _assume(self, text: str, *, is_harmless: bool = False) -> None:
        self._assumptions.add(
            text,
            topic=self.name,
            kind=ProblemKind.TRANSFORM,
            lost=False,
            assumed=not is_harmless,
        )

    def _lever(self, base_T_antenna: F64 | None, frame_id: str) -> F64:
        """Position (3,) of the antenna in the base frame."""
        if base_T_antenna is not None:
            return base_T_antenna[:3, 3]
        self._assume(
            f"No transform leads from '{frame_id}', the antenna of {self.name}, to the base frame: "
            f"it is taken to sit there; where it sits elsewhere, give its place with "
            f"--set logs.mountings.{frame_id}=[x,y,z,0,0,0,1]."
        )
        return np.zeros(3)

    def _is_ready(self, stamp_ns: int) -> bool:
        """Whether the fixes and the IMU have come far enough beyond a fix, or are over."""
        newest = self._fixes[-1][0]
        if self.is_over:
            return True
        if newest < stamp_ns + WINDOW_NS:
            return False
        imu_end = self._imu.end_ns if self._has_orientation else None
        return (
            imu_end is None or imu_end >= stamp_ns or newest >= stamp_ns + WINDOW_NS + _IMU_LATE_NS
        )

    def _motion(self, stamp_ns: int, antenna: F64) -> _Motion:
        """Course and acceleration of a parabola through the fixes around this one."""
        self._past.append((stamp_ns, antenna))
        while self._past[0][0] < stamp_ns - WINDOW_NS:
            self._past.popleft()
        window = [*self._past]
        for later in self._fixes:
            if later[0] > stamp_ns + WINDOW_NS:
                break
            window.append(later[:2])
        t = np.array([(s - stamp_ns) * 1e-9 for s, _ in window])
        if len(window) < 2:
            return _Motion(None, np.zeros(3))
        degree = 2 if len(window) > 3 else 1
        fitted, *_ = np.linalg.lstsq(
            np.vander(t, degree + 1, increasing=True), np.array([p for _, p in window]), rcond=None
        )
        velocity = fitted[1]
        acceleration = 2.0 * fitted[2] if degree == 2 else np.zeros(3)
        is_moving = np.hypot(*velocity[:2]) >= MIN_SPEED
        course = float(np.arctan2(velocity[1], velocity[0])) if is_moving else None
        return _Motion(course, acceleration)

    def _imu_rotation(self, stamp_ns: int, base_T_imu: F64, course: float | None) -> F64 | None:
        enu_T_imu = self._imu.at(stamp_ns)
        if enu_T_imu is None:
            return None
        rotation = enu_T_imu[:3, :3] @ base_T_imu[:3, :3].T
        if course is not None and len(self._heading_errors) < _MOST_WAITING:
            heading = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
            self._heading_errors.append(heading - course)
        return rotation

    def _force(self, stamp_ns: int, base_T_imu: F64) -> F64 | None:
        """Mean specific force (3,) in the base frame around a time."""
        while self._forces and self._forces[0][0] < stamp_ns - WINDOW_NS:
            self._forces.popleft()
        window = []
        for s, force in self._forces:
            if s > stamp_ns + WINDOW_NS:
                break
            window.append(force)
        return base_T_imu[:3, :3] @ np.mean(window, axis=0) if window else None

    def _along_course(
        self,
        stamp_ns: int,
        antenna: F64,
        lever: F64,
        motion: _Motion,
        force: F64 | None,
    ) -> Iterator[tuple[int, F64]]:
        """The pose that looks along the course, with the tilt that ``force`` shows.

        Fixes before the first course take it too, because the vehicle stood.
        """
        self._turn_to(motion.course)
        if self._heading is None:
            self._held.append((stamp_ns, antenna))
            return
        tilt = None
        if force is not None and np.linalg.norm(force) > _LEAST_FORCE:
            expected = yaw_transform(-self._heading)[:3, :3] @ motion.acceleration + _GRAVITY
            tilt = rotation_between(force, expected)
        level = yaw_transform(self._heading)[:3, :3]
        for before_ns, before in self._held:
            yield self._pose(before_ns, before, lever, level)
        self._held.clear()
        yield self._pose(stamp_ns, antenna, lever, level if tilt is None else level @ tilt)

    def _turn_to(self, course: float | None) -> None:
        """The heading is the course, or its opposite when driving backwards."""
        if course is None:
            return
        is_reverse = (
            self._heading is not None
            and abs(float(np.angle(np.exp(1j * (course - self._heading))))) >= _REVERSE
        )
        self._heading = course + np.pi if is_reverse else course

    def _pose(self, stamp_ns: int, antenna: F64, lever: F64, rotation: F64) -> tuple[int, F64]:
        self._used += 1
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_matrix(rotation).as_matrix()
        pose[:3, 3] = antenna - pose[:3, :3] @ lever
        return stamp_ns, pose

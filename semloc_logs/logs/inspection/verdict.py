"""Whether a log can be mapped and searched, in one sentence, and the command that does it."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from semloc_logs.arrays import F32, F64
from semloc_logs.logs.inspection import units
from semloc_logs.logs.log import Stream
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.logs.problems import Problem, ProblemKind
from semloc_logs.logs.problems import sentences as texts_of
from semloc_logs.logs.role_types import kind_of, no_sensor, packets
from semloc_logs.logs.roles import Roles
from semloc_logs.settings import STREET_VOXEL, Logs, Settings

# a voxel size (m) suits sensors whose points lie within this range (m): a room at 0.05 m voxels is
# a street in miniature, and so is a floor of offices at 0.10 m
_VOXEL_OF_RANGE = ((6.0, 0.05), (12.0, 0.10))
_FAR_SHARE = 0.95  # of the points lie within the range of a sensor
# at 0.30 m voxels: a place is the same again within this distance (m) ...
_SAME_PLACE = 10.0
_DRIFT = 0.01  # ... and this share of the track, by which odometry may have drifted
_MOST_PLACES = 20_000
_LABELS = {
    "cloud": "labels in the cloud",
    "images": "labels in label images",
    "geometry": "labels from geometry",
}
# problems with the topic of a sensor that keep all of its frames from becoming clouds
_BLOCKING = {
    ProblemKind.CALIBRATION, ProblemKind.TRANSFORM, ProblemKind.POSE, ProblemKind.ROLE
}  # fmt: skip
_PLANE_SCANS = {"laserscan", "multiecholaserscan"}  # kinds of messages with a 2-D scan
_NO_SENSOR = (
    "there is neither a LIDAR nor a depth stream nor a stereo pair; record one, or name its topic "
    "with --topic."
)
SCAN_REMEDY = (
    "a 2-D scan cannot be mapped; record the point cloud of a 3-D LIDAR, a depth camera or a "
    "stereo pair."
)
_PLANE = 5e-3  # m; the points of a 2-D scanner deviate less from their plane, a room deviates more
_FEWEST = 20  # points that tell a plane


@dataclass(frozen=True, slots=True)
class Verdict:
    """``text`` for people, with the command ``suggested`` at its end; "" where none helps.

    ``voxel_size`` (m) suits the log; None where it cannot be mapped.
    """

    text: str
    suggested: str = ""
    voxel_size: float | None = None


@dataclass(frozen=True, slots=True)
class Command:
    """The log, and the roles and settings of reading that the user chose, for the command that is
    suggested.
    """

    path: str
    topics: Mapping[str, str]
    logs: Logs = field(default_factory=Logs)

    def text(self, *options: str) -> str:
        """``semloc run LOG -w work`` with options."""
        words = ["semloc", "run", self.path, "-w", "work"]
        for role, topic in self.topics.items():
            words += ["--topic", f"{role}={topic}"]
        for key, value in self.logs.model_dump(mode="json", exclude_defaults=True).items():
            named = value if isinstance(value, dict) else {"": value}
            for name, one in named.items():
                words += ["--set", f"logs.{key}{name and '.' + name}={one}"]
        return shlex.join([*words, *options])


@dataclass(frozen=True, slots=True)
class Look:
    """What an inspection knows of a log.

    ``rates`` (Hz) by topic, None where that has no meaning; ``far``: range (m) of nearly all points
    in the first frame of a sensor; ``seen``: range sensors whose first frame is good, or not known
    yet; ``labels``: ``cloud``, ``images`` or ``geometry``; ``is_complete``: all messages were read.
    """

    command: Command
    roles: Roles
    streams: Sequence[Stream]
    rates: Mapping[str, float | None]
    far: Mapping[str, float | None]
    seen: frozenset[str]
    labels: str
    track: PoseTrack
    is_complete: bool

    def count(self, topics: Collection[str]) -> int:
        """Messages of some topics."""
        return sum(s.count for s in self.streams if s.topic in topics)


def verdict_of(look: Look, problems: Sequence[Problem], *, is_reported: bool) -> Verdict:
    """The verdict; ``is_reported``: some of the ``problems`` are lost data or assumptions."""
    usable = _usable(look, problems)
    if reason := _refusal(look, problems, usable):
        return Verdict(f"not ready: {reason}")

    known = [far for topic in usable if (far := look.far.get(topic)) is not None]
    far = max(known, default=None)
    size = voxel_size(far)
    sentences = [", ".join([*_sensors(look, usable), *_poses(look), _LABELS[look.labels]])]
    if far is not None and size < STREET_VOXEL:
        sentences.append(f"nearly all points lie within {far:.1f} m, so small voxels suit it")
    options = () if size == STREET_VOXEL else ("--set", f"fusion.voxel_size={size:.2f}")
    state = "ready, but read the problems first" if is_reported else "ready"
    if not len(look.track):
        state = "ready for single frames only"
        if look.count(usable) > 1:
            sentences.append("a map needs poses")
        if look.count(usable) > 1 and any(topic in look.roles.lidar for topic in usable):
            options = ("--odometry", "lidar", *options)
    elif look.is_complete:
        sentences += _no_closure_within(look.track, size)
    suggested = look.command.text(*options)
    return Verdict(f"{state}: {'; '.join(sentences)}; suggested: {suggested}", suggested, size)


def _usable(look: Look, problems: Sequence[Problem]) -> tuple[str, ...]:
    """The range sensors whose frames become clouds, as far as their first frames tell."""
    blocked = {p.topic for p in problems if p.kind in _BLOCKING and not p.is_reported}
    return tuple(t for t in look.roles.ranging if t in look.seen and t not in blocked)


def _refusal(look: Look, problems: Sequence[Problem], usable: Sequence[str]) -> str:
    """Why neither a map nor a query can be made, with the remedy; "" where one can."""
    roles = look.roles
    if roles.problems:
        return " ".join(texts_of(roles.problems))
    recorded = [s for s in look.streams if s.count]
    if not recorded:
        return "the log holds no messages; record it again."
    if not roles.ranging:
        scans = [f"{s.topic} ({s.type})" for s in recorded if kind_of(s.type) in _PLANE_SCANS]
        if scans:
            return f"{', '.join(scans)}: {SCAN_REMEDY}"
        return no_sensor(look.streams) if packets(look.streams) else _NO_SENSOR
    if usable:
        return ""
    about = [p.text for p in problems if p.topic in roles.ranging]
    return about[0] if about else f"no frame of {', '.join(roles.ranging)} can be decoded."


def _sensors(look: Look, usable: Sequence[str]) -> list[str]:
    """Such as ``LIDAR 10 Hz`` and ``depth camera 15 Hz``."""
    texts = []
    roles = look.roles
    for name, of_kind in (
        ("LIDAR", roles.lidar),
        ("depth camera", roles.depth),
        ("stereo pair", roles.topics("stereo_left")),
    ):
        topics = [topic for topic in usable if topic in of_kind]
        if not topics:
            continue
        known = [rate for topic in topics if (rate := look.rates.get(topic)) is not None]
        rates = dict.fromkeys(units.rate(rate) for rate in known)
        plural = f"{len(topics)} {name}s" if len(topics) > 1 else name
        texts.append(f"{plural} {', '.join(rates)}" if rates else f"one {name} frame")
    poses = "poses" if look.count(usable) > 1 or len(look.track) > 1 else "a pose"
    texts[-1] += f" with {poses}" if len(look.track) else f" without {poses}"
    return texts


def _poses(look: Look) -> list[str]:
    """The length of the track."""
    if len(look.track) < 2:
        return []
    length = units.distance(travelled(look.track, is_complete=look.is_complete))
    return [length if look.is_complete else f"at least {length}"]


def voxel_size(far: float | None) -> float:
    """The voxel size (m) for a sensor of this range (m); the street's when it is unknown."""
    if far is None:
        return STREET_VOXEL
    return next((size for limit, size in _VOXEL_OF_RANGE if far < limit), STREET_VOXEL)


def far_range(ranges: F32) -> float | None:
    """The range (m) within which nearly all points lie; None without points."""
    return float(np.quantile(ranges, _FAR_SHARE)) if len(ranges) else None


def is_planar(points: F32) -> bool:
    """Whether points (n, 3) are the scan of one plane, as a 2-D scanner measures it."""
    if len(points) < _FEWEST:
        return False
    exact = points.astype(np.float64)
    centre = exact.mean(axis=0)
    variances, axes = np.linalg.eigh(np.cov(exact.T, bias=True))
    thickness, width, _ = np.sqrt(variances.clip(0.0))
    # the sensor itself lies in the plane of its scan, but not in the plane of a wall before it
    distance = abs(float(axes[:, 0] @ centre))
    return bool(thickness < _PLANE and distance < _PLANE and width > 10 * _PLANE)


# -- the track


def travelled(track: PoseTrack, *, is_complete: bool) -> float:
    """Metres travelled: gaps left out; at least this far by a sample of the poses."""
    if is_complete:
        return track.length()
    return float(np.linalg.norm(np.diff(_positions(track), axis=0), axis=1).sum())


def _no_closure_within(track: PoseTrack, size: float) -> list[str]:
    """Why the log gives no closure with itself, if that is certain."""
    others = "closures need a second log of the place"
    if len(track) == 1:
        return [others]
    closures = Settings.model_validate({"fusion": {"voxel_size": size}}).resolved().closures
    length = track.length()
    if length < closures.exclude_distance:
        return [
            f"the track is too short for closures within the log ({units.distance(length)} of at "
            f"least {units.distance(closures.exclude_distance)}): {others}"
        ]
    reach = _SAME_PLACE * size / STREET_VOXEL + _DRIFT * length
    if comes_back(track, reach, closures.exclude_distance):
        return []
    return [f"the track never comes back within {units.distance(reach)} of itself: {others}"]


def comes_back(track: PoseTrack, reach: float, apart: float) -> bool:
    """Whether the track comes within ``reach`` (m) of a place it left ``apart`` (m) of road ago."""
    positions = _positions(track)
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    road = np.concatenate([[0.0], np.cumsum(steps)])
    spacing = max(reach / 5, road[-1] / _MOST_PLACES)
    # one place for each stretch of this length: standing still adds none
    _, first = np.unique(np.floor(road / max(spacing, 1e-9)), return_index=True)
    tree = cKDTree(positions[first])
    pairs = tree.query_pairs(reach + spacing, output_type="ndarray")
    return bool((np.abs(np.diff(road[first][pairs], axis=1)) > apart).any())


def _positions(track: PoseTrack) -> F64:
    return track.poses[:, :3, 3]

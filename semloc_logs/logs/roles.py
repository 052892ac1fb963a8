"""Which topic plays which role, found by message type and name; ``--topic ROLE=TOPIC`` overrules."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from semloc_logs.errors import RoleError
from semloc_logs.logs.log import Stream

ROLES = (
    "lidar", "depth", "image", "camera_info", "stereo_left", "stereo_right", "label_image", "label_info", "pose", "tf",
    "tf_static", "imu", "gnss",
)  # fmt: skip
_SINGLE = ("stereo_left", "stereo_right", "pose", "imu", "gnss")
OWN_PREFIX = "/semloc/"  # results of an earlier run, never an input

# Message types by their last part: sensor_msgs/msg/PointCloud2, foxglove.PointCloud,
# tf/msg/tfMessage ...
_CLOUDS = {"pointcloud2", "pointcloud", "livox"}
# what a driver records before it makes points of it, or packed by a codec
_PACKETS = re.compile(
    r"velodynescan|velodynepacket|packetmsg|pandarscan|udppacket|udpframe|rslidarscan|rslidarpacket|nebulapackets?|compressedpointcloud2?$"
)
_IMAGES = {"image", "compressedimage", "rawimage"}
_CAMERAS = {"camerainfo", "cameracalibration"}
_TRANSFORMS = {"tfmessage", "frametransform", "frametransforms"}
# the more the message says, the better: an Odometry names its child frame, a PoseStamped does not
_POSES = {
    "odometry": 0,
    "posewithcovariancestamped": 1,
    "posestamped": 2,
    "poseinframe": 2,
    "transformstamped": 3,
}
_FIXES = {"navsatfix", "locationfix"}
_TYPES_OF_ROLE: dict[str, set[str]] = {
    "lidar": _CLOUDS, "depth": _IMAGES, "image": _IMAGES, "camera_info": _CAMERAS, "stereo_left": _IMAGES, "stereo_right": _IMAGES,
    "label_image": _IMAGES, "label_info": {"labelinfo", "string"}, "pose": set(_POSES) | _TRANSFORMS | _FIXES,
    "tf": _TRANSFORMS, "tf_static": _TRANSFORMS, "imu": {"imu"}, "gnss": _FIXES,
}  # fmt: skip

_TRANSPORTS = {"compressed", "compresseddepth", "theora", "ffmpeg", "zstd"}
_DEPTH = re.compile(r"depth")
_LABEL = re.compile(r"label|semantic|segment|(^|[/_])(seg|class(es)?)([/_]|$)")
# a label picture for people, not ids
_PAINTED = re.compile(r"colou?r|overlay|rgb|viz|vis(ual|$)|blend")
_DERIVED_CLOUD = {
    "map", "submap", "world", "global", "registered", "aligned", "cluster", "clusters", "object", "objects", "obstacle", "obstacles",
    "feature", "features", "corner", "planar", "surf", "keypoints", "radar",
}  # fmt: skip
_NOT_A_POSE = re.compile(
    r"goal|target|setpoint|desired|reference|cmd|command|initial|waypoint|plan|object|marker|tag|clicked|landing"
)
_REFERENCE_POSE = re.compile(r"truth|(^|[/_])gt([/_]|$)|wheel|controller|gps|gnss|imu|raw")
_FILTERED_POSE = re.compile(r"filtered|fused|ekf|ukf")
_LEFT_RIGHT = (
    ("left", "right"), ("cam0", "cam1"), ("cam_0", "cam_1"), ("infra1", "infra2"), ("image_00", "image_01"), ("image_02", "image_03"),
    ("image_0", "image_1"), ("image_2", "image_3"), ("camera_0", "camera_1"), ("camera0", "camera1"),
)  # fmt: skip


@dataclass(frozen=True)
class Roles:
    """Topics by role. ``info_of`` names the CameraInfo topic of a picture's topic, ``label_of`` the
    label image of a depth topic, ``names_of`` the topic that says what the labels of a label image
    or a LIDAR mean.

    ``problems`` are choices that nobody can make for the user; ``notes`` are choices that were
    made.
    """

    lidar: tuple[str, ...] = ()
    depth: tuple[str, ...] = ()
    image: tuple[str, ...] = ()
    camera_info: tuple[str, ...] = ()
    stereo_left: str | None = None
    stereo_right: str | None = None
    label_image: tuple[str, ...] = ()
    label_info: tuple[str, ...] = ()
    pose: str | None = None
    tf: tuple[str, ...] = ()
    tf_static: tuple[str, ...] = ()
    imu: str | None = None
    gnss: str | None = None
    info_of: dict[str, str] = field(default_factory=dict)
    label_of: dict[str, str] = field(default_factory=dict)
    names_of: dict[str, str] = field(default_factory=dict)
    problems: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def ranging(self) -> tuple[str, ...]:
        """The topics whose frames become clouds: LIDAR, depth and the left picture of a stereo
        pair.
        """
        pair = self.stereo_left is not None and self.stereo_right is not None
        return (*self.lidar, *self.depth, *(self.topics("stereo_left") if pair else ()))

    def topics(self, role: str) -> tuple[str, ...]:
        """The topics of a role, none or several."""
        value = getattr(self, role)
        return value if isinstance(value, tuple) else () if value is None else (value,)

    def role_of(self, topic: str) -> str | None:
        """The role that ``topic`` plays; None when it is not used. A stereo picture that serves as
        image is called stereo.
        """
        order = ("stereo_left", "stereo_right", *ROLES)
        return next((role for role in order if topic in self.topics(role)), None)

    def to_json(self) -> dict[str, object]:
        """Role -> list of topics, roles that nobody plays left out."""
        return {role: list(self.topics(role)) for role in ROLES if self.topics(role)}


def find_roles(streams: Sequence[Stream], overrides: Mapping[str, str] | None = None) -> Roles:
    """The roles of ``streams``; RoleError with the flags that solve it when they are ambiguous or
    an override is impossible.
    """
    roles = guess_roles(streams, overrides)
    if roles.problems:
        raise RoleError(" ".join(roles.problems))
    return roles


def guess_roles(streams: Sequence[Stream], overrides: Mapping[str, str] | None = None) -> Roles:
    """As :func:`find_roles`, but an ambiguous role stays empty and is named in ``problems``.

    ``overrides``: role -> topic, several topics separated by commas where a role can have several,
    or ``none`` to leave a role out. RoleError for an unknown role or topic and for a topic whose
    type cannot play the role.
    """
    kinds = {
        s.topic: _kind(s.type)
        for s in streams
        if s.count > 0 and not s.topic.startswith(OWN_PREFIX)
    }
    chosen = _overrides(streams, overrides or {})
    taken = {topic for topics in chosen.values() for topic in topics}
    problems: list[str] = []
    notes: list[str] = []

    def pick(role: str, find: Callable[[], Iterable[str]]) -> tuple[str, ...]:
        return (
            chosen[role]
            if role in chosen
            else tuple(t for t in find() if t not in taken or role == "image")
        )

    pictures = _one_transport(sorted(t for t, kind in kinds.items() if kind in _IMAGES))
    infos = pick("camera_info", lambda: sorted(t for t, kind in kinds.items() if kind in _CAMERAS))
    labels = pick("label_image", lambda: [t for t in pictures if _is_label(t)])
    depth = pick("depth", lambda: _depth_topics(pictures, labels))
    colour = [
        t
        for t in pictures
        if t not in (*labels, *depth)
        and not _DEPTH.search(t.lower())
        and not _LABEL.search(t.lower())
    ]
    lidar = pick(
        "lidar",
        lambda: _lidar_topics([t for t, kind in kinds.items() if kind in _CLOUDS], depth, notes),
    )
    is_asked = any(chosen.get(role) for role in ("stereo_left", "stereo_right"))
    left, right = _stereo(colour, chosen) if is_asked or not (lidar or depth) else ([], [])
    stereo_left = pick("stereo_left", lambda: left)
    stereo_right = pick("stereo_right", lambda: right)
    if bool(stereo_left) != bool(stereo_right) or (stereo_left and stereo_left == stereo_right):
        if is_asked:
            problems.append(
                "A stereo pair takes two topics: name them with --topic stereo_left=TOPIC --topic stereo_right=TOPIC."
            )
        stereo_left = stereo_right = ()
    image = pick(
        "image",
        lambda: [t for t in colour if t not in (*stereo_left, *stereo_right)] or stereo_left,
    )
    pose = pick("pose", lambda: _pose_topic(kinds, (*depth, *lidar, *image), problems, notes))
    meanings = pick(
        "label_info", lambda: sorted(t for t, kind in kinds.items() if _is_label_info(t, kind))
    )
    transforms = sorted(t for t, kind in kinds.items() if kind in _TRANSFORMS)
    notes += _packets(streams)
    imu = pick("imu", lambda: _preferred([t for t, kind in kinds.items() if kind == "imu"]))
    gnss = pick("gnss", lambda: sorted(t for t, kind in kinds.items() if kind in _FIXES)[:1])
    # --topic pose=/fix: poses are to be made of the fixes
    if any(kinds.get(topic) in _FIXES for topic in pose):
        gnss = pose
    return Roles(
        lidar=lidar, depth=depth, image=image, camera_info=infos, label_image=labels, label_info=meanings,
        stereo_left=next(iter(stereo_left), None), stereo_right=next(iter(stereo_right), None),
        pose=next(iter(pose), None), imu=next(iter(imu), None), gnss=next(iter(gnss), None),
        tf=chosen.get("tf", tuple(t for t in transforms if not t.endswith("tf_static"))),
        tf_static=chosen.get("tf_static", tuple(t for t in transforms if t.endswith("tf_static"))),
        info_of=_infos((*depth, *image, *labels), (*stereo_left, *stereo_right), infos, forced="camera_info" in chosen),
        label_of=_match((*depth, *stereo_left), labels, forced="label_image" in chosen),
        names_of=_match_meanings(labels, lidar, meanings, forced="label_info" in chosen),
        problems=tuple(problems), notes=tuple(notes),
    )  # fmt: skip


def no_sensor(streams: Sequence[Stream]) -> str:
    """Why a log without LIDAR, depth and stereo pair cannot be fused, and what to name."""
    listed = (
        ", ".join(f"{s.topic} ({s.type or 'unknown type'})" for s in streams if s.count) or "none"
    )
    if packets := _packets(streams):
        return " ".join(packets)
    return (
        f"There is no LIDAR and no depth stream, nor a stereo pair; its topics are {listed}; name one with --topic lidar=TOPIC, "
        f"--topic depth=TOPIC, or --topic stereo_left=TOPIC --topic stereo_right=TOPIC."
    )


def _packets(streams: Sequence[Stream]) -> list[str]:
    """Sentences about LIDAR data that are recorded in a form that only its driver reads."""
    return [
        f"{s.topic} holds {s.type}, packets or packed points of a LIDAR that only its driver reads: "
        f"run the driver on it and record the PointCloud2 that it publishes."
        for s in streams
        if s.count and _PACKETS.search(_kind(s.type))
    ]


def _kind(message_type: str) -> str:
    last = re.split(r"[/.]", message_type)[-1].lower()
    return "livox" if last == "custommsg" and message_type.startswith("livox") else last


def _overrides(
    streams: Sequence[Stream], overrides: Mapping[str, str]
) -> dict[str, tuple[str, ...]]:
    types = {s.topic: s.type for s in streams}
    names = {topic.lstrip("/"): topic for topic in types}
    listed = (
        ", ".join(f"{topic} ({types[topic] or 'unknown type'})" for topic in sorted(types))
        or "none"
    )
    chosen: dict[str, tuple[str, ...]] = {}
    for role, value in overrides.items():
        if role not in ROLES:
            raise RoleError(
                f"--topic {role}={value}: there is no role '{role}'; the roles are {', '.join(ROLES)}."
            )
        if value.strip().lower() in ("", "none"):
            chosen[role] = ()
            continue
        topics = []
        for wanted in (part.strip() for part in value.split(",")):
            topic = wanted if wanted in types else names.get(wanted.lstrip("/"))
            if topic is None:
                raise RoleError(
                    f"--topic {role}={value}: the log has no topic '{wanted}'; its topics are {listed}."
                )
            if types[topic] and _kind(types[topic]) not in _TYPES_OF_ROLE[role]:
                raise RoleError(
                    f"--topic {role}={value}: messages of type {types[topic]} cannot be the {role}; the topics are {listed}."
                )
            topics.append(topic)
        if role in _SINGLE and len(topics) > 1:
            raise RoleError(
                f"--topic {role}={value}: the role '{role}' takes one topic, not {len(topics)}."
            )
        chosen[role] = tuple(dict.fromkeys(topics))
    return chosen


def stem(topic: str) -> str:
    """The picture's topic without the transport that it was recorded through: /a/image/compressed
    -> /a/image.
    """
    parent, _, last = topic.rpartition("/")
    return parent if last.lower() in _TRANSPORTS and parent else topic


def _one_transport(topics: Sequence[str]) -> list[str]:
    """The same picture recorded through several transports counts once, the lossless one."""
    best: dict[str, str] = {}
    for topic in topics:
        if topic.lower().endswith(("/theora", "/ffmpeg")):
            continue
        if stem(topic) not in best or topic == stem(topic):
            best[stem(topic)] = topic
    return sorted(best.values())


def _is_label(topic: str) -> bool:
    name = topic.lower()
    words = _LABEL.search(name)
    return (
        words is not None
        and not _PAINTED.search(name[words.start() :])
        and not _PAINTED.search(stem(name).rpartition("/")[2])
    )


def _is_label_info(topic: str, kind: str) -> bool:
    return kind == "labelinfo" or (kind == "string" and topic.endswith("/label_space"))


def _match_meanings(
    labels: Sequence[str], lidar: Sequence[str], meanings: Sequence[str], *, forced: bool
) -> dict[str, str]:
    """As :func:`_match`; where there are label images, a LIDAR has only what stands in its own
    namespace.
    """
    of_lidar = _match(lidar, meanings, forced=forced and not labels)
    return _match(labels, meanings, forced=forced) | {
        t: m for t, m in of_lidar.items() if not labels or _shared(t, m)
    }


def _depth_topics(pictures: Sequence[str], labels: Sequence[str]) -> list[str]:
    """One depth topic for each camera: registered to colour where labels are in colour, as measured
    otherwise.
    """
    groups: dict[str, list[str]] = {}
    for topic in pictures:
        if (
            topic not in labels
            and _DEPTH.search(topic.lower())
            and not re.search(r"confidence|infra", topic.lower())
        ):
            groups.setdefault(
                _DEPTH.split(topic.lower(), maxsplit=1)[0].removesuffix("aligned_"), []
            ).append(topic)
    return [
        min(group, key=lambda t: (("aligned" in t or "registered" in t) != bool(labels), t))
        for _, group in sorted(groups.items())
    ]


def _stereo(
    colour: Sequence[str], chosen: Mapping[str, tuple[str, ...]]
) -> tuple[list[str], list[str]]:
    """The first pair of topics that differ only in left and right, and has what the user named of
    it.

    Raw pictures come before rectified ones, whose CameraInfo says less, and grey ones before the
    same in colour.
    """
    for left_word, right_word in _LEFT_RIGHT:
        for topic in sorted(colour, key=lambda t: ("rect" in t, "color" in t or "colour" in t, t)):
            partner = topic.replace(left_word, right_word)
            is_wanted = all(
                t in chosen.get(role, (t,))
                for role, t in (("stereo_left", topic), ("stereo_right", partner))
            )
            if partner != topic and partner in colour and is_wanted:
                return [topic], [partner]
    return [], []


def _lidar_topics(clouds: Sequence[str], depth: Sequence[str], notes: list[str]) -> list[str]:
    """All clouds that a sensor measures: not maps, not what others derived from them, not a depth
    image once more.
    """
    cameras = {_DEPTH.split(t.lower(), maxsplit=1)[0] for t in depth}
    kept = []
    for topic in sorted(clouds):
        name = topic.lower()
        is_depth_again = (
            _DEPTH.search(name)
            and _DEPTH.split(name, maxsplit=1)[0].removesuffix("aligned_") in cameras
        )
        base = next(
            (o for o in clouds if o != topic and re.match(re.escape(o) + r"[/_]", topic)), None
        )
        words = set(re.split(r"[/_]", name))
        is_derived = bool(words & _DERIVED_CLOUD) and "body" not in words
        if is_depth_again or base or is_derived:
            notes.append(
                f"{topic} is left out: its name says that it is derived from other data; --topic lidar={topic} uses it."
            )
        else:
            kept.append(topic)
    return kept


def _pose_topic(
    kinds: Mapping[str, str], sensors: Sequence[str], problems: list[str], notes: list[str]
) -> list[str]:
    def rank(topic: str) -> tuple[int, int, int]:
        name = topic.lower()
        near = max((_shared(topic, sensor) for sensor in sensors), default=0)
        quality = 1 if _REFERENCE_POSE.search(name) else -1 if _FILTERED_POSE.search(name) else 0
        return _POSES[kinds[topic]], quality, -near if kinds[topic] == "posestamped" else 0

    candidates = sorted(
        t for t, kind in kinds.items() if kind in _POSES and not _NOT_A_POSE.search(t.lower())
    )
    if not candidates:
        return []
    best = min(rank(t) for t in candidates)
    winners = [t for t in candidates if rank(t) == best]
    if len(winners) > 1:
        flags = " or ".join(f"--topic pose={t}" for t in winners)
        problems.append(
            f"{len(winners)} streams could be the pose of the vehicle: choose one with {flags}."
        )
        return []
    if len(candidates) > 1:
        others = ", ".join(t for t in candidates if t != winners[0])
        notes.append(
            f"{winners[0]} is taken as the pose stream rather than {others}; --topic pose=TOPIC chooses another."
        )
    return winners


def _preferred(imus: Sequence[str]) -> list[str]:
    return sorted(imus, key=lambda t: ("raw" in t.lower(), len(t), t))[:1]


def _infos(
    pictures: Sequence[str], pair: Sequence[str], infos: Sequence[str], *, forced: bool
) -> dict[str, str]:
    """CameraInfo topic of each picture; the two cameras of a pair never share one, it is that of
    the nearer name.
    """
    found = _match((*pictures, *pair), infos, forced=forced)
    if len(pair) == 2 and pair[0] in found and found[pair[0]] == found.get(pair[1]):
        left, right = ((_shared(t, found[t]), _shared_words(t, found[t])) for t in pair)
        del found[pair[0] if right > left else pair[1]]
    return found


def _match(topics: Iterable[str], partners: Sequence[str], *, forced: bool) -> dict[str, str]:
    """For each topic the partner that shares most of its namespace, then most words; one that
    shares nothing only if it is alone.
    """
    found = {}
    for topic in topics:
        ranked = sorted(partners, key=lambda p: (-_shared(topic, p), -_shared_words(topic, p), p))
        if ranked and (
            forced
            or len(ranked) == 1
            or _shared(topic, ranked[0])
            or _shared_words(topic, ranked[0])
        ):
            found[topic] = ranked[0]
    return found


def _shared(a: str, b: str) -> int:
    """Leading path elements that two topics share."""
    count = 0
    for x, y in zip(stem(a).strip("/").split("/"), stem(b).strip("/").split("/"), strict=False):
        if x != y:
            break
        count += 1
    return count


def _shared_words(a: str, b: str) -> int:
    return len(
        set(re.split(r"[/_]", a.lower().strip("/")))
        & (set(re.split(r"[/_]", b.lower().strip("/"))) - {"camera", "info", "image"})
    )

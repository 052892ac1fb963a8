"""Message types that can play a role, and the roles that the user chose."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from semloc_logs.errors import TopicError
from semloc_logs.logs.log import Stream
from semloc_logs.logs.problems import Problem, ProblemKind, sentences

ROLES = (
    "lidar", "depth", "image", "camera_info", "stereo_left", "stereo_right", "label_image",
    "label_info", "pose", "tf", "tf_static", "imu", "gnss",
)  # fmt: skip
SINGLE = ("stereo_left", "stereo_right", "pose", "imu", "gnss")  # roles of one topic

# Message types by their last part: sensor_msgs/msg/PointCloud2, foxglove.PointCloud,
# tf/msg/tfMessage ...
CLOUDS = {"pointcloud2", "pointcloud", "livox"}
# raw data of a driver, or points packed by a codec
_PACKETS = re.compile(
    r"velodynescan|velodynepacket|packetmsg|pandarscan|udppacket|udpframe|rslidarscan|rslidarpacket"
    r"|nebulapackets?|compressedpointcloud2?$"
)
SCANS = {"laserscan", "multiecholaserscan"}  # in one plane
_MOST_NAMED = 4  # topics in a sentence
IMAGES = {"image", "compressedimage", "rawimage"}
CAMERAS = {"camerainfo", "cameracalibration"}
TRANSFORMS = {"tfmessage", "frametransform", "frametransforms"}
# rank of types, best first: an Odometry names its child frame, a PoseStamped does not
POSES = {
    "odometry": 0,
    "posewithcovariancestamped": 1,
    "posestamped": 2,
    "poseinframe": 2,
    "transformstamped": 3,
}
FIXES = {"navsatfix", "locationfix"}
_TYPES_OF_ROLE: dict[str, set[str]] = {
    "lidar": CLOUDS,
    "depth": IMAGES,
    "image": IMAGES,
    "camera_info": CAMERAS,
    "stereo_left": IMAGES,
    "stereo_right": IMAGES,
    "label_image": IMAGES,
    "label_info": {"labelinfo", "string"},
    "pose": set(POSES) | TRANSFORMS | FIXES,
    "tf": TRANSFORMS,
    "tf_static": TRANSFORMS,
    "imu": {"imu"},
    "gnss": FIXES,
}
_USED_KINDS = frozenset().union(*_TYPES_OF_ROLE.values())
_FEW = 10  # a stream with so many times fewer messages than another of its topic is not preferred


def no_sensor(streams: Sequence[Stream]) -> str:
    """Why a log without LIDAR, depth and stereo pair cannot be fused, and which topic to name."""
    if undecoded := packets(streams):
        return " ".join(sentences(undecoded))
    recorded = [s for s in streams if s.count]
    clouds = [s.topic for s in recorded if kind_of(s.type) in CLOUDS]
    pictures = [s.topic for s in recorded if kind_of(s.type) in IMAGES]
    ways = [f"--topic lidar={topic}" for topic in clouds[:_MOST_NAMED]]
    if pictures:
        ways.append(
            "--topic depth=TOPIC, or --topic stereo_left=TOPIC --topic stereo_right=TOPIC, with "
            f"the topics of pictures ({', '.join(pictures[:_MOST_NAMED])})"
        )
    scans = [s for s in recorded if kind_of(s.type) in SCANS]
    remedy = f"name one with {', or '.join(ways)}" if ways else "record clouds or depth images"
    if scans:
        return f"{_topics(scans)} is a 2-D scan, and a 2-D scan cannot be mapped: {remedy}."
    return (
        f"No topic is a LIDAR, depth images or a stereo pair; its topics are {_topics(recorded)}; "
        f"{remedy}."
    )


def packets(streams: Sequence[Stream]) -> list[Problem]:
    """LIDAR data in a form that only its driver reads."""
    return [
        Problem(
            s.topic,
            ProblemKind.ROLE,
            f"{s.topic} holds {s.type}, packets or packed points of a LIDAR that only its driver "
            f"reads: run the driver on it and record the PointCloud2 that it publishes.",
            lost=False,
        )
        for s in streams
        if s.count and _PACKETS.search(kind_of(s.type))
    ]


def _topics(streams: Iterable[Stream]) -> str:
    return ", ".join(f"{s.topic} ({s.type or 'unknown type'})" for s in streams) or "none"


def kind_of(message_type: str) -> str:
    """The last part of a type, in lower case; ``livox`` for the CustomMsg of its drivers."""
    last = re.split(r"[/.]", message_type)[-1].lower()
    return "livox" if last == "custommsg" and message_type.startswith("livox") else last


@dataclass(frozen=True)
class Choice:
    """What the user chose: ``topics`` by role, none for a role that is left out.

    ``streams``: the stream of each of them; ``decided``: topics with one stream that fits
    the choice. ``pose_frame``: a frame that the poses of the pose topic must name.
    """

    topics: dict[str, tuple[str, ...]]
    streams: dict[str, Stream]
    decided: frozenset[str]
    pose_frame: str = ""


def read_choice(streams: Sequence[Stream], overrides: Mapping[str, str]) -> Choice:
    """The choice by ``overrides``: role -> TOPIC, TOPIC:TYPE, TOPIC:ENCODING, or several of them.

    For poses also TOPIC:FRAME.
    """
    topics: dict[str, tuple[str, ...]] = {}
    chosen: dict[str, Stream] = {}
    decided: set[str] = set()
    pose_frame = ""
    for role, value in overrides.items():
        flag = f"--topic {role}={value}"
        if role not in ROLES:
            raise TopicError(
                f"{flag}: the role '{role}' is unknown; the roles are {', '.join(ROLES)}."
            )
        role_topics = []
        for wanted in _parts(value):
            topic, rest = _split(streams, wanted, flag)
            candidates = _that_can(role, streams, topic, flag)
            narrowed = [s for s in candidates if rest in ("", s.type, s.encoding)]
            if not narrowed and role == "pose":
                pose_frame = rest
            elif not narrowed:
                raise TopicError(f"{flag}: {topic} has no such messages, but {_kinds(candidates)}.")
            chosen.setdefault(topic, best_stream(narrowed or candidates))
            if len(narrowed) == 1:
                decided.add(topic)
            role_topics.append(topic)
        if role in SINGLE and len(role_topics) > 1:
            raise TopicError(f"{flag}: the role '{role}' takes one topic, not {len(role_topics)}.")
        topics[role] = tuple(dict.fromkeys(role_topics))
    return Choice(topics, chosen, frozenset(decided), pose_frame)


def _parts(value: str) -> list[str]:
    """The topics that a value names."""
    parts = [part.strip() for part in value.split(",")]
    return [] if parts == [""] or value.strip().lower() == "none" else parts


def _split(streams: Sequence[Stream], wanted: str, flag: str) -> tuple[str, str]:
    """The topic that the log has, and what follows it after a colon."""
    topics = sorted({s.topic for s in streams}, key=len, reverse=True)
    # as it is spelled, or with and without a slash in front
    for name, spelled in ((wanted, str), (wanted.lstrip("/"), _without_slash)):
        for topic in topics:
            if name == spelled(topic):
                return topic, ""
            if name.startswith(f"{spelled(topic)}:"):
                return topic, name[len(spelled(topic)) + 1 :]
    listed = _topics(sorted(streams, key=lambda s: s.topic))
    raise TopicError(f"{flag}: the log has no topic '{wanted}'; its topics are {listed}.")


def _without_slash(topic: str) -> str:
    return topic.lstrip("/")


def _that_can(role: str, streams: Sequence[Stream], topic: str, flag: str) -> list[Stream]:
    """The streams of a topic that can play a role, also the ones of unknown type."""
    of_topic = [s for s in streams if s.topic == topic]
    able = [s for s in of_topic if not s.type or kind_of(s.type) in _TYPES_OF_ROLE[role]]
    if not able:
        scans = [s for s in of_topic if kind_of(s.type) in SCANS]
        if scans and role in ("lidar", "depth"):
            raise TopicError(
                f"{flag}: {topic} is a {scans[0].type}, and a 2-D scan cannot be mapped."
            )
        types = " or ".join(sorted({s.type for s in of_topic}))
        listed = _topics(sorted(streams, key=lambda s: s.topic))
        raise TopicError(
            f"{flag}: messages of type {types} cannot be the {role}; the topics are {listed}."
        )
    return able


def best_stream(streams: Sequence[Stream]) -> Stream:
    """The stream of a topic that is used: of a type that plays a role, the best of them.

    The better type of poses, unless it has very few of the messages; else the most messages.
    """
    usable = [s for s in streams if kind_of(s.type) in _USED_KINDS] or streams
    most = max(s.count for s in usable)

    def rank(s: Stream) -> tuple[bool, int, int, str, str]:
        has_few = s.count * _FEW < most
        return has_few, POSES.get(kind_of(s.type), 0), -s.count, s.type, s.encoding

    return min(usable, key=rank)


def left_out_streams(
    streams: Sequence[Stream], used: Mapping[str, Stream], decided: Collection[str]
) -> tuple[frozenset[tuple[str, str, str]], list[Problem]]:
    """The streams of topics that have several and that are not ``used``; the problems name them.

    Topics whose stream the user has ``decided`` need no naming.
    """
    left_out = set()
    problems = []
    for topic, kept in used.items():
        others = [s for s in streams if s.topic == topic and s != kept and s.count]
        for other in others:
            encoding = other.encoding if other.type == kept.type else ""
            left_out.add((topic, other.type, encoding))
        if others and topic not in decided:
            problems.append(_several(kept, others))
    return frozenset(left_out), problems


def _several(kept: Stream, others: Sequence[Stream]) -> Problem:
    """The problem of a topic with messages of several types or encodings."""
    text = (
        f"{kept.topic} has messages of {len(others) + 1} kinds: {_kinds([kept])} are used, "
        f"{_kinds(others)} are not"
    )
    # a type that plays no role is not missed
    usable = [s for s in others if kind_of(s.type) in _USED_KINDS]
    if usable:
        kind = kind_of(usable[0].type)
        role = next(r for r, kinds in _TYPES_OF_ROLE.items() if kind in kinds)
        end = usable[0].encoding if usable[0].type == kept.type else usable[0].type
        text += f"; --topic {role}={kept.topic}:{end} chooses them"
    return Problem(kept.topic, ProblemKind.ROLE, f"{text}.", lost=False, assumed=bool(usable))


def _kinds(streams: Sequence[Stream]) -> str:
    return ", ".join(f"{s.count} of {s.type or 'unknown type'} ({s.encoding})" for s in streams)

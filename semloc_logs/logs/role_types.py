"""Message types that can play a role, and the roles that the user chose."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

from semloc_logs.errors import RoleError
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
        return f"{_listed(scans)} is a 2-D scan, and a 2-D scan cannot be mapped: {remedy}."
    return (
        f"No topic is a LIDAR, depth images or a stereo pair; its topics are {_listed(recorded)}; "
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


def _listed(streams: Iterable[Stream]) -> str:
    return ", ".join(f"{s.topic} ({s.type or 'unknown type'})" for s in streams) or "none"


def kind_of(message_type: str) -> str:
    """The last part of a type, in lower case; ``livox`` for the CustomMsg of its drivers."""
    last = re.split(r"[/.]", message_type)[-1].lower()
    return "livox" if last == "custommsg" and message_type.startswith("livox") else last


def chosen_topics(
    streams: Sequence[Stream], overrides: Mapping[str, str]
) -> dict[str, tuple[str, ...]]:
    """The topics of the roles that the user chose; none for a role that is left out."""
    return {role: _override(streams, role, value) for role, value in overrides.items()}


def _override(streams: Sequence[Stream], role: str, value: str) -> tuple[str, ...]:
    flag = f"--topic {role}={value}"
    if role not in ROLES:
        raise RoleError(f"{flag}: the role '{role}' is unknown; the roles are {', '.join(ROLES)}.")
    if value.strip().lower() in ("", "none"):
        return ()
    stream_of = {s.topic: s for s in streams}
    names = {topic.lstrip("/"): topic for topic in stream_of}
    listed = _listed(stream_of[topic] for topic in sorted(stream_of))
    topics = []
    for wanted in (part.strip() for part in value.split(",")):
        topic = wanted if wanted in stream_of else names.get(wanted.lstrip("/"))
        if topic is None:
            raise RoleError(f"{flag}: the log has no topic '{wanted}'; its topics are {listed}.")
        type_ = stream_of[topic].type
        if kind_of(type_) in SCANS and role in ("lidar", "depth"):
            raise RoleError(f"{flag}: {topic} is a {type_}, and a 2-D scan cannot be mapped.")
        if type_ and kind_of(type_) not in _TYPES_OF_ROLE[role]:
            raise RoleError(
                f"{flag}: messages of type {type_} cannot be the {role}; the topics are {listed}."
            )
        topics.append(topic)
    if role in SINGLE and len(topics) > 1:
        raise RoleError(f"{flag}: the role '{role}' takes one topic, not {len(topics)}.")
    return tuple(dict.fromkeys(topics))

"""Roles of topics, guessed by message type and name; ``--topic ROLE=TOPIC`` overrules."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from semloc_logs.errors import RoleError
from semloc_logs.logs.log import Stream
from semloc_logs.logs.problems import Problem, ProblemKind, sentences
from semloc_logs.logs.role_types import (
    CAMERAS,
    CLOUDS,
    FIXES,
    IMAGES,
    POSES,
    ROLES,
    SINGLE,
    TRANSFORMS,
    Choice,
    best_stream,
    kind_of,
    left_out_streams,
    packets,
    read_choice,
)
from semloc_logs.logs.topic_pairs import (
    calibrations,
    label_meanings,
    one_transport,
    partners,
    shared,
    stem,
)

# roles that keep a topic which the user gave to another role
_SHARED = ("image", "tf", "tf_static")
OWN_PREFIX = "/semloc/"  # results of an earlier run, never an input

_DEPTH = re.compile(r"depth")
_NOT_DEPTH = re.compile(r"confidence|infra")  # pictures of a depth camera beside its depth
_LABEL = re.compile(r"label|semantic|segment|(^|[/_])(seg|class(es)?)([/_]|$)")
# a label picture for people, not ids
_PAINTED = re.compile(r"colou?r|overlay|rgb|viz|vis(ual|$)|blend")
_DERIVED_CLOUD = {
    "map", "submap", "world", "global", "registered", "aligned", "cluster", "clusters", "object",
    "objects", "obstacle", "obstacles", "feature", "features", "corner", "planar", "surf",
    "keypoints", "radar",
}  # fmt: skip
_NOT_A_POSE = re.compile(
    r"goal|target|setpoint|desired|reference|cmd|command|initial|waypoint|plan|object|marker|tag"
    r"|clicked|landing"
)
_REFERENCE_POSE = re.compile(r"truth|(^|[/_])gt([/_]|$)|wheel|controller|gps|gnss|imu|raw")
_FILTERED_POSE = re.compile(r"filtered|fused|ekf|ukf")
_LEFT_RIGHT = (
    ("left", "right"),
    ("cam0", "cam1"),
    ("cam_0", "cam_1"),
    ("infra1", "infra2"),
    ("image_00", "image_01"),
    ("image_02", "image_03"),
    ("image_0", "image_1"),
    ("image_2", "image_3"),
    ("camera_0", "camera_1"),
    ("camera0", "camera1"),
)


@dataclass(frozen=True)
class Roles:
    """Topics by role.

    ``info_of`` names the CameraInfo topic of a picture's topic, ``label_of`` the label image of a
    depth topic, ``names_of`` the topic with the meaning of the labels of a label image or a LIDAR.
    ``problems`` are choices that only the user can make; ``notes`` are choices that were made.
    ``left_out``: streams of these topics that are not read, as in Reading. ``pose_frame``: a frame
    that the poses must name, "" for any.
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
    problems: tuple[Problem, ...] = ()
    notes: tuple[Problem, ...] = ()
    left_out: frozenset[tuple[str, str, str]] = frozenset()
    pose_frame: str = ""

    @property
    def ranging(self) -> tuple[str, ...]:
        """The topics whose frames become clouds: LIDAR, depth, left picture of a stereo pair."""
        has_pair = self.stereo_left is not None and self.stereo_right is not None
        return (*self.lidar, *self.depth, *(self.topics("stereo_left") if has_pair else ()))

    def topics(self, role: str) -> tuple[str, ...]:
        """The topics of a role, none or several."""
        value = getattr(self, role)
        if value is None:
            return ()
        return value if isinstance(value, tuple) else (value,)

    def role_of(self, topic: str) -> str | None:
        """The role that ``topic`` plays; None when it is not used.

        A stereo picture that serves as image is called stereo.
        """
        order = ("stereo_left", "stereo_right", *ROLES)
        return next((role for role in order if topic in self.topics(role)), None)

    def role_of_stream(self, stream: Stream) -> str | None:
        """As :meth:`role_of`; None for a stream that is not read, whatever its topic is."""
        key = (stream.topic, stream.type)
        is_left_out = (*key, stream.encoding) in self.left_out or (*key, "") in self.left_out
        return None if is_left_out else self.role_of(stream.topic)

    def to_json(self) -> dict[str, object]:
        """Role -> list of topics, without roles that no topic plays."""
        return {role: list(self.topics(role)) for role in ROLES if self.topics(role)}


def find_roles(streams: Sequence[Stream], overrides: Mapping[str, str] | None = None) -> Roles:
    """The roles of ``streams``, as :func:`guess_roles`.

    RoleError with the flags that solve it when roles are ambiguous.
    """
    roles = guess_roles(streams, overrides)
    if roles.problems:
        raise RoleError(" ".join(sentences(roles.problems)))
    return roles


def guess_roles(streams: Sequence[Stream], overrides: Mapping[str, str] | None = None) -> Roles:
    """The roles of ``streams``; an ambiguous role stays empty and is named in ``problems``.

    ``overrides``: role -> topic, several topics separated by commas where a role can have several,
    or ``none`` to leave a role out. RoleError for an unknown role or topic and for a topic whose
    type cannot play the role.
    """
    guess = _Guess(streams, read_choice(streams, overrides or {}))
    for role, rule in _RULES:
        guess.assign(role, rule)
    return guess.roles()


class _Guess:
    """Topics of the roles that were assigned so far; ``kinds``: last part of the type by topic.

    ``chosen``: topics by role as the user gave them.
    """

    def __init__(self, streams: Sequence[Stream], choice: Choice) -> None:
        self.chosen = choice.topics
        self._choice = choice
        of_topic: dict[str, list[Stream]] = {}
        for s in streams:
            if s.count > 0 and not s.topic.startswith(OWN_PREFIX):
                of_topic.setdefault(s.topic, []).append(s)
        self._used = {
            topic: choice.streams.get(topic, best_stream(several))
            for topic, several in of_topic.items()
        }
        self.kinds = {topic: kind_of(s.type) for topic, s in self._used.items()}
        self.pictures = one_transport(self.of_kind(IMAGES))
        self.problems: list[Problem] = []
        self.notes: list[Problem] = []
        self._streams = streams
        self._topics: dict[str, tuple[str, ...]] = {}

    def assign(self, role: str, rule: Callable[[_Guess], Iterable[str]]) -> None:
        """Gives a role the topics that the user chose, or else the ones that its rule finds."""
        if role in self.chosen:
            self._topics[role] = self.chosen[role]
            return
        taken = {topic for topics in self.chosen.values() for topic in topics}
        self._topics[role] = tuple(
            topic for topic in rule(self) if topic not in taken or role in _SHARED
        )

    def topics(self, *roles: str) -> tuple[str, ...]:
        """The topics of roles that were assigned before."""
        return tuple(topic for role in roles for topic in self._topics[role])

    def of_kind(self, kinds: set[str]) -> list[str]:
        """The topics of these types, sorted."""
        return sorted(topic for topic, kind in self.kinds.items() if kind in kinds)

    @property
    def colour(self) -> list[str]:
        """Pictures that are neither labels nor depth."""
        others = self.topics("label_image", "depth")
        return [
            topic
            for topic in self.pictures
            if topic not in others
            and not _DEPTH.search(topic.lower())
            and not _LABEL.search(topic.lower())
        ]

    @property
    def is_pair_chosen(self) -> bool:
        """Whether the user named a picture of a stereo pair."""
        return any(self.chosen.get(role) for role in ("stereo_left", "stereo_right"))

    @property
    def pair(self) -> tuple[str, ...]:
        """The stereo pair, left and right; empty unless it has two topics."""
        pair = self.topics("stereo_left", "stereo_right")
        return pair if len(set(pair)) == 2 else ()

    def roles(self) -> Roles:
        """The roles, once all are assigned."""
        topics = self._topics
        pose = topics["pose"]
        self._keep_one_robot()
        has_pose_of_fixes = any(self.kinds.get(topic) in FIXES for topic in pose)
        gnss = pose if has_pose_of_fixes else topics["gnss"]
        left_out, several = left_out_streams(self._streams, self._used, self._choice.decided)
        return Roles(
            lidar=topics["lidar"],
            depth=topics["depth"],
            image=topics["image"],
            camera_info=topics["camera_info"],
            stereo_left=self.pair[0] if self.pair else None,
            stereo_right=self.pair[1] if self.pair else None,
            label_image=topics["label_image"],
            label_info=topics["label_info"],
            pose=next(iter(pose), None),
            tf=topics["tf"],
            tf_static=topics["tf_static"],
            imu=next(iter(topics["imu"]), None),
            gnss=next(iter(gnss), None),
            info_of=calibrations(
                self.topics("depth", "image", "label_image"),
                self.pair,
                topics["camera_info"],
                forced="camera_info" in self.chosen,
            ),
            label_of=partners(
                (*topics["depth"], *self.pair[:1]),
                topics["label_image"],
                forced="label_image" in self.chosen,
            ),
            names_of=label_meanings(
                topics["label_image"],
                topics["lidar"],
                topics["label_info"],
                forced="label_info" in self.chosen,
            ),
            problems=(*self._pair_problems(), *self.problems),
            notes=(*several, *self.notes, *packets(self._streams)),
            left_out=left_out,
            pose_frame=self._choice.pose_frame,
        )

    def _keep_one_robot(self) -> None:
        """Leaves out sensors of other robots: in a namespace that has poses of its own."""
        own = "".join(_namespace(topic) for topic in self._topics["pose"])
        poses = [t for t in self.of_kind(set(POSES)) if not _NOT_A_POSE.search(t.lower())]
        others = {_namespace(topic) for topic in poses} - {own, ""}
        for role in ("lidar", "depth", "imu", "gnss"):
            topics = self._topics[role]
            foreign = [topic for topic in topics if _namespace(topic) in others]
            of_kind = self.of_kind({self.kinds[topic] for topic in topics})
            rest = [topic for topic in topics if topic not in foreign] or [
                topic for topic in of_kind if role in SINGLE and _namespace(topic) == own
            ]
            has_own = own and any(_namespace(topic) == own for topic in rest)
            if role in self.chosen or not foreign or not has_own:
                continue
            self._topics[role] = tuple(rest[:1] if role in SINGLE else rest)
            text = (
                f"{', '.join(foreign)}: left out, because the poses are of '{own}' and "
                f"'{_namespace(foreign[0])}' has poses of its own, as another robot; "
                f"--topic {role}=TOPIC uses them."
            )
            self.notes.append(Problem(foreign[0], ProblemKind.ROLE, text, lost=False))

    def _pair_problems(self) -> list[Problem]:
        if not self.is_pair_chosen or self.pair:
            return []
        text = (
            "A stereo pair takes two topics: name them with --topic stereo_left=TOPIC "
            "--topic stereo_right=TOPIC."
        )
        return [Problem("", ProblemKind.ROLE, text, lost=False)]


def _namespace(topic: str) -> str:
    """The first part of a topic that has several; "" of another."""
    parts = topic.strip("/").split("/")
    return parts[0] if len(parts) > 1 else ""


# -- rules: the topics of a role, given the roles before it


def _label_images(guess: _Guess) -> list[str]:
    return [topic for topic in guess.pictures if _is_label(topic)]


def _is_label(topic: str) -> bool:
    name = topic.lower()
    word = _LABEL.search(name)
    return (
        word is not None
        and not _PAINTED.search(name[word.start() :])
        and not _PAINTED.search(stem(name).rpartition("/")[2])
    )


def _depth_images(guess: _Guess) -> list[str]:
    """One depth topic for each camera.

    Registered to colour where there are labels, which are in colour, as measured otherwise.
    """
    labels = guess.topics("label_image")
    by_camera: dict[str, list[str]] = {}
    for topic in guess.pictures:
        name = topic.lower()
        if topic not in labels and _DEPTH.search(name) and not _NOT_DEPTH.search(name):
            by_camera.setdefault(_camera_of_depth(name), []).append(topic)

    def rank(topic: str) -> tuple[bool, str]:
        is_registered = "aligned" in topic or "registered" in topic
        return is_registered != bool(labels), topic

    return [min(topics, key=rank) for _, topics in sorted(by_camera.items())]


def _camera_of_depth(name: str) -> str:
    return _DEPTH.split(name, maxsplit=1)[0].removesuffix("aligned_")


def _lidar(guess: _Guess) -> list[str]:
    """All clouds that a sensor measures: not maps, derived clouds or a depth image once more."""
    clouds = guess.of_kind(CLOUDS)
    cameras = {_DEPTH.split(t.lower(), maxsplit=1)[0] for t in guess.topics("depth")}
    measured = []
    for topic in clouds:
        name = topic.lower()
        is_depth_again = _DEPTH.search(name) and _camera_of_depth(name) in cameras
        extends_another = any(topic.startswith((other + "/", other + "_")) for other in clouds)
        name_words = set(re.split(r"[/_]", name))
        is_derived = bool(name_words & _DERIVED_CLOUD) and "body" not in name_words
        if is_depth_again or extends_another or is_derived:
            text = (
                f"{topic} is left out: by its name it is derived from other data; "
                f"--topic lidar={topic} uses it."
            )
            guess.notes.append(Problem(topic, ProblemKind.ROLE, text, lost=False))
        else:
            measured.append(topic)
    return measured


def _stereo_left(guess: _Guess) -> list[str]:
    return [left for left, _ in _stereo_pair(guess)]


def _stereo_right(guess: _Guess) -> list[str]:
    return [right for _, right in _stereo_pair(guess)]


def _stereo_pair(guess: _Guess) -> list[tuple[str, str]]:
    """The first pair of topics that differ only in left and right, if there is one.

    Beside other range sensors only if the user named a part of it. Raw pictures come before
    rectified ones, whose CameraInfo has less, and grey ones before the same in colour.
    """
    if not guess.is_pair_chosen and guess.topics("lidar", "depth"):
        return []
    colour = guess.colour

    def rank(topic: str) -> tuple[bool, bool, str]:
        return "rect" in topic, "color" in topic or "colour" in topic, topic

    for left_word, right_word in _LEFT_RIGHT:
        for left in sorted(colour, key=rank):
            right = left.replace(left_word, right_word)
            is_wanted = left in guess.chosen.get("stereo_left", (left,)) and (
                right in guess.chosen.get("stereo_right", (right,))
            )
            if right != left and right in colour and is_wanted:
                return [(left, right)]
    return []


def _images(guess: _Guess) -> Sequence[str]:
    """Colour pictures beside a stereo pair, or else its left picture."""
    beside = [topic for topic in guess.colour if topic not in guess.pair]
    return beside or guess.pair[:1]


def _pose(guess: _Guess) -> list[str]:
    """The best pose stream: by type, name, and for a PoseStamped nearness to a sensor's name."""
    sensors = guess.topics("depth", "lidar", "image")

    def rank(topic: str) -> tuple[int, int, int]:
        name = topic.lower()
        kind = guess.kinds[topic]
        quality = 1 if _REFERENCE_POSE.search(name) else -1 if _FILTERED_POSE.search(name) else 0
        nearness = max((shared(topic, sensor) for sensor in sensors), default=0)
        return POSES[kind], quality, -nearness if kind == "posestamped" else 0

    candidates = [t for t in guess.of_kind(set(POSES)) if not _NOT_A_POSE.search(t.lower())]
    if not candidates:
        return []
    best = min(rank(topic) for topic in candidates)
    winners = [topic for topic in candidates if rank(topic) == best]
    if len(winners) > 1:
        flags = " or ".join(f"--topic pose={topic}" for topic in winners)
        text = f"{len(winners)} streams could be the pose of the vehicle: choose one with {flags}."
        guess.problems.append(Problem("", ProblemKind.ROLE, text, lost=False))
        return []
    if len(candidates) > 1:
        others = ", ".join(topic for topic in candidates if topic != winners[0])
        text = (
            f"{winners[0]} is taken as the pose stream rather than {others}; "
            f"--topic pose=TOPIC chooses another."
        )
        guess.notes.append(Problem(winners[0], ProblemKind.ROLE, text, lost=False))
    return winners


def _label_info(guess: _Guess) -> list[str]:
    return sorted(
        topic
        for topic, kind in guess.kinds.items()
        if kind == "labelinfo" or (kind == "string" and topic.endswith("/label_space"))
    )


def _imu(guess: _Guess) -> list[str]:
    """One IMU: not the raw one, the shortest name."""
    imus = guess.of_kind({"imu"})
    return sorted(imus, key=lambda topic: ("raw" in topic.lower(), len(topic), topic))[:1]


def _transforms(guess: _Guess, *, static: bool) -> list[str]:
    return [t for t in guess.of_kind(TRANSFORMS) if t.endswith("tf_static") == static]


# in this order: a rule sees the roles above it
_RULES: tuple[tuple[str, Callable[[_Guess], Iterable[str]]], ...] = (
    ("camera_info", lambda guess: guess.of_kind(CAMERAS)),
    ("label_image", _label_images),
    ("depth", _depth_images),
    ("lidar", _lidar),
    ("stereo_left", _stereo_left),
    ("stereo_right", _stereo_right),
    ("image", _images),
    ("pose", _pose),
    ("label_info", _label_info),
    ("tf", lambda guess: _transforms(guess, static=False)),
    ("tf_static", lambda guess: _transforms(guess, static=True)),
    ("imu", _imu),
    ("gnss", lambda guess: guess.of_kind(FIXES)[:1]),
)

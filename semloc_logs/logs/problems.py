"""Problems of a log: lost input and assumptions."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from enum import Enum


class ProblemKind(Enum):
    """What a problem is about."""

    FILE = "file"  # a file of the log is damaged or missing; the text begins with its name
    MESSAGE = "message"  # messages that cannot be read or decoded
    FRAME = "frame"  # decoded frames, or points of them, that are not used
    POINT_TIME = "point time"  # times of the points of a sweep
    CALIBRATION = "calibration"
    LABEL = "label"
    TRANSFORM = "transform"
    POSE = "pose"
    FIT = "fit"  # poses and range data contradict each other, or the poses themselves
    GRAVITY = "gravity"  # which way is up
    ROLE = "role"  # which topic plays which role
    STAMP = "stamp"  # times of messages: missing, or of another clock


@dataclass(frozen=True, slots=True)
class Problem:
    """One problem: ``text`` is a sentence for the user, ``topic`` is "" for the whole log.

    ``lost``: input was lost; ``assumed``: the result rests on an assumption that the log does not
    settle. A command that met either ends with exit code 3.
    """

    topic: str
    kind: ProblemKind
    text: str
    lost: bool
    assumed: bool = False

    @property
    def is_reported(self) -> bool:
        """Whether the command that met the problem ends with exit code 3."""
        return self.lost or self.assumed

    def of_log(self, name: str) -> Problem:
        """The same with the log's ``name`` in front, unless the text names its file itself."""
        if self.kind is ProblemKind.FILE:
            return self
        return replace(self, text=f"{name}: {self.text}")


def sentences(problems: Iterable[Problem]) -> list[str]:
    """The texts, as session.json and ``inspect --json`` list them."""
    return [problem.text for problem in problems]


def lost(problems: Iterable[Problem]) -> list[Problem]:
    """The problems that lost input."""
    return [problem for problem in problems if problem.lost]


def to_report(problems: Iterable[Problem]) -> list[Problem]:
    """The problems for which a command ends with exit code 3."""
    return [problem for problem in problems if problem.is_reported]


def sorted_problems(problems: Iterable[Problem]) -> list[Problem]:
    """Each text once: reported problems first, then the others, otherwise in the given order."""
    first_of_text: dict[str, Problem] = {}
    for problem in sorted(problems, key=lambda p: not p.is_reported):
        first_of_text.setdefault(problem.text, problem)
    return list(first_of_text.values())


def without_loss_of(unused: Collection[str], problems: Iterable[Problem]) -> list[Problem]:
    """The problems; those about the topics ``unused`` lose nothing and assume nothing."""
    return [replace(p, lost=False, assumed=False) if p.topic in unused else p for p in problems]


class NoCloud(Enum):
    """Reason why a frame gives no cloud: its ``key`` in session.json, and the end of a sentence."""

    # a pose is missing; once the pass is over, one of the following tells why
    NO_POSE = ("no pose", "no pose is known at their stamps ({frames})")
    NO_POSES = ("no poses", "the pose stream gave no usable pose")
    BEFORE_POSES = (
        "before the poses",
        "their stamps ({frames}) begin {before} before the first pose ({start}); where their clock "
        "is another, give --set logs.time_offset.{topic}=SECONDS",
    )
    AFTER_POSES = (
        "after the poses",
        "their stamps ({frames}) end {after} after the last pose ({end}); where their clock is "
        "another, give --set logs.time_offset.{topic}=SECONDS",
    )
    POSE_GAP = (
        "pose gap",
        "the poses have {gaps} between their stamps ({frames})",
    )
    LATE_POSE = (
        "late pose",
        "the poses of their stamps ({frames}) were recorded later than frames can wait",
    )
    NO_TRANSFORM = (
        "no transform",
        "no transform leads from their frame '{frame}' to the base frame '{base}': record "
        "/tf_static, give the mounting with --set logs.mountings.{frame}=[x,y,z,qx,qy,qz,qw], or "
        "leave the topic out with --topic",
    )
    TRANSFORM_GAP = (
        "transform gap",
        "the transforms between their frame '{frame}' and the base frame '{base}' have a gap at "
        "their stamps ({frames})",
    )
    NO_CALIBRATION = (
        "no calibration",
        "no CameraInfo belongs to them: record it, or name it with --topic camera_info=TOPIC",
    )
    UNUSABLE_CALIBRATION = ("unusable calibration", "their CameraInfo cannot be used")
    NO_DEPTH = (
        "no depth",
        "they are colour or 8-bit pictures, not depth: choose another topic with "
        "--topic depth=TOPIC",
    )
    NO_RIGHT_CALIBRATION = (
        "no calibration of the right",
        "no CameraInfo belongs to the right camera: record it, or name both by "
        "--topic camera_info=TOPIC,TOPIC",
    )
    NO_PICTURE = (
        "no picture",
        "they are depth images, not pictures: choose another topic with --topic stereo_left=TOPIC",
    )
    NO_PARTNER = (
        "no partner",
        "the right camera has no picture within half a frame period of theirs",
    )
    OTHER_SIZE = ("other size", "the picture of the right camera has another size")
    SAME_PICTURE = (
        "same picture",
        "the right camera has the very same picture: choose two cameras with "
        "--topic stereo_left=TOPIC stereo_right=TOPIC",
    )
    UNUSABLE_PAIR = ("unusable pair", "the calibrations of the pair cannot be used")
    NO_POINTS = ("no points", "they have no points within the range limits")
    BACK_IN_TIME = (
        "back in time",
        "their stamps ({frames}) lie more than a second before the stamp of an earlier frame; "
        "cut the log there, or use the times of recording with --set logs.stamps=log",
    )
    EMPTY = ("empty", "they hold no points, or none whose position is a number")
    # frames of a topic that repeats another topic: nothing is lost, so it has no sentence
    DUPLICATE = ("copy", "")

    def __init__(self, key: str, because: str) -> None:
        self.key = key
        self.because = because


class Problems:
    """Collects problems in the order in which they arise, each once.

    Skipped messages are counted by topic and named once for each topic.
    """

    def __init__(self) -> None:
        self._added: dict[Problem, None] = {}
        self._skipped: dict[tuple[str, str], _Skipped] = {}

    def add(
        self,
        text: str,
        *,
        topic: str = "",
        kind: ProblemKind = ProblemKind.FILE,
        lost: bool = True,
        assumed: bool = False,
    ) -> None:
        """Adds a problem unless it is known; one that is assumed loses nothing."""
        self._added.setdefault(Problem(topic, kind, text, lost and not assumed, assumed))

    def assume(self, text: str, *, topic: str, kind: ProblemKind) -> None:
        """Adds an assumption that the log does not settle, unless it is known."""
        self._added.setdefault(Problem(topic, kind, text, lost=False, assumed=True))

    def skip(self, topic: str, reason: str, *, file: str = "") -> None:
        """Counts one skipped message of ``topic``; the first ``reason`` is the one in the text.

        ``file`` is the file that the message could not be read from; "": it could not be decoded.
        """
        self._skipped.setdefault((file, topic), _Skipped(reason)).count += 1

    def forget_skipped(self, topics: Collection[str] | None, *, file: str = "") -> None:
        """Starts the counts of ``topics`` (None: all) anew, before the messages are met again."""
        for key in list(self._skipped):
            if key[0] == file and (topics is None or key[1] in topics):
                del self._skipped[key]

    def __iter__(self) -> Iterator[Problem]:
        yield from self._added
        for (_, topic), skipped in self._skipped.items():
            yield Problem(topic, ProblemKind.MESSAGE, f"{topic}: {skipped.text()}", lost=True)


@dataclass(slots=True)
class _Skipped:
    reason: str
    count: int = 0

    def text(self) -> str:
        if self.count == 1:
            return f"1 message skipped; {self.reason}."
        return f"{self.count} messages skipped; the first because {self.reason}."

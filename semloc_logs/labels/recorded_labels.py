"""Classes of a session as its log has them: with the points, or in label images."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import U8, U32, Bools
from semloc_logs.errors import LogError
from semloc_logs.frames import ImageFrame, LabelForm, PosedCloud
from semloc_logs.labels.camera_labels import Pictures, PointLabels
from semloc_logs.labels.geometry_labels import GeometryLabels
from semloc_logs.labels.label_check import LEAST_KNOWN, LEAST_OF_LOG, LabelCheck
from semloc_logs.labels.labeller import KeyframeView, unlabelled
from semloc_logs.labels.painted_labels import PaintedLabels, of_camera
from semloc_logs.labels.space import (
    UNLABELLED,
    UNPAINTED,
    LabelSpace,
    guess_palette,
    guess_space,
    read_space,
    space_of_names,
    spaces,
)
from semloc_logs.labels.sweep_ground import GroundSurface
from semloc_logs.logs.problems import Problem, ProblemKind, Problems
from semloc_logs.logs.sensors.depth import label_ids
from semloc_logs.logs.session.session import Session
from semloc_logs.settings import Labels

_MOST_PAIRS = 8  # pairs of keyframes that show whether ids are classes
_MOST_COLOURS = 4096  # that are remembered of one topic, to guess the palette
_HALF = 0xFFFF  # the lower half of an id is the class, the upper an instance (SemanticKITTI)


class _Carrier(Enum):
    """Where the labels of a keyframe come from."""

    NONE = "none"
    CLOUD = "cloud"  # recorded with the points, or with the depth image
    CAMERAS = "cameras"  # painted


class _DecidedBy(Enum):
    """Who decided what the labels of a topic mean."""

    NOBODY = ""
    SETTING = "setting"
    LOG = "log"
    GUESS = "guess"


@dataclass(slots=True, eq=False)
class _Topic:
    """The labels of one topic as far as seen, and their meaning in the end."""

    low: NDArray[np.int64] = field(default_factory=lambda: np.zeros(_HALF + 1, np.int64))
    has_instances: bool = False
    colours: dict[int, int] = field(default_factory=dict)
    is_coloured: bool = False
    space: LabelSpace | None = None
    decided_by: _DecidedBy = _DecidedBy.NOBODY
    strange: dict[int, int] = field(default_factory=dict)
    doubt: str = ""  # why its ids are not classes

    def see(self, ids: U32, is_coloured: bool) -> None:
        values, counts = np.unique(ids[ids != UNPAINTED], return_counts=True)
        self.is_coloured |= is_coloured
        if is_coloured:
            for colour, count in zip(values.tolist(), counts.tolist(), strict=True):
                if colour in self.colours or len(self.colours) < _MOST_COLOURS:
                    self.colours[colour] = self.colours.get(colour, 0) + count
        else:
            np.add.at(self.low, values & _HALF, counts)
            self.has_instances |= bool((values > _HALF).any())

    def is_empty(self) -> bool:
        """Whether nothing but zeros was ever recorded."""
        return not self.low[1:].any() and not self.has_instances and not any(self.colours)

    def known_share(self, space: LabelSpace) -> float:
        """Share of the labelled points whose ids the ``space`` has."""
        ids = np.flatnonzero(self.low)
        ids = ids[(ids != 0) & (ids != UNLABELLED)]
        known = np.isin(ids, np.array([*space.names], np.int64))
        total = int(self.low[ids].sum())
        return float(self.low[ids[known]].sum() / total) if total else 1.0


class RecordedLabels(PaintedLabels):
    """The labels of a log. Where they may also come from geometry (``labels.source=auto``), they do
    if there are none, or none that are classes.
    """

    def __init__(self, settings: Labels, session: Session) -> None:
        self._session = session
        self._topics: dict[str, _Topic] = {}
        # of each keyframe, with the topic of labels that come with the cloud
        self._keyframes: list[tuple[_Carrier, str]] = []
        self._may_be_geometry = settings.source == "auto"
        self._geometry: GeometryLabels | None = None
        topics = tuple(t for t in session.roles.label_image if t in session.roles.info_of)
        pictures = Pictures(session, topics, self._read, settings.erode) if topics else None
        super().__init__(settings, pictures)

    @property
    def source(self) -> str:
        return "log" if self._geometry is None else self._geometry.source

    @property
    def problems(self) -> list[Problem]:
        """Pictures that cannot be used, guessed meanings, and labels without a class."""
        problems = Problems()
        for name, topic in sorted(self._topics.items()):
            if topic.doubt:
                problems.add(_unused(name, topic), topic=name, kind=ProblemKind.LABEL, assumed=True)
                continue
            if topic.space is None or self._geometry is not None:
                continue
            for text in _doubts(name, topic, topic.space):
                problems.add(text, topic=name, kind=ProblemKind.LABEL, lost=False)
        return [*super().problems, *problems]

    def take(self, cloud: PosedCloud, keep: NDArray[np.integer]) -> PointLabels | None:
        """As recorded with the cloud, or painted by the cameras."""
        if cloud.label is not None:
            ids: U32 = cloud.label[keep]
            topic = cloud.label_topic or cloud.header.topic
            self._topic(topic).see(ids, cloud.label_form is LabelForm.COLOURS)
            self._keyframes.append((_Carrier.CLOUD, topic))
            return ids

        painted = super().take(cloud, keep)
        if painted is None:
            self._keyframes.append((_Carrier.NONE, ""))
            return None
        for number, name in enumerate(self.images):
            topic_labels = self._topic(name)
            own = painted["label"][of_camera(painted, number)]
            topic_labels.see(own, topic_labels.is_coloured)
        self._keyframes.append((_Carrier.CAMERAS, ""))
        return painted

    def conclude(self, view: Callable[[int], KeyframeView], scale: float) -> None:
        """Settles the source and the meaning of the labels.

        Labels that are not classes are found by a few keyframes.
        """
        has_labels = any(source is not _Carrier.NONE for source, _ in self._keyframes) and any(
            not topic.is_empty() for topic in self._topics.values()
        )
        if not has_labels and not self._may_be_geometry:
            raise LogError(
                f"{self._session.name} has no labels (a 'label' field of the points or a label "
                f"image): use --set labels.source=geometry."
            )
        for name, topic in self._topics.items():
            topic.space, topic.decided_by = self._space(name, topic)
        if self._may_be_geometry and self._settings.space is None:
            self._doubt_labels(view, scale)
        are_doubted = all(t.doubt or t.is_empty() for t in self._topics.values())
        if not has_labels or are_doubted:
            self._geometry = GeometryLabels()

    def labels(
        self,
        keyframe: int,
        points: NDArray[np.floating],
        origin: NDArray[np.floating],
        labels: PointLabels | None,
        scale: float,
        ground: GroundSurface | None = None,
    ) -> U8:
        if self._geometry is not None:
            return self._geometry.labels(keyframe, points, origin, labels, scale, ground)
        carrier, topic = self._keyframes[keyframe]
        if labels is not None and carrier is _Carrier.CLOUD:
            return self.classes(topic, labels)
        return super().labels(keyframe, points, origin, labels, scale, ground)

    def to_json(self) -> dict[str, Any]:
        """With the label space of each topic, and who decided it."""
        spaces = {
            name: {
                "space": topic.space.name,
                "said_by": topic.decided_by.value,
                "colours": topic.is_coloured,
            }
            for name, topic in sorted(self._topics.items())
            if topic.space is not None and self._geometry is None and not topic.doubt
        }
        return super().to_json() | {"spaces": spaces}

    def classes(self, topic: str, ids: U32) -> U8:
        meant = self._topics[topic]
        assert meant.space is not None
        if meant.doubt:
            return unlabelled(ids)
        if not meant.is_coloured:
            return meant.space.train_ids(ids)
        out, strange = meant.space.train_ids_of_colours(ids)
        for colour, count in strange.items():
            meant.strange[colour] = meant.strange.get(colour, 0) + count
        return out

    def _read(self, frame: ImageFrame) -> U32:
        if frame.image.ndim == 3:
            self._topic(frame.header.topic).is_coloured = True
        return label_ids(frame)

    def _topic(self, name: str) -> _Topic:
        return self._topics.setdefault(name, _Topic())

    def _space(self, name: str, topic: _Topic) -> tuple[LabelSpace, _DecidedBy]:
        """The meaning of the labels of a topic, and who decided it."""
        if self._settings.space is not None:
            return read_space(self._settings.space), _DecidedBy.SETTING
        recorded = self._session.label_names.get(name)
        if recorded is not None and recorded.names and not topic.is_coloured:
            return space_of_names(recorded.names, recorded.header.topic), _DecidedBy.LOG
        # a log may name a shipped space, not a file
        if recorded is not None and recorded.space in spaces():
            return read_space(recorded.space), _DecidedBy.LOG
        if topic.is_coloured:
            return read_space(guess_palette(topic.colours) or "cityscapes"), _DecidedBy.GUESS
        seen = np.flatnonzero(topic.low) + (_HALF + 1 if topic.has_instances else 0)
        return read_space(guess_space(seen)), _DecidedBy.GUESS

    def _doubt_labels(self, view: Callable[[int], KeyframeView], scale: float) -> None:
        """Finds the topics whose ids are not classes."""
        checks = {
            name: LabelCheck(scale)
            for name, topic in self._topics.items()
            if not topic.is_empty() and not topic.is_coloured
        }
        for first, second in self._some_pairs():
            for keyframe in (first, second):
                seen = view(keyframe)
                for name, is_own, ids in self._ids(keyframe, seen.labels):
                    if name in checks:
                        checks[name].add(
                            seen.points[is_own],
                            seen.origin,
                            ids,
                            self.classes(name, ids),
                            follows=keyframe == second and seen.is_posed,
                        )
        for name, check in checks.items():
            topic = self._topics[name]
            share = 1.0 if topic.space is None else topic.known_share(topic.space)
            if topic.decided_by is _DecidedBy.GUESS and topic.space and share < LEAST_KNOWN:
                topic.doubt = (
                    f"{1 - share:.0%} of their points have ids that {topic.space.name}, the most "
                    f"similar label space, does not have"
                )
            elif topic.space and share < LEAST_OF_LOG:
                topic.doubt = (
                    f"{1 - share:.0%} of their points have ids that the label space of the log, "
                    f"{topic.space.name}, does not have"
                )
            else:
                topic.doubt = check.doubt()

    def _some_pairs(self) -> list[tuple[int, int]]:
        """Keyframes with labels and the next ones of the same topic, evenly spread."""
        last: dict[tuple[_Carrier, str], int] = {}
        pairs = []
        for number, of_keyframe in enumerate(self._keyframes):
            if of_keyframe[0] is not _Carrier.NONE:
                if of_keyframe in last:
                    pairs.append((last[of_keyframe], number))
                last[of_keyframe] = number
        if not pairs:  # single keyframes
            pairs = [(number, number) for number in last.values()]
        chosen = np.linspace(0, len(pairs) - 1, min(_MOST_PAIRS, len(pairs))).round()
        return [pairs[int(k)] for k in chosen]

    def _ids(self, keyframe: int, labels: PointLabels | None) -> Iterator[tuple[str, Bools, U32]]:
        """Topic, points (n,) and ids (m,) of the labels of a keyframe."""
        carrier, topic = self._keyframes[keyframe]
        if labels is None or carrier is _Carrier.NONE:
            return
        if carrier is _Carrier.CLOUD:
            yield topic, np.ones(len(labels), bool), labels
            return
        for number, name in enumerate(self.images):
            own = of_camera(labels, number)
            yield name, own, labels["label"][own]


def _unused(name: str, topic: _Topic) -> str:
    return (
        f"The labels of {name} are not used: {topic.doubt}; "
        f"--set labels.source=log takes them as classes, --set labels.space=NAME tells of which "
        f"label space."
    )


def _doubts(name: str, topic: _Topic, space: LabelSpace) -> Iterator[str]:
    """Sentences about a guessed label space, and about labels that it does not have."""
    if topic.decided_by is _DecidedBy.GUESS:
        yield (
            f"The labels of {name} are taken as {space.name} by their looks; "
            f"--set labels.space=NAME chooses another."
        )
    if space.unknown and topic.decided_by is _DecidedBy.LOG:
        yield f"Classes of {name} that mean nothing here are unlabelled: {_first(space.unknown)}."
    if topic.strange:
        colours = sorted(topic.strange, key=lambda c: (-topic.strange[c], c))
        names = [f"({c >> 16}, {c >> 8 & 255}, {c & 255})" for c in colours]
        yield (
            f"{sum(topic.strange.values())} points have colours of {name} that {space.name} does "
            f"not have and are unlabelled: {_first(names)}."
        )


def _first(names: Any, most: int = 8) -> str:
    listed = [str(n)[:40] for n in names]
    return ", ".join(listed[:most]) + (
        f" and {len(listed) - most} more" if len(listed) > most else ""
    )

"""The classes of one session: from labels of the log, from the user's model, or from geometry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semloc_logs.errors import LogError
from semloc_logs.frames import ImageFrame, PosedCloud
from semloc_logs.labels.camera_labels import CAMERA_SHIFT, Pictures
from semloc_logs.labels.from_geometry import classify
from semloc_logs.labels.painting import DOUBTFUL
from semloc_logs.labels.segmentation import Segmenter
from semloc_logs.labels.space import (
    SKY,
    THINGS,
    U8,
    U32,
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
from semloc_logs.logs.sensors.depth import label_ids
from semloc_logs.logs.session.session import Session
from semloc_logs.settings import Labels

_MOST_COLOURS = 4096  # that are remembered of one topic, to guess the palette
_LOW = (1 << CAMERA_SHIFT) - 1
NO_PICTURE = "no camera picture shows points of the same time; use --set labels.source=geometry."


@dataclass(slots=True, eq=False)
class _Topic:
    """The labels of one topic as seen so far, and their meaning in the end."""

    low: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(1 << 16, bool))
    has_instances: bool = False
    colours: dict[int, int] = field(default_factory=dict)
    is_coloured: bool = False
    space: LabelSpace | None = None
    origin: str = ""  # of the space: setting, log or guess
    strange: dict[int, int] = field(default_factory=dict)

    def see(self, ids: U32, is_coloured: bool) -> None:
        values, counts = np.unique(ids[ids != UNPAINTED], return_counts=True)
        self.is_coloured |= is_coloured
        if is_coloured:
            for colour, count in zip(values.tolist(), counts.tolist(), strict=True):
                if colour in self.colours or len(self.colours) < _MOST_COLOURS:
                    self.colours[colour] = self.colours.get(colour, 0) + count
        else:
            self.low[values & 0xFFFF] = True
            self.has_instances |= bool((values > 0xFFFF).any())

    def is_empty(self) -> bool:
        """Whether nothing but zeros was ever recorded."""
        return not self.low[1:].any() and not self.has_instances and not any(self.colours)


class Labeller:
    """Gives the points of every keyframe their classes.

    During the pass over the log :meth:`take` each keyframe, with :attr:`on_image` and
    :attr:`images` for the session's pass; after it :meth:`conclude`; then call :meth:`labels`.
    LogError and SettingsError when the log cannot give the source that the settings demand.
    """

    def __init__(self, settings: Labels, session: Session) -> None:
        self.source = settings.source
        self._settings, self._session = settings, session
        self._topics: dict[str, _Topic] = {}
        # topic and form of the labels: ids, colours, painted or ""
        self._keyframes: list[tuple[str, str]] = []
        self._model: Segmenter | None = None
        self._pictures: Pictures | None = None
        if settings.space is not None:
            read_space(settings.space)  # a mistake is found before the pass over the log
        roles = session.roles
        if settings.source == "onnx":
            self._model = Segmenter.open(settings)
            topics = tuple(t for t in roles.image if t in roles.info_of)
            if not topics:
                raise LogError(
                    f"{session.name} has no camera pictures with a CameraInfo for the model: name "
                    "them with --topic image=TOPIC "
                    f"and --topic camera_info=TOPIC, or use --set labels.source=geometry."
                )
            self._pictures = Pictures(session, topics, self._predict, settings.erode)
        elif settings.source in ("auto", "log"):
            topics = tuple(t for t in roles.label_image if t in roles.info_of)
            if topics:
                self._pictures = Pictures(session, topics, self._read, settings.erode)

    @property
    def images(self) -> tuple[str, ...]:
        """Topics of the pictures that labels come from."""
        return self._pictures.topics if self._pictures else ()

    @property
    def on_image(self) -> Callable[[ImageFrame], None] | None:
        """Takes the pictures during the pass; None when none are needed."""
        return self._pictures.take if self._pictures else None

    @property
    def notes(self) -> list[str]:
        """Sentences about assumptions, and about labels that cannot be used."""
        sentences = [*self._pictures.notes] if self._pictures else []
        for topic, t in sorted(self._topics.items()):
            if t.space is None or self.source != "log":
                continue
            if t.origin == "guess":
                sentences.append(
                    f"The labels of {topic} are taken as {t.space.name} by their looks; --set "
                    "labels.space=NAME says otherwise."
                )
            if t.space.unknown and t.origin == "log":
                sentences.append(
                    f"Classes of {topic} that mean nothing here are unlabelled: "
                    f"{_some(t.space.unknown)}."
                )
            if t.strange:
                names = [
                    f"({c >> 16}, {c >> 8 & 255}, {c & 255})"
                    for c in sorted(t.strange, key=lambda c: (-t.strange[c], c))
                ]
                total = sum(t.strange.values())
                sentences.append(
                    f"{total} points have colours of {topic} that {t.space.name} does not have and "
                    f"are unlabelled: {_some(names)}."
                )
        return sentences

    def take(self, cloud: PosedCloud, keep: NDArray[np.integer]) -> U32 | None:
        """Labels of ``cloud.points[keep]`` as recorded or painted, to be kept for :meth:`labels`.

        To be called with every keyframe in turn.
        """
        ids, topic, form = None, "", ""
        if cloud.label is not None and self.source in ("auto", "log"):
            ids = cloud.label[keep]
            form = cloud.extra.get("label_form", "ids")
            topic = cloud.extra.get("label_topic", cloud.header.topic)
            self._topics.setdefault(topic, _Topic()).see(ids, form == "colours")
        elif self._pictures is not None:
            ids = self._pictures.labels(cloud, keep)
            form = "painted" if ids is not None else ""
            if ids is not None and self.source != "onnx":
                for number, name in enumerate(self.images):
                    own = ids[_of_camera(ids, number)] & np.uint32(_LOW)
                    self._topics.setdefault(name, _Topic()).see(
                        own, self._topics.setdefault(name, _Topic()).is_coloured
                    )
        self._keyframes.append((topic, form))
        return ids

    def conclude(self) -> None:
        """Settle the source and the meaning of the labels, now that all have been seen."""
        if self.source == "onnx":
            if self._pictures is None or not self._pictures.painted:
                reasons = " ".join(self._pictures.notes) if self._pictures else ""
                raise LogError(
                    f"{self._session.name}: no point was labelled by the model: "
                    f"{reasons or NO_PICTURE}"
                )
            return
        if self.source not in ("auto", "log"):
            return
        has_labels = any(form for _, form in self._keyframes) and any(
            not t.is_empty() for t in self._topics.values()
        )
        if not has_labels and self.source == "log":
            raise LogError(
                f"{self._session.name} has no labels (a 'label' field of the points or a label "
                "image): use --set labels.source=geometry."
            )
        self.source = "log" if has_labels else "geometry"
        for name, topic in self._topics.items():
            topic.space, topic.origin = self._space(name, topic)

    def labels(
        self,
        keyframe: int,
        points: NDArray[np.floating],
        origin: NDArray[np.floating],
        ids: U32 | None,
        scale: float,
        ground: GroundSurface | None = None,
    ) -> U8:
        """Classes (n,) of the level ``points`` (n, 3) of a keyframe seen from ``origin`` (3,).

        ``ids`` are the result of :meth:`take`; ``scale`` is the voxel size over 0.30 m; ``ground``
        saves estimating the ground below the points again.
        """
        if self.source == "geometry":
            return classify(points, origin, scale, ground)
        if self.source == "uniform" or ids is None:
            return np.full(len(points), UNLABELLED, np.uint8)
        topic, form = self._keyframes[keyframe]
        if form != "painted":
            return self._train_ids(topic, ids)
        out = np.full(len(ids), UNLABELLED, np.uint8)
        for number, name in enumerate(self.images):
            own = _of_camera(ids, number)
            out[own] = (
                (ids[own] & np.uint32(_LOW)).astype(np.uint8)
                if self.source == "onnx"
                else self._train_ids(name, ids[own] & np.uint32(_LOW))
            )
        out[out == SKY] = UNLABELLED  # the sky returns no echo
        # a car's class on points behind its windows; a road has no windows, and is always behind a
        # nearer piece of itself
        out[(ids & DOUBTFUL > 0) & np.isin(out, THINGS)] = UNLABELLED
        if self._settings.unseen == "geometry":
            unseen = ids == UNPAINTED
            out[unseen] = classify(points, origin, scale, ground)[unseen]
        return out

    def to_json(self) -> dict[str, Any]:
        """For session.json: the source, the label space of each topic, counts of painted points."""
        spaces = {
            name: {"space": t.space.name, "said_by": t.origin, "colours": t.is_coloured}
            for name, t in sorted(self._topics.items())
            if t.space is not None and self.source == "log"
        }
        content: dict[str, Any] = {"source": self.source, "spaces": spaces}
        if self._model is not None:
            content["model"] = self._model.to_json()
        if self._pictures is not None:
            content |= self._pictures.to_json()
        return content

    def _predict(self, frame: ImageFrame) -> U32:
        assert self._model is not None
        return self._model.train_ids(frame.image)

    def _read(self, frame: ImageFrame) -> U32:
        if frame.image.ndim == 3:
            self._topics.setdefault(frame.header.topic, _Topic()).is_coloured = True
        return label_ids(frame)

    def _space(self, name: str, topic: _Topic) -> tuple[LabelSpace, str]:
        """The meaning of the labels of a topic, and where it comes from: setting, log or guess."""
        if self._settings.space is not None:
            return read_space(self._settings.space), "setting"
        recorded = self._session.label_names.get(name)
        if recorded is not None and recorded.names and not topic.is_coloured:
            return space_of_names(recorded.names, recorded.header.topic), "log"
        if (
            recorded is not None and recorded.space in spaces()
        ):  # a log may name a shipped space, not a file
            return read_space(recorded.space), "log"
        if topic.is_coloured:
            return read_space(guess_palette(topic.colours) or "cityscapes"), "guess"
        seen = np.flatnonzero(topic.low) + (1 << 16 if topic.has_instances else 0)
        return read_space(guess_space(seen)), "guess"

    def _train_ids(self, name: str, ids: U32) -> U8:
        topic = self._topics[name]
        assert topic.space is not None
        if not topic.is_coloured:
            return topic.space.train_ids(ids)
        out, strange = topic.space.train_ids_of_colours(ids)
        for colour, count in strange.items():
            topic.strange[colour] = topic.strange.get(colour, 0) + count
        return out


def _of_camera(ids: U32, number: int) -> NDArray[np.bool_]:
    cameras = (ids & np.uint32(0xFFFFFFFF ^ DOUBTFUL)) >> np.uint32(CAMERA_SHIFT)
    return np.asarray((cameras == number) & (ids != UNPAINTED))


def _some(names: Any, most: int = 8) -> str:
    listed = [str(n)[:40] for n in names]
    return ", ".join(listed[:most]) + (
        f" and {len(listed) - most} more" if len(listed) > most else ""
    )

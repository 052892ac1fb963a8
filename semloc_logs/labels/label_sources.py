"""The sources of labels by their names."""

from __future__ import annotations

from collections.abc import Callable

from semloc_logs.labels.geometry_labels import GeometryLabels, NoLabels
from semloc_logs.labels.labeller import Labeller
from semloc_logs.labels.model_labels import ModelLabels
from semloc_logs.labels.recorded_labels import RecordedLabels
from semloc_logs.labels.space import read_space
from semloc_logs.logs.session.session import Session
from semloc_logs.settings import Labels
from semloc_logs.settings.sections import LabelSource

LABELLERS: dict[LabelSource, Callable[[Labels, Session], Labeller]] = {
    "auto": RecordedLabels,
    "log": RecordedLabels,
    "onnx": ModelLabels,
    "geometry": lambda settings, session: GeometryLabels(),
    "uniform": lambda settings, session: NoLabels(),
}


def labeller_of(settings: Labels, session: Session) -> Labeller:
    """The labeller of a session. LogError and SettingsError when the source is not available."""
    if settings.space is not None:
        read_space(settings.space)  # a mistake costs nobody a pass over the log
    return LABELLERS[settings.source](settings, session)

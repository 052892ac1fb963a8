"""Classes of a session from its camera pictures, by a segmentation model of the user."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from semloc_logs.arrays import U8, U32
from semloc_logs.errors import LogError
from semloc_logs.frames import ImageFrame
from semloc_logs.labels.camera_labels import Pictures
from semloc_logs.labels.labeller import KeyframeView
from semloc_logs.labels.painted_labels import PaintedLabels
from semloc_logs.labels.segmentation import Segmenter
from semloc_logs.logs.problems import sentences
from semloc_logs.logs.session.session import Session
from semloc_logs.settings import Labels


class ModelLabels(PaintedLabels):
    """LogError where no picture has a CameraInfo, or the model labels no point."""

    source = "onnx"

    def __init__(self, settings: Labels, session: Session) -> None:
        self._model = Segmenter.open(settings)
        self._session_name = session.name
        topics = tuple(t for t in session.roles.image if t in session.roles.info_of)
        if not topics:
            raise LogError(
                f"{session.name} has no camera pictures with a CameraInfo for the model: "
                f"name them with --topic image=TOPIC and --topic camera_info=TOPIC, or use "
                f"--set labels.source=geometry."
            )
        super().__init__(settings, Pictures(session, topics, self._predict, settings.erode))

    def conclude(self, view: Callable[[int], KeyframeView], scale: float) -> None:
        """LogError when the model labelled no point."""
        if self._pictures is not None and self._pictures.painted:
            return
        reasons = " ".join(sentences(self.problems)) or (
            "no camera picture shows points of the same time; use --set labels.source=geometry."
        )
        raise LogError(f"{self._session_name}: no point was labelled by the model: {reasons}")

    def classes(self, topic: str, ids: U32) -> U8:
        return ids.astype(np.uint8)

    def to_json(self) -> dict[str, Any]:
        """With the model."""
        return super().to_json() | {"model": self._model.to_json()}

    def _predict(self, frame: ImageFrame) -> U32:
        return self._model.train_ids(frame.image)

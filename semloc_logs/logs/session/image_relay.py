"""Pictures that somebody beside the clouds wants to see: handed on as they come."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection

import numpy as np

from semloc_logs.frames import DepthFrame, ImageFrame
from semloc_logs.logs.sensors.depth import label_ids
from semloc_logs.logs.session.frame_queue import MAX_WAITING

OnImage = Callable[[ImageFrame], None]


class ShownPictures:
    """Gives ``on_image`` each picture of ``topics``, and remembers which were the newest."""

    def __init__(self, on_image: OnImage | None = None, topics: Collection[str] = ()) -> None:
        self._on_image = on_image
        self._stamps: dict[str, deque[int]] = (
            {topic: deque(maxlen=4 * MAX_WAITING) for topic in sorted(topics)} if on_image else {}
        )

    @property
    def topics(self) -> list[str]:
        """The topics whose pictures are wanted."""
        return list(self._stamps)

    def take(self, frame: DepthFrame | ImageFrame) -> None:
        """Hands a picture on if it is wanted."""
        topic = frame.header.topic
        if self._on_image is None or topic not in self._stamps:
            return
        self._stamps[topic].append(frame.header.stamp_ns)
        # labels in 16 bits that were decoded as if they were depth
        if isinstance(frame, DepthFrame):
            frame = ImageFrame(
                frame.header, np.minimum(label_ids(frame), 0xFFFF).astype(np.uint16), "mono16"
            )
        self._on_image(frame)

    def following(self, stamp_ns: int) -> list[int | None]:
        """For each topic the stamp (ns) of the first picture that is not earlier; None where it has
        yet to come.
        """
        return [
            next((s for s in stamps if s >= stamp_ns), None) for stamps in self._stamps.values()
        ]

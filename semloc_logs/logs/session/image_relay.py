"""Pictures for another reader beside the clouds: handed on as they come."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection

import numpy as np

from semloc_logs.frames import DepthFrame, ImageFrame
from semloc_logs.logs.sensors.depth import label_ids

OnImage = Callable[[ImageFrame], None]
_MOST_STAMPS = 4096  # of a topic: the pictures that come while a cloud waits
_LARGEST_ID = 0xFFFF  # of labels in 16 bits


class ImageRelay:
    """Gives ``on_image`` each picture of ``topics``, and remembers the newest stamps."""

    def __init__(self, on_image: OnImage | None = None, topics: Collection[str] = ()) -> None:
        self._on_image = on_image
        self._stamps: dict[str, deque[int]] = (
            {topic: deque(maxlen=_MOST_STAMPS) for topic in sorted(topics)} if on_image else {}
        )

    @property
    def topics(self) -> list[str]:
        """The topics of the pictures."""
        return list(self._stamps)

    def take(self, frame: DepthFrame | ImageFrame) -> None:
        """Hands a picture on if its topic is one of them."""
        topic = frame.header.topic
        if self._on_image is None or topic not in self._stamps:
            return
        self._stamps[topic].append(frame.header.stamp_ns)
        # labels in 16 bits that were decoded as if they were depth
        if isinstance(frame, DepthFrame):
            ids = np.minimum(label_ids(frame), _LARGEST_ID).astype(np.uint16)
            frame = ImageFrame(frame.header, ids, "mono16")
        self._on_image(frame)

    def following(self, stamp_ns: int) -> list[int | None]:
        """For each topic the stamp (ns) of the first picture at or after a time; None: to come."""
        return [
            next((stamp for stamp in stamps if stamp >= stamp_ns), None)
            for stamps in self._stamps.values()
        ]

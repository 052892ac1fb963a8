"""Range frames that wait for their poses and transforms, in the order of recording and in bounded
memory.
"""

from __future__ import annotations

from collections import deque

from semloc_logs.frames import DepthFrame, ImageFrame, LidarFrame
from semloc_logs.logs.messages.stamps import StampOrder

MAX_WAITING = 64  # frames that wait for their pose and transforms
MAX_WAITING_BYTES = 512 << 20

RangeFrame = LidarFrame | DepthFrame | ImageFrame


class WaitingFrames:
    """First come, first served; ``nbytes`` is what they hold."""

    def __init__(self) -> None:
        self.nbytes = 0
        self._frames: deque[tuple[RangeFrame, bool]] = deque()
        self._order: dict[str, StampOrder] = {}

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def is_full(self) -> bool:
        """Whether the first of them cannot wait any longer."""
        return len(self._frames) > MAX_WAITING or self.nbytes > MAX_WAITING_BYTES

    @property
    def first(self) -> RangeFrame:
        """The frame whose turn it is."""
        return self._frames[0][0]

    def add(self, frame: RangeFrame) -> None:
        """The next frame of the recording."""
        is_set_back = not self._order.setdefault(frame.header.topic, StampOrder()).accepts(
            frame.header.stamp_ns
        )
        self._frames.append((frame, is_set_back))
        self.nbytes += _size(frame)

    def pop(self) -> tuple[RangeFrame, bool]:
        """Takes the first frame out, and whether its stamp falls back behind those of earlier
        frames of its topic.
        """
        frame, is_set_back = self._frames.popleft()
        self.nbytes -= _size(frame)
        return frame, is_set_back

    def sensors(self, pose_topic: str | None) -> list[str]:
        """Their frame ids, first those of topics that share the namespace of the pose stream: a
        pose without child frame is theirs.
        """
        own = (pose_topic or "").strip("/").split("/")[:-1]

        def importance(frame: RangeFrame) -> int:
            return 0 if own and frame.header.topic.strip("/").split("/")[: len(own)] == own else 1

        return list(
            dict.fromkeys(
                f.header.frame_id for f in sorted((f for f, _ in self._frames), key=importance)
            )
        )


def _size(frame: RangeFrame) -> int:
    if isinstance(frame, LidarFrame):
        return frame.points.nbytes + sum(
            a.nbytes for a in (frame.label, frame.offset_ns, frame.ring) if a is not None
        )
    return frame.depth.nbytes if isinstance(frame, DepthFrame) else frame.image.nbytes

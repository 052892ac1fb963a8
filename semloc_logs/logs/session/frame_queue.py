"""Range frames that wait for their poses and transforms, in order and in bounded memory."""

from __future__ import annotations

from collections import deque

from semloc_logs.frames import DepthFrame, ImageFrame, LidarFrame
from semloc_logs.logs.messages.stamps import StampOrder

MOST_WAITING_BYTES = 512 << 20  # of frames that wait for their pose and transforms
# between the log times of the first and the newest frame that wait: odometry that is computed
# slowly is recorded within seconds
LONGEST_WAIT_NS = 10_000_000_000

RangeFrame = LidarFrame | DepthFrame | ImageFrame


class FrameQueue:
    """Frames in the order of recording; ``nbytes`` is their size in memory.

    It should stay below ``most_bytes``.
    """

    def __init__(self, most_bytes: int = MOST_WAITING_BYTES) -> None:
        self.nbytes = 0
        self._most_bytes = most_bytes
        self._frames: deque[tuple[RangeFrame, bool]] = deque()
        self._order: dict[str, StampOrder] = {}

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def is_full(self) -> bool:
        """Whether the first of them cannot wait any longer."""
        if len(self._frames) < 2:
            return False
        waited_ns = self._frames[-1][0].header.log_time_ns - self.first.header.log_time_ns
        return self.nbytes > self._most_bytes or waited_ns > LONGEST_WAIT_NS

    @property
    def first(self) -> RangeFrame:
        """The frame whose turn it is."""
        return self._frames[0][0]

    def add(self, frame: RangeFrame) -> None:
        """The next frame of the recording."""
        order = self._order.setdefault(frame.header.topic, StampOrder())
        is_set_back = not order.accepts(frame.header.stamp_ns)
        self._frames.append((frame, is_set_back))
        self.nbytes += _size(frame)

    def pop(self) -> tuple[RangeFrame, bool]:
        """Takes the first frame out, and whether its stamp falls back behind earlier ones."""
        frame, is_set_back = self._frames.popleft()
        self.nbytes -= _size(frame)
        return frame, is_set_back

    def sensors(self, pose_topic: str | None) -> list[str]:
        """Frame ids, first those in the namespace of the pose stream.

        A pose without child frame is taken to be the pose of the first of them.
        """
        namespace = (pose_topic or "").strip("/").split("/")[:-1]

        def is_elsewhere(frame: RangeFrame) -> bool:
            parts = frame.header.topic.strip("/").split("/")
            return not namespace or parts[: len(namespace)] != namespace

        ordered = sorted((frame for frame, _ in self._frames), key=is_elsewhere)
        return list(dict.fromkeys(frame.header.frame_id for frame in ordered))


def _size(frame: RangeFrame) -> int:
    if isinstance(frame, LidarFrame):
        columns = (frame.label, frame.offset_ns, frame.ring)
        return frame.points.nbytes + sum(c.nbytes for c in columns if c is not None)
    return frame.depth.nbytes if isinstance(frame, DepthFrame) else frame.image.nbytes

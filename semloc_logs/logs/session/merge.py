"""Several logs of one session as one stream of frames."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from heapq import heappop, heappush

from semloc_logs.frames import Frame
from semloc_logs.logs.log import Log, Reading


def merged_frames(
    logs: Sequence[Log], topics: Collection[str], reading: Reading | None = None
) -> Iterator[Frame]:
    """The frames of ``topics`` in log-time order over all logs, which may overlap.

    A log is read only once its time has come.
    """
    waiting = sorted(range(len(logs)), key=lambda i: (logs[i].start_ns or 0, i), reverse=True)
    # (log time, index of the log): the index keeps equal times in a fixed order
    heads: list[tuple[int, int]] = []
    frames: dict[int, Frame] = {}
    readers: dict[int, Iterator[Frame]] = {}

    def advance(index: int) -> None:
        frame = next(readers[index], None)
        if frame is not None:
            frames[index] = frame
            heappush(heads, (frame.header.log_time_ns, index))

    while heads or waiting:
        while waiting and (not heads or (logs[waiting[-1]].start_ns or 0) <= heads[0][0]):
            index = waiting.pop()
            readers[index] = iter(logs[index].frames(topics, reading))
            advance(index)
        if heads:
            index = heappop(heads)[1]
            yield frames.pop(index)
            advance(index)

"""The clock of each topic: header stamps or log times, and an offset."""

from __future__ import annotations

from dataclasses import replace

from semloc_logs.frames import Frame
from semloc_logs.logs.log import Clock, Message, Reading
from semloc_logs.logs.messages.decode import Decoder


class TopicClocks:
    """Decodes messages with the stamps of a ``reading``, during one pass over a log.

    This is the only place that changes stamps: all that follows sees the result.
    """

    def __init__(self, reading: Reading) -> None:
        self._reading = reading
        self._clock = reading.clock
        self._offset_ns = reading.offset_ns
        self._stamped: set[str] = set()  # topics that had a stamp other than 0

    def frames(self, decoder: Decoder, message: Message) -> list[Frame]:
        """The frames in ``message``; none if its stream is not read."""
        if self._reading.left_out and not self._reading.accepts(message):
            return []
        topic = message.topic
        is_open = self._clock is Clock.AUTO and topic not in self._stamped
        if is_open or self._clock is Clock.LOG:
            # as _replace, which is slower
            message = Message(*message[:-1], clock=self._clock)
        frames = decoder.frames(message)
        if not frames:
            return frames
        if is_open and any(not frame.header.lacks_stamp for frame in frames):
            self._stamped.add(topic)
        offset_ns = self._offset_ns.get(topic, 0)
        return [_shifted(frame, offset_ns) for frame in frames] if offset_ns else frames


def _shifted(frame: Frame, offset_ns: int) -> Frame:
    """The frame measured later; times of points are relative to the stamp."""
    header = frame.header
    return replace(frame, header=replace(header, stamp_ns=header.stamp_ns + offset_ns))

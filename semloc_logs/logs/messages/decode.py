"""Messages to frames: one small function for each message type, in a table by type name."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from semloc_logs.frames import Frame, Header, LabelNames, LidarFrame
from semloc_logs.logs.log import Definition, Message
from semloc_logs.logs.messages import cloud, image, livox, pose_messages
from semloc_logs.logs.messages.definitions import Parser, UndecodableError, json_type, parser
from semloc_logs.logs.messages.headers import BAD_VALUES, Convert, check_time, ros
from semloc_logs.logs.messages.large_messages import check_size
from semloc_logs.logs.messages.livox import livox_parser
from semloc_logs.logs.messages.point_times import PointTimes
from semloc_logs.logs.problems import Problems


class Decoder:
    """Decodes the messages of one log; ``problems`` counts the undecodable ones by topic."""

    def __init__(self, problems: Problems) -> None:
        self._problems = problems
        self._parsers: dict[tuple[str, str, int], Parser | UndecodableError] = {}
        self._definitions: list[Definition] = []  # alive as long as their ids are keys
        self._times = PointTimes()

    def frames(self, message: Message) -> list[Frame]:
        """The frames in ``message``; none when its type is not used or it cannot be decoded."""
        convert = CONVERTERS.get(
            json_type(message.type) if message.encoding in ("protobuf", "json") else message.type
        )
        # no other text is used
        if convert is None or (convert is _text and not message.topic.endswith("/label_space")):
            return []
        decoded: list[Frame] = []  # keeps the frames before the damaged part of a message
        try:
            check_time(message.log_time_ns)
            check_size(message)
            frames = convert(self._parse(message), message)
            decoded.extend(
                self._times.checked(frame) if isinstance(frame, LidarFrame) else frame
                for frame in frames
            )
            return decoded
        except UndecodableError as error:
            reason = str(error)
        except BAD_VALUES as error:
            reason = f"its values make no sense ({type(error).__name__}: {str(error)[:120]})"
        self._problems.skip(
            message.topic, f"{message.type} at log time {message.log_time_ns} ns: {reason}"
        )
        return decoded

    def _parse(self, message: Message) -> Any:
        key = (message.encoding, message.type, id(message.definition))
        known = self._parsers.get(key)
        if known is None:
            try:
                make = livox_parser if message.type in livox.TYPES else parser
                known = make(message.encoding, message.type, message.definition)
            except UndecodableError as error:
                known = error
            self._parsers[key] = known
            self._definitions.append(message.definition)
        if isinstance(known, UndecodableError):
            raise known
        return known(message.data)


# -- meaning of labels


def _label_info(header: Header, m: Any) -> Iterator[Frame]:
    yield LabelNames(header, names={int(c.class_id): str(c.class_name) for c in m.class_map})


def _text(m: Any, message: Message) -> Iterator[Frame]:
    yield LabelNames(
        Header(message.topic, message.log_time_ns, message.log_time_ns, ""),
        space=str(m.data).strip(),
    )


CONVERTERS: dict[str, Convert] = {
    **cloud.CONVERTERS,
    **image.CONVERTERS,
    **pose_messages.CONVERTERS,
    "vision_msgs/msg/LabelInfo": ros(_label_info),
    "std_msgs/msg/String": _text,
}

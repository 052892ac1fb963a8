"""Messages that are cut off, of no use, or of impossible times; and the meaning of labels."""

from __future__ import annotations

from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from semloc_logs.frames import LabelNames
from semloc_logs.logs.log import Message
from semloc_logs.logs.messages.decode import Decoder
from semloc_logs.logs.problems import Problems, sentences
from tests.logs.messages.encoded import NOTHING, QUARTER_TURN, Ros, json_frames, odometry


def test_cut_off_messages_are_named(ros: Ros) -> None:
    message = odometry(ros, QUARTER_TURN)
    serialize = ros.store.serialize_cdr if ros.encoding == "cdr" else ros.store.serialize_ros1
    data = bytes(serialize(message, "nav_msgs/msg/Odometry"))
    for size in range(len(data) - 8):
        assert (
            ros.decoder.frames(
                Message("/o", "nav_msgs/msg/Odometry", ros.encoding, 1, data[:size], NOTHING)
            )
            == []
        )
    assert sentences(ros.problems)[0].startswith(f"/o: {len(data) - 8} messages skipped")


def test_types_of_no_use_are_no_problem() -> None:
    problems = Problems()
    assert (
        Decoder(problems).frames(Message("/c", "std_msgs/msg/String", "cdr", 1, b"", NOTHING)) == []
    )
    assert sentences(problems) == []


def test_impossible_times_are_named() -> None:
    frames, problems = json_frames(
        "foxglove.LocationFix",
        {"timestamp": {"sec": 1 << 60, "nsec": 0}, "latitude": 1, "longitude": 2},
    )
    assert frames == []
    assert "is impossible" in sentences(problems)[0]


def test_the_meaning_of_labels() -> None:
    """A LabelInfo without a definition in the log, and the name of a label space."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(
        get_types_from_msg("uint16 class_id\nstring class_name", "vision_msgs/msg/VisionClass")
    )
    store.register(
        get_types_from_msg(
            "std_msgs/Header header\nVisionClass[] class_map\nfloat32 threshold",
            "vision_msgs/msg/LabelInfo",
        )
    )
    types: Any = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=3, nanosec=4)
    classes = [
        types["vision_msgs/msg/VisionClass"](class_id=i, class_name=n)
        for i, n in ((0, "road"), (7, "tree"))
    ]
    message = types["vision_msgs/msg/LabelInfo"](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="cam"),
        class_map=classes,
        threshold=0.5,
    )
    problems = Problems()
    data = bytes(store.serialize_cdr(message, "vision_msgs/msg/LabelInfo"))
    (frame,) = Decoder(problems).frames(
        Message("/label_info", "vision_msgs/msg/LabelInfo", "cdr", 1, data, NOTHING)
    )
    assert isinstance(frame, LabelNames)
    assert frame.names == {0: "road", 7: "tree"}
    assert frame.header.stamp_ns == 3_000_000_004
    text = bytes(
        store.serialize_cdr(
            types["std_msgs/msg/String"](data="semantickitti"), "std_msgs/msg/String"
        )
    )
    (frame,) = Decoder(problems).frames(
        Message("/lidar/label_space", "std_msgs/msg/String", "cdr", 9, text, NOTHING)
    )
    assert isinstance(frame, LabelNames)
    assert frame.space == "semantickitti"
    assert (
        Decoder(problems).frames(
            Message("/chatter", "std_msgs/msg/String", "cdr", 9, text, NOTHING)
        )
        == []
    )
    assert sentences(problems) == []

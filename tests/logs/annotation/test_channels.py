"""Closures as messages: every column in every encoding, in the right frame, at the right time."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from semloc_logs.errors import ContractError
from semloc_logs.logs.annotation.annotate import encoder_for
from semloc_logs.logs.annotation.channels import (
    TOPICS,
    Encoding,
    LogFacts,
    NewChannel,
    NewMessage,
    channel_metadata,
    latched,
    topics_of_targets,
)
from semloc_logs.logs.annotation.channels_foxglove import loop_closure_class
from semloc_logs.logs.annotation.closure_messages import LogContext, encode, run_id
from semloc_logs.logs.annotation.closure_record import COLUMNS, ClosureRecord
from semloc_logs.logs.annotation.scene import NO_SCENE, Cloud, Drive, Scene, StampedPose
from semloc_logs.numerics.transforms import transform, yaw_transform
from semloc_logs.schemas import read_text

ENCODINGS: list[Encoding] = ["ros2", "ros1", "protobuf", "json"]
COVARIANCE = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
ROW: dict[str, object] = {
    "query_session": "wet_monday",
    "target_session": "dry_sunday",
    "query_stamp_ns": 1_700_000_000_123_456_789,
    "target_stamp_ns": 1_600_000_000_987_654_321,
    "t_x": 1.5,
    "t_y": -2.25,
    "t_z": 0.125,
    "q_x": 0.0,
    "q_y": 0.0,
    "q_z": np.sqrt(0.5),
    "q_w": np.sqrt(0.5),
    "covariance": [float(x) for x in (COVARIANCE + 0.5).ravel()],
    "overlap": 0.75,
    "probability": 0.96875,
    "inliers": 1234,
    "words": 56,
}


def decode(channel: NewChannel, message: NewMessage) -> Any:
    """The message as an object, read by a library that only knows the channel and its schema."""
    name = channel.schema_name
    text = channel.schema_data
    if channel.schema_encoding in ("ros2msg", "ros1msg"):
        full = name if "/msg/" in name else name.replace("/", "/msg/")
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(text.decode(), full))
        read = (
            store.deserialize_cdr if channel.message_encoding == "cdr" else store.deserialize_ros1
        )
        return read(message.data, full)
    if channel.message_encoding == "protobuf":
        decoder = DecoderFactory().decoder_for("protobuf", Schema(1, text, "protobuf", name))
        assert decoder is not None
        return decoder(message.data)
    assert json.loads(text)["title"] == name
    return json.loads(message.data, object_hook=lambda d: SimpleNamespace(**d))


def decoded(
    closures: Sequence[ClosureRecord],
    session: str,
    encoding: Encoding,
    log_times: dict[int, int] | None = None,
    scene: Scene = NO_SCENE,
) -> dict[str, list[tuple[int, Any]]]:
    facts = LogFacts(encoding, "", {}, 10, 20, 1)
    context = LogContext(
        session, facts, log_times or {}, frame_id="odom", marker_size=1.0, scene=scene
    )
    channels, messages = encode(closures, context, encoder_for(facts), {"run": "1"})
    out: dict[str, list[tuple[int, Any]]] = {topic: [] for topic in TOPICS}
    for m in messages:
        channel = channels[m.channel]
        out.setdefault(channel.topic, []).append((m.log_time_ns, decode(channel, m)))
    return out


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_column_comes_back(encoding: Encoding) -> None:
    closure = ClosureRecord.from_row(ROW)
    ((_, message),) = decoded([closure], "wet_monday", encoding)["/semloc/loop_closures"]
    for name in COLUMNS:
        value = getattr(message, name)
        expected: Any = ROW[name]
        assert (list(value) if name == "covariance" else value) == expected, name
    stamp = message.header.stamp if encoding.startswith("ros") else message.timestamp
    seconds = getattr(stamp, "seconds", None) or stamp.sec
    rest = getattr(stamp, "nanos", None) or getattr(stamp, "nanosec", None) or stamp.nsec
    assert (seconds, rest) == (1_700_000_000, 123_456_789)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_pose_of_the_query_in_the_frame_of_the_target(encoding: Encoding) -> None:
    pose = transform(np.array([10.0, 20.0, 30.0]), np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]))
    closure = ClosureRecord.from_row(ROW, session_T_query=pose)
    messages = decoded([closure], "wet_monday", encoding)["/semloc/pose"]
    ((_, message),) = messages
    inner = message.pose.pose if encoding.startswith("ros") else message.pose
    assert (inner.position.x, inner.position.y, inner.position.z) == (10.0, 20.0, 30.0)
    assert np.allclose([inner.orientation.z, inner.orientation.w], np.sqrt(0.5))
    assert (
        message.header.frame_id if encoding.startswith("ros") else message.frame_id
    ) == "semloc/dry_sunday"
    assert not decoded([closure], "dry_sunday", encoding)[
        "/semloc/pose"
    ]  # there the log is the target


def test_covariance_of_the_pose_is_turned_into_the_axes_of_the_session() -> None:
    """The target stands turned by 90 degrees: its x axis is the session's y axis."""
    row = ROW | {
        "q_x": 0.0,
        "q_y": 0.0,
        "q_z": 0.0,
        "q_w": 1.0,
        "covariance": list(COVARIANCE.ravel()),
    }
    closure = ClosureRecord.from_row(row, session_T_query=yaw_transform(np.pi / 2, (5.0, 0.0, 0.0)))
    assert np.allclose(closure.covariance_in_session(), np.diag([2.0, 1.0, 3.0, 5.0, 4.0, 6.0]))
    ((_, message),) = decoded([closure], "wet_monday", "ros2")["/semloc/pose"]
    assert np.allclose(
        message.pose.covariance.reshape(6, 6), np.diag([2.0, 1.0, 3.0, 5.0, 4.0, 6.0])
    )


def test_covariance_in_session_against_sampled_errors() -> None:
    """Perturb the closure by its errors, and look at the errors of the pose in the session."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(1)
    target_T_query = transform(np.array([1.0, 2.0, 0.5]), Rotation.random(rng=rng).as_quat())
    session_T_target = transform(np.array([7.0, -3.0, 1.0]), Rotation.random(rng=rng).as_quat())
    root = rng.normal(size=(6, 6)) * 1e-3
    covariance = root @ root.T
    errors = rng.multivariate_normal(np.zeros(6), covariance, 40_000)
    true = np.repeat(target_T_query[None], len(errors), 0)
    true[:, :3, 3] += errors[:, :3]
    true[:, :3, :3] = Rotation.from_rotvec(errors[:, 3:]).as_matrix() @ target_T_query[:3, :3]
    seen = session_T_target @ true
    mean = session_T_target @ target_T_query
    turns = Rotation.from_matrix(seen[:, :3, :3] @ mean[:3, :3].T).as_rotvec()
    sampled = np.cov(np.hstack([seen[:, :3, 3] - mean[:3, 3], turns]).T)
    q = Rotation.from_matrix(target_T_query[:3, :3]).as_quat()
    row = (
        ROW
        | dict(zip(("q_x", "q_y", "q_z", "q_w"), map(float, q), strict=True))
        | {"covariance": list(covariance.ravel())}
    )
    computed = ClosureRecord.from_row(row, session_T_query=mean).covariance_in_session()
    assert np.abs(computed - sampled).max() < 0.05 * np.abs(computed).max()


def test_markers_show_the_place_and_the_other_end() -> None:
    """A self closure: the query is at (5, 0, 0) by odometry, the target end at (0, 0, 0)."""
    row = ROW | {
        "target_session": "wet_monday",
        "t_x": 4.0,
        "t_y": 0.0,
        "t_z": 0.0,
        "q_z": 0.0,
        "q_w": 1.0,
    }
    closure = ClosureRecord.from_row(
        row,
        session_T_query=yaw_transform(0.0, (4.0, 0.0, 0.0)),
        session_position=np.array([5.0, 0.0, 0.0]),
    )
    messages = decoded([closure], "wet_monday", "ros2")
    shown = {topic: len(messages[topic]) for topic in TOPICS if messages[topic]}
    assert shown == {  # one message each, at the query's end
        "/semloc/loop_closures": 1,
        "/semloc/pose": 1,
        "/semloc/markers": 1,
    }
    sphere, line, text = messages["/semloc/markers"][0][1].markers
    assert (sphere.type, line.type, text.type) == (2, 5, 9)
    assert {m.header.frame_id for m in (sphere, line, text)} == {"odom"}
    assert all(m.frame_locked for m in (sphere, line, text))  # as the overview is
    assert (sphere.pose.position.x, sphere.scale.x) == (5.0, 1.0)
    assert [(p.x, p.y, p.z) for p in line.points] == [(5.0, 0.0, 0.0), (0.0, 0.0, 0.0)]
    assert text.text == "an earlier place 0.97"
    entity = decoded([closure], "wet_monday", "json")["/semloc/markers"][0][1].entities[0]
    assert (entity.frame_id, entity.spheres[0].pose.position.x) == ("odom", 5.0)
    assert entity.frame_locked
    assert [(p.x, p.y, p.z) for p in entity.lines[0].points] == [(5.0, 0.0, 0.0), (0.0, 0.0, 0.0)]
    assert entity.texts[0].text == "an earlier place 0.97"


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_markers_between_sessions_have_no_line(encoding: Encoding) -> None:
    closure = ClosureRecord.from_row(
        ROW, session_T_query=np.eye(4), session_position=np.array([1.0, 2.0, 3.0])
    )
    for session, other in (("wet_monday", "dry_sunday"), ("dry_sunday", "wet_monday")):
        ((_, message),) = decoded([closure], session, encoding)["/semloc/markers"]
        texts = (
            [m.text for m in message.markers]
            if encoding.startswith("ros")
            else [message.entities[0].texts[0].text]
        )
        assert f"{other} 0.97" in texts
        assert (
            (len(message.markers) == 2)
            if encoding.startswith("ros")
            else (len(message.entities[0].lines) == 0)
        )


def test_times_and_order() -> None:
    """An end takes the receive time of its frame, else its stamp within the range of the log."""

    def one(stamp: int) -> ClosureRecord:
        return ClosureRecord.from_row(ROW | {"query_stamp_ns": stamp, "words": stamp})

    closures = [one(stamp) for stamp in (14, 13, 25, 5)]
    messages = decoded(
        [*closures, ClosureRecord.from_row(ROW | {"query_session": "other"})],
        "wet_monday",
        "ros2",
        {14: 11, 13: 12},
    )
    assert [(t, m.words) for t, m in messages["/semloc/loop_closures"]] == [
        (10, 5),
        (11, 14),
        (12, 13),
        (20, 25),
    ]


def test_as_target_the_time_is_that_of_the_target() -> None:
    messages = decoded(
        [ClosureRecord.from_row(ROW)], "dry_sunday", "ros2", {1_600_000_000_987_654_321: 17}
    )
    ((time, message),) = messages["/semloc/loop_closures"]
    assert (time, message.header.stamp.sec, message.query_session) == (
        17,
        1_600_000_000,
        "wet_monday",
    )


def test_schemas_agree_with_the_columns() -> None:
    fields = re.findall(
        r"^(\w+)(\[36\])? (\w+)$", read_text("messages/LoopClosure.msg"), re.MULTILINE
    )
    assert [name for _, _, name in fields] == list(COLUMNS)
    properties = json.loads(read_text("messages/LoopClosure.json"))["properties"]
    assert list(properties) == ["timestamp", *COLUMNS]
    kinds = {"string": "string", "int64": "integer", "int32": "integer", "float64": "number"}
    for kind, array, name in fields:
        entry = properties[name]["items"] if array else properties[name]
        assert entry["type"] == kinds[kind], name
    proto = re.findall(
        r"^  (repeated )?([\w.]+) (\w+) = (\d+);$",
        read_text("messages/LoopClosure.proto"),
        re.MULTILINE,
    )
    descriptor = descriptor_pb2.DescriptorProto()
    loop_closure_class().DESCRIPTOR.CopyToProto(descriptor)
    types = {"string": 9, "int64": 3, "int32": 5, "double": 1, "google.protobuf.Timestamp": 11}
    built = [(f.name, f.number, f.type, f.label == 3) for f in descriptor.field]
    assert built == [
        (name, int(number), types[kind], bool(repeated)) for repeated, kind, name, number in proto
    ]
    assert [name for _, _, name, _ in proto] == ["timestamp", *COLUMNS]


def test_ros_definitions_name_their_types_as_the_profile_wants() -> None:
    facts = LogFacts("ros1", "ros1", {}, 0, 0, 0)
    closure = ClosureRecord.from_row(ROW, session_T_query=np.eye(4), session_position=np.zeros(3))
    channels, _ = encode(
        [closure],
        LogContext("wet_monday", facts, {}, frame_id="", marker_size=1.0),
        encoder_for(facts),
        {"run": "1"},
    )
    assert [
        (c.topic, c.schema_name, c.schema_encoding, c.message_encoding, dict(c.metadata))
        for c in channels
    ] == [
        ("/semloc/loop_closures", "semloc_msgs/LoopClosure", "ros1msg", "ros1", {"run": "1"}),
        (
            "/semloc/pose",
            "geometry_msgs/PoseWithCovarianceStamped",
            "ros1msg",
            "ros1",
            {"run": "1"},
        ),
        ("/semloc/markers", "visualization_msgs/MarkerArray", "ros1msg", "ros1", {"run": "1"}),
        (
            "/semloc/pose/dry_sunday",
            "geometry_msgs/PoseWithCovarianceStamped",
            "ros1msg",
            "ros1",
            {"run": "1"},
        ),
    ]
    assert b"MSG: std_msgs/Header\nuint32 seq\ntime stamp" in channels[0].schema_data


@pytest.mark.parametrize(
    "change",
    [
        {"covariance": [1.0] * 35},
        {"t_x": None},
        {"words": "many"},
        {"covariance": 1.0},
        {"query_stamp_ns": None},
    ],
)
def test_rows_that_break_the_contract(change: dict[str, object]) -> None:
    with pytest.raises(ContractError):
        ClosureRecord.from_row(ROW | change)
    with pytest.raises(ContractError):
        ClosureRecord.from_row({k: v for k, v in ROW.items() if k not in change})


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_numbers_that_are_not_finite_are_refused(encoding: Encoding) -> None:
    with pytest.raises(ContractError, match="not finite"):
        decoded([ClosureRecord.from_row(ROW | {"overlap": float("nan")})], "wet_monday", encoding)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("stamp", [0, -5, 2**63 - 1])
def test_extreme_stamps(encoding: Encoding, stamp: int) -> None:
    ((_, message),) = decoded(
        [ClosureRecord.from_row(ROW | {"query_stamp_ns": stamp})], "wet_monday", encoding
    )["/semloc/loop_closures"]
    assert message.query_stamp_ns == stamp


def test_run_id_follows_content() -> None:
    closure = ClosureRecord.from_row(ROW)
    same = run_id([ClosureRecord.from_row(dict(ROW))], "s", {"a": "1", "b": "2"}, "1")
    assert run_id([closure], "s", {"b": "2", "a": "1"}, "1") == same
    others = [
        ([], "s", {"a": "1", "b": "2"}, "1"),
        ([closure], "s", {}, "1"),
        ([closure], "t", {"a": "1", "b": "2"}, "1"),
    ]
    assert all(run_id(*other) != same for other in others)
    assert re.fullmatch("[0-9a-f]{16}", same)
    assert channel_metadata(same, "1")["semloc.run_id"] == same


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_each_target_has_a_topic_of_its_poses(encoding: Encoding) -> None:
    sunday = ClosureRecord.from_row(ROW, session_T_query=np.eye(4))
    friday = ClosureRecord.from_row(ROW | {"target_session": "friday"}, session_T_query=np.eye(4))
    messages = decoded([sunday, friday], "wet_monday", encoding)
    assert len(messages["/semloc/pose"]) == 2
    for target in ("dry_sunday", "friday"):
        ((_, message),) = messages[f"/semloc/pose/{target}"]
        in_ros = encoding.startswith("ros")
        frame_id = message.header.frame_id if in_ros else message.frame_id
        assert frame_id == f"semloc/{target}"


def test_topics_are_names_that_ros_allows() -> None:
    names = ["2021-08-05", "a b", "a-b", "Straße", "x"]
    assert topics_of_targets(names) == {
        "2021-08-05": "/semloc/pose/session_2021_08_05",
        "Straße": "/semloc/pose/Stra_e",
        "a b": "/semloc/pose/a_b",
        "a-b": "/semloc/pose/a_b_",
        "x": "/semloc/pose/x",
    }


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_poses_in_the_common_frame_replace_the_ones_of_targets(encoding: Encoding) -> None:
    closure = ClosureRecord.from_row(ROW, session_T_query=np.eye(4))
    pose = StampedPose(12, "semloc/common", yaw_transform(0.0, (1.0, 2.0, 3.0)), np.zeros((6, 6)))
    messages = decoded([closure], "wet_monday", encoding, scene=Scene(common=[pose]))
    ((time, message),) = messages["/semloc/pose"]
    in_ros = encoding.startswith("ros")
    inner = message.pose.pose if in_ros else message.pose
    assert time == 12
    assert (message.header if in_ros else message).frame_id == "semloc/common"
    assert (inner.position.x, inner.position.y, inner.position.z) == (1.0, 2.0, 3.0)
    assert len(messages["/semloc/pose/dry_sunday"]) == 1


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_map_is_a_cloud_at_the_start(encoding: Encoding) -> None:
    points = np.array([[1.0, 2.0, 3.0], [-4.0, 5.5, 0.25]], np.float32)
    colours = np.array([[128, 64, 127], [1, 2, 3]], np.uint8)
    cloud = Cloud("odom", points, colours, np.array([0, 255], np.uint8))
    closure = ClosureRecord.from_row(ROW)
    messages = decoded([closure], "wet_monday", encoding, scene=Scene(cloud=cloud))
    ((time, message),) = messages["/semloc/map"]
    assert time == 10
    if encoding.startswith("ros"):
        assert (message.width, message.height, message.header.frame_id) == (2, 1, "odom")
        step = message.point_step
        data = bytes(message.data)
        assert message.row_step == len(data) == 2 * step
        colour = ("b", "g", "r")
        offset = {f.name: f.offset for f in message.fields}
        places = {c: offset["rgb"] + k for k, c in enumerate(colour)}
    else:
        assert message.frame_id == "odom"
        step = message.point_stride
        data = base64.b64decode(message.data) if encoding == "json" else message.data
        offset = {f.name: f.offset for f in message.fields}
        places = {c[0]: offset[c] for c in ("red", "green", "blue")}
    for k in range(2):
        row = data[k * step : (k + 1) * step]
        xyz = [np.frombuffer(row, "<f4", 1, offset[axis])[0] for axis in "xyz"]
        assert xyz == points[k].tolist()
        assert [row[places[c]] for c in "rgb"] == colours[k].tolist()
        assert row[offset["label"]] == (0, 255)[k]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_one_message_at_the_start_has_all_drives_and_closures(encoding: Encoding) -> None:
    """Closures from (1, 2, 3) to (4, 2, 3), and at (5, 0, 0) with an unknown other end."""
    ends: list[tuple[list[float], list[float] | None]] = [
        ([1.0, 2.0, 3.0], [4.0, 2.0, 3.0]),
        ([5.0, 0.0, 0.0], None),
    ]
    closures = [
        ClosureRecord.from_row(
            ROW | {"query_stamp_ns": stamp_ns, "probability": probability},
            session_T_query=np.eye(4),
            session_position=np.array(end),
            session_other=None if other is None else np.array(other),
        )
        for stamp_ns, probability, (end, other) in zip((14, 15), (1.0, 0.5), ends, strict=True)
    ]
    way = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 3.0, 0.0]])
    orange = (0.75, 0.5, 0.0, 1.0)
    drives = [
        Drive("wet_monday", "odom", way, orange),
        Drive("dry_sunday", "semloc/dry_sunday", way + 1.0, orange),
    ]
    messages = decoded(closures, "wet_monday", encoding, scene=Scene(drives=drives))
    assert [time for time, _ in messages["/semloc/markers"]] == [14, 15]
    ((time, message),) = messages["/semloc/overview"]
    assert time == 10
    red_and_green = [(0.0, 1.0), (1.0, 0.0)]  # sure, unsure
    if encoding.startswith("ros"):
        kinds = {4: "way", 9: "name", 7: "places", 5: "closures"}
        parts = {(kinds[m.type], m.header.frame_id): m for m in message.markers}
        assert len(message.markers) == len(parts) == 6
        assert len({(m.ns, m.id) for m in message.markers}) == 6  # none replaces another
        assert all(m.frame_locked for m in message.markers)
        names = [parts["name", d.frame_id].text for d in drives]
        ways = [parts["way", d.frame_id].points for d in drives]
        places = parts["places", "odom"].points
        colours = parts["places", "odom"].colors
        line = parts["closures", "odom"]
        assert len(line.colors) == len(line.points)
    else:
        *of_drives, of_closures = message.entities
        assert len({entity.id for entity in message.entities}) == 3
        assert all(entity.frame_locked for entity in message.entities)
        assert [e.frame_id for e in message.entities] == ["odom", "semloc/dry_sunday", "odom"]
        names = [entity.texts[0].text for entity in of_drives]
        ways = [entity.lines[0].points for entity in of_drives]
        assert [entity.lines[0].type for entity in of_drives] == [0, 0]  # LINE_STRIP
        places = [sphere.pose.position for sphere in of_closures.spheres]
        colours = [sphere.color for sphere in of_closures.spheres]
        (line,) = of_closures.lines
        assert line.type == 2  # LINE_LIST
        assert len(line.colors) == len(line.points)
    assert names == ["wet_monday", "dry_sunday"]
    for shown, drive in zip(ways, drives, strict=True):
        assert [[p.x, p.y, p.z] for p in shown] == drive.positions.tolist()
    assert [[p.x, p.y, p.z] for p in places] == [end for end, _ in ends]
    assert [(c.r, c.g) for c in colours] == red_and_green
    assert [[p.x, p.y, p.z] for p in line.points] == list(ends[0])


def test_late_readers_get_the_last_message() -> None:
    def facts(encoding: Encoding) -> LogFacts:
        return LogFacts(encoding, "", {}, 0, 0, 0)

    numbers = {"offered_qos_profiles": "- history: 3\n  durability: 2\n  depth: 0\n"}
    words = {"offered_qos_profiles": "- history: keep_all\n  durability: volatile\n"}
    assert latched(numbers, facts("ros2"))["offered_qos_profiles"] == (
        "- history: 3\n  durability: 1\n  depth: 0\n"
    )
    assert latched(words, facts("ros2"))["offered_qos_profiles"].endswith(
        "durability: transient_local\n"
    )
    assert "durability: 1\n" in latched({}, facts("ros2"))["offered_qos_profiles"]
    assert latched({}, facts("ros1")) == {"latching": "1"}
    assert latched({"run": "1"}, facts("json")) == {"run": "1"}

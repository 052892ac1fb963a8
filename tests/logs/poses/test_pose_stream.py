"""Several streams of one topic: types, encodings, frames and publishers; one of them is used."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from semloc_logs.arrays import F64
from semloc_logs.errors import RoleError
from semloc_logs.frames import PosedCloud
from semloc_logs.logs.inspection.inspect import inspect_log
from semloc_logs.logs.problems import Problem
from semloc_logs.logs.session.session import Session, SessionOptions, open_session
from semloc_logs.numerics.transforms import translation_quaternion, yaw_transform

S = 1_000_000_000
MS = 1_000_000
EPOCH = 1_700_000_000 * S
POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
FAR = 40.0  # m, between the poses of two streams

Recorder = Callable[..., Any]


def forward(seconds: float, offset: float = 0.0) -> F64:
    return yaw_transform(0.0, (seconds + offset, 0.0, 0.0))


def drive(recorder: Recorder, kind: str = "ros2", frame_id: str = "base_link") -> Any:
    """6 s at 1 m/s: a sweep and a pose each 0.1 s; poses on /odom."""
    log = recorder(kind)
    for k in range(60):
        log.cloud("/points", EPOCH + k * 100 * MS, frame_id, np.ones(3, POINT))
    for k in range(62):
        log.pose(EPOCH + k * 100 * MS, forward(0.1 * k))
    return log


def stamped(log: Any, topic: str, time_ns: int, pose: F64) -> None:
    """A PoseStamped."""
    t, q = translation_quaternion(pose)
    where = log.make(
        "geometry_msgs/msg/Pose",
        position=log.make("geometry_msgs/msg/Point", x=t[0], y=t[1], z=t[2]),
        orientation=log.make("geometry_msgs/msg/Quaternion", x=q[0], y=q[1], z=q[2], w=q[3]),
    )
    message = log.make(
        "geometry_msgs/msg/PoseStamped", header=log.header(time_ns, "world"), pose=where
    )
    log.add(topic, message, time_ns)


def fused(path: Path, **topics: str) -> tuple[Session, list[PosedCloud]]:
    session = open_session([path], SessionOptions(topics=topics))
    clouds = list(session.clouds())
    session.close()
    return session, clouds


def positions(clouds: list[PosedCloud]) -> list[float]:
    return [float(c.session_T_base[0, 3]) for c in clouds if c.session_T_base is not None]


def assert_good(clouds: list[PosedCloud], offset: float = 0.0) -> None:
    assert positions(clouds) == pytest.approx([0.1 * k + offset for k in range(60)], abs=1e-6)


def about(session: Session, text: str) -> list[Problem]:
    return [p for p in session.problems if text in p.text]


class TestTypesOfOneTopic:
    def test_odometry_is_used_and_the_other_type_is_named(self, recorder: Recorder) -> None:
        log = drive(recorder)
        for k in range(60):
            stamped(log, "/odom", EPOCH + k * 100 * MS + 25 * MS, forward(0.1 * k, FAR))
        path = log.write()
        session, clouds = fused(path)
        assert_good(clouds)
        [problem] = about(session, "/odom has messages of 2 kinds")
        assert problem.assumed
        assert "62 of nav_msgs/msg/Odometry (cdr) are used" in problem.text
        assert "--topic pose=/odom:geometry_msgs/msg/PoseStamped" in problem.text
        assert [(s["type"], s["role"]) for s in session.to_json()["streams"]] == [  # type: ignore[attr-defined]
            ("geometry_msgs/msg/PoseStamped", None),
            ("nav_msgs/msg/Odometry", "pose"),
            ("sensor_msgs/msg/PointCloud2", "lidar"),
        ]
        inspection = inspect_log(path)
        assert problem.text in inspection["problems"]  # type: ignore[operator]
        assert inspection["poses"]["count"] == 62  # type: ignore[index]

    def test_the_user_chooses_the_other_type(self, recorder: Recorder) -> None:
        log = drive(recorder)
        for k in range(62):
            stamped(log, "/odom", EPOCH + k * 100 * MS, forward(0.1 * k, FAR))
        session, clouds = fused(log.write(), pose="/odom:geometry_msgs/msg/PoseStamped")
        assert_good(clouds, FAR)
        assert about(session, "kinds") == []

    def test_a_few_messages_of_a_better_type_are_not_preferred(self, recorder: Recorder) -> None:
        """The type changes after the first half a second: 5 Odometry, then 60 PoseStamped."""
        log = recorder()
        for k in range(60):
            log.cloud("/points", EPOCH + k * 100 * MS, "base_link", np.ones(3, POINT))
            stamped(log, "/odom", EPOCH + k * 100 * MS, forward(0.1 * k))
        for k in range(5):
            log.pose(EPOCH - (5 - k) * 100 * MS, forward(0.0, FAR))
        session, clouds = fused(log.write())
        assert_good(clouds)
        assert "60 of geometry_msgs/msg/PoseStamped (cdr) are used" in (
            about(session, "kinds")[0].text
        )

    def test_a_type_that_plays_no_role_is_a_note(self, recorder: Recorder) -> None:
        log = drive(recorder)
        log.add("/odom", log.make("std_msgs/msg/Float64", data=1.0), EPOCH)
        session, clouds = fused(log.write())
        assert_good(clouds)
        [problem] = about(session, "/odom has messages of 2 kinds")
        assert problem.text.endswith("1 of std_msgs/msg/Float64 (cdr) are not.")
        assert not problem.is_reported

    def test_a_sensor_topic_is_chosen_by_the_type_that_fits(self, recorder: Recorder) -> None:
        """--topic lidar=/points names the clouds, whatever else is on /points."""
        log = drive(recorder)
        for k in range(60):
            stamped(log, "/points", EPOCH + k * 100 * MS, forward(0.1 * k, FAR))
        session, clouds = fused(log.write(), lidar="/points")
        assert_good(clouds)
        assert session.roles.pose == "/odom"

    def test_an_unknown_type_is_refused_with_the_ones_that_there_are(
        self, recorder: Recorder
    ) -> None:
        with pytest.raises(RoleError, match=r"60 of sensor_msgs/msg/PointCloud2 \(cdr\)"):
            fused(drive(recorder).write(), lidar="/points:livox")


def test_two_encodings_of_one_topic_and_type_are_told_apart(tmp_path: Path) -> None:
    """62 poses in protobuf, 61 in JSON."""
    name = "foxglove.PoseInFrame"
    path = tmp_path / "drive.mcap"

    def pose(x: float, time_ns: int) -> dict[str, Any]:
        return {
            "timestamp": {"sec": time_ns // S, "nsec": time_ns % S},
            "frame_id": "world",
            "pose": {
                "position": {"x": x, "y": 0.0, "z": 0.0},
                "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            },
        }

    from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
    from mcap_protobuf.schema import build_file_descriptor_set

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("")
        json_schema = writer.register_schema(name, "jsonschema", b"{}")
        blob = build_file_descriptor_set(PoseInFrame).SerializeToString()
        schema = writer.register_schema(name, "protobuf", blob)
        channels = {
            "json": writer.register_channel("/pose", "json", json_schema),
            "protobuf": writer.register_channel("/pose", "protobuf", schema),
        }
        for k in range(62):
            time_ns = EPOCH + k * 100 * MS
            if k < 61:
                data = json.dumps(pose(0.1 * k + FAR, time_ns)).encode()
                writer.add_message(channels["json"], time_ns, data, time_ns)
            message = PoseInFrame(frame_id="world")
            message.timestamp.FromNanoseconds(time_ns)
            message.pose.position.x = 0.1 * k
            message.pose.orientation.w = 1.0
            writer.add_message(channels["protobuf"], time_ns, message.SerializeToString(), time_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    for choice, count in ((None, 62), ("/pose:json", 61)):
        inspection = inspect_log(path, {} if choice is None else {"pose": choice})
        assert inspection["poses"]["count"] == count  # type: ignore[index]
    assert any(
        "/pose has messages of 2 kinds" in p
        for p in inspect_log(path)["problems"]  # type: ignore[attr-defined]
    )


def test_a_bag_of_ros1_and_an_mcap_of_ros2_are_one_session(recorder: Recorder) -> None:
    """The same topics in other encodings, one after the other: nothing is left out."""
    paths = []
    for part, kind in enumerate(("ros1", "ros2")):
        log = recorder(kind, f"part_{part}")
        for k in range(30 * part, 30 * part + 30):
            log.cloud("/points", EPOCH + k * 100 * MS, "base_link", np.ones(3, POINT))
            log.pose(EPOCH + k * 100 * MS, forward(0.1 * k))
        paths.append(log.write())
    session = open_session(paths)
    assert_good(list(session.clouds()))
    assert session.problems == []
    session.close()


class TestFramesOfOneTopic:
    @pytest.mark.parametrize("others", [("map", "other_base"), ("world", "wheel")])
    def test_the_frame_that_is_connected_with_the_sensors_is_used(
        self, recorder: Recorder, others: tuple[str, str]
    ) -> None:
        """The others come first, and there are more of them."""
        log = drive(recorder, frame_id="lidar")
        log.transform("base_link", "lidar", np.eye(4), EPOCH)
        for k in range(-20, 62):
            log.pose(EPOCH + k * 100 * MS - 20 * MS, forward(0.1 * k, FAR), frames=others)
        session, clouds = fused(log.write())
        assert_good(clouds)
        assert (session.base_frame, session.session_frame) == ("base_link", "odom")
        [problem] = about(session, "/odom gives poses of several frames")
        assert not problem.is_reported  # the log itself settles it
        assert f"82 of '{others[1]}' in '{others[0]}' are not" in problem.text
        assert f"--topic pose=/odom:{others[1]}" in problem.text

    def test_without_a_connection_the_most_frequent_is_used_and_said(
        self, recorder: Recorder
    ) -> None:
        log = drive(recorder, frame_id="lidar")
        for k in range(-1, 30):
            log.pose(EPOCH + k * 200 * MS - 20 * MS, forward(0.2 * k, FAR), frames=("a", "b"))
        session, clouds = fused(log.write())
        assert_good(clouds)
        [problem] = about(session, "/odom gives poses of several frames")
        assert problem.assumed

    def test_two_frames_that_the_vehicle_moves_in_are_an_assumption(
        self, recorder: Recorder
    ) -> None:
        """base_link in odom and base_link in map: both may be right, but not mixed."""
        log = drive(recorder)
        for k in range(60):
            pose = forward(0.1 * k, FAR)
            log.pose(EPOCH + k * 100 * MS + 20 * MS, pose, frames=("map", "base_link"))
        path = log.write()
        session, clouds = fused(path)
        assert_good(clouds)
        [problem] = about(session, "/odom gives poses of several frames")
        assert problem.assumed
        assert problem.text in inspect_log(path)["skipped"]  # type: ignore[operator]

        session, clouds = fused(path, pose="/odom:map")
        assert positions(clouds)[5] == pytest.approx(0.48 + FAR, abs=1e-6)
        assert session.session_frame == "map"
        assert not about(session, "several frames")[0].is_reported

    def test_a_frame_that_no_pose_names_is_refused_with_the_ones_there_are(
        self, recorder: Recorder
    ) -> None:
        session, clouds = fused(drive(recorder).write(), pose="/odom:base_lnik")
        assert positions(clouds) == []
        [problem] = about(session, "gives no pose of or in 'base_lnik'")
        assert problem.lost
        assert "'base_link' in 'odom'" in problem.text

    def test_one_frame_is_no_problem(self, recorder: Recorder) -> None:
        session, clouds = fused(drive(recorder).write())
        assert_good(clouds)
        assert session.problems == []


def bag(path: Path, nodes: dict[str, float], *, split: int | None = None) -> Path:
    """A ROS 1 bag whose Odometry comes from two nodes, in turns or, with ``split``, in order.

    ``nodes``: metres that the poses of a node lie ahead.
    """
    store = get_typestore(Stores.ROS1_NOETIC)
    make = store.types
    types = ("nav_msgs/msg/Odometry", "sensor_msgs/msg/PointCloud2")

    def header(time_ns: int, frame: str) -> Any:
        time = make["builtin_interfaces/msg/Time"](time_ns // S, time_ns % S)
        return make["std_msgs/msg/Header"](0, time, frame)

    def odometry(time_ns: int, x: float) -> Any:
        zero = make["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        where = make["geometry_msgs/msg/Pose"](
            make["geometry_msgs/msg/Point"](x, 0.0, 0.0),
            make["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
        )
        return make[types[0]](
            header(time_ns, "odom"),
            "base_link",
            make["geometry_msgs/msg/PoseWithCovariance"](where, np.zeros(36)),
            make["geometry_msgs/msg/TwistWithCovariance"](
                make["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36)
            ),
        )

    field = make["sensor_msgs/msg/PointField"]
    fields = [field(name, 4 * k, 7, 1) for k, name in enumerate("xyz")]
    data = np.ones(3, POINT).view(np.uint8)
    events: list[tuple[int, str, Any]] = []
    for k in range(62):
        time_ns = EPOCH + k * 100 * MS
        cloud = make[types[1]](
            header(time_ns, "base_link"), 1, 3, fields, False, 12, 36, data, True
        )
        events.append((time_ns + 50 * MS, "points", cloud))
        for number, (node, ahead) in enumerate(nodes.items()):
            if split is None or (k >= split) == bool(number):
                event = (time_ns + number * 10 * MS, node, odometry(time_ns, 0.1 * k + ahead))
                events.append(event)
    with BagWriter(path) as writer:
        connections = {
            node: writer.add_connection("/odom", types[0], typestore=store, callerid=node)
            for node in nodes
        }
        connections["points"] = writer.add_connection("/points", types[1], typestore=store)
        for time_ns, name, message in sorted(events, key=lambda e: e[0]):
            raw = bytes(store.serialize_ros1(message, message.__msgtype__))
            writer.write(connections[name], time_ns, raw)
    return path


class TestPublishersOfOneTopic:
    def test_two_nodes_in_turns_are_not_mixed(self, tmp_path: Path) -> None:
        path = bag(tmp_path / "drive.bag", {"/ekf": 0.0, "/gazebo": FAR})
        session, clouds = fused(path)
        assert positions(clouds) == pytest.approx([0.1 * k for k in range(62)], abs=1e-6)
        [problem] = about(session, "2 publishers")
        assert problem.assumed
        assert "/odom by /ekf is used, /odom by /gazebo (62) not" in problem.text
        assert problem.text in inspect_log(path)["skipped"]  # type: ignore[operator]

    def test_the_user_chooses_the_other_node(self, tmp_path: Path) -> None:
        path = bag(tmp_path / "drive.bag", {"/ekf": 0.0, "/gazebo": FAR})
        session, clouds = fused(path, pose="/odom:/gazebo")
        assert positions(clouds) == pytest.approx([0.1 * k + FAR for k in range(62)], abs=1e-6)
        assert not any(p.is_reported for p in about(session, "2 publishers"))

    def test_the_same_poses_twice_are_no_contradiction(self, tmp_path: Path) -> None:
        path = bag(tmp_path / "drive.bag", {"/ekf": 0.0, "/relay": 0.0})
        session, clouds = fused(path)
        assert len(positions(clouds)) == 62
        assert about(session, "publishers") == []

    def test_a_node_that_is_started_again_goes_on(self, tmp_path: Path) -> None:
        """The second node begins 0.1 s after the end of the first."""
        path = bag(tmp_path / "drive.bag", {"/odom_1": 0.0, "/odom_2": 0.0}, split=31)
        session, clouds = fused(path)
        assert positions(clouds) == pytest.approx([0.1 * k for k in range(62)], abs=1e-6)
        assert session.problems == []


def test_two_publishers_of_one_edge_of_tf(recorder: Recorder) -> None:
    """Two topics have odom -> base_link; the first of them gives the poses."""
    log = recorder()
    for k in range(60):
        time_ns = EPOCH + k * 100 * MS
        log.cloud("/points", time_ns, "base_link", np.ones(3, POINT))
        log.transform("odom", "base_link", forward(0.1 * k), time_ns, "/tf")
        log.transform("odom", "base_link", forward(0.1 * k, FAR), time_ns + 20 * MS, "/sim/tf")
    session, clouds = fused(log.write())
    assert_good(clouds)
    [problem] = about(session, "2 publishers give 'base_link' in 'odom'")
    assert problem.assumed
    assert "/tf is used, /sim/tf (60) not" in problem.text


def test_two_channels_of_one_type_are_two_publishers(tmp_path: Path, recorder: Recorder) -> None:
    """Two channels of an MCAP with one topic and type, in turns."""
    source = drive(recorder)
    store = source.store
    path = tmp_path / "two.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schemas: dict[str, int] = {}
        channels: dict[tuple[str, float], int] = {}
        for time_ns, topic, message in source.events:
            name = message.__msgtype__
            if name not in schemas:
                text = store.generate_msgdef(name, ros_version=2)[0].encode()
                schemas[name] = writer.register_schema(name, "ros2msg", text)
            for ahead in (0.0, FAR) if topic == "/odom" else (0.0,):
                if (topic, ahead) not in channels:
                    channels[topic, ahead] = writer.register_channel(topic, "cdr", schemas[name])
                if topic == "/odom":
                    message.pose.pose.position.x += ahead
                data = bytes(store.serialize_cdr(message, name))
                writer.add_message(channels[topic, ahead], time_ns, data, time_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    session, clouds = fused(path)
    assert_good(clouds)
    [problem] = about(session, "2 publishers")
    assert "/odom by channel" in problem.text

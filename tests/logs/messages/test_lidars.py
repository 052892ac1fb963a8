"""Several LIDARs, one LIDAR twice, and the LIDAR messages that are no PointCloud2."""

from __future__ import annotations

import json
import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from semloc_logs.arrays import F64
from semloc_logs.cli.main import program
from semloc_logs.errors import RoleError
from semloc_logs.frames import LidarFrame, PointTimeRemark
from semloc_logs.logs.log import Definition, Message, Stream
from semloc_logs.logs.messages.decode import Decoder
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.logs.problems import Problems, lost, sentences
from semloc_logs.logs.role_types import no_sensor
from semloc_logs.logs.roles import find_roles, guess_roles
from semloc_logs.logs.session.session import SessionOptions, open_session
from semloc_logs.logs.session.tally import Tally
from semloc_logs.numerics import transforms
from semloc_logs.numerics.transforms import yaw_transform

S = 1_000_000_000
EPOCH = 1_700_000_000 * S
HALF = np.array([10.0, 6.0, 2.0])
MOUNTS = {
    "front": yaw_transform(0.2, (2.0, 0.5, 0.3)),
    "rear": yaw_transform(3.0, (-1.5, -0.4, 0.1)),
}
XYZ = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])


def rows(points: F64) -> NDArray[np.void]:
    return np.ascontiguousarray(points, np.float32).view(XYZ).reshape(-1)


def half_room(world_T_sensor: F64, ahead: float, seed: int) -> F64:
    """Points (n, 3) of the walls on one side, ``ahead`` 1 or -1, in the sensor frame."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (6000, 3)) * HALF
    axis = rng.integers(0, 3, len(points))
    points[np.arange(len(points)), axis] = np.sign(rng.uniform(-1, 1, len(points))) * HALF[axis]
    points = points[points[:, 0] * ahead > 0]
    return transforms.apply(transforms.inverse(world_T_sensor), points)


def drive(log: Any, *, mounts: tuple[str, ...] = ("front", "rear")) -> Path:
    """2 m/s through the room; front LIDAR at 10 Hz, rear at 7 Hz half a period later."""
    for name in mounts:
        log.transform("base_link", name, MOUNTS[name], EPOCH - S)
    for k in range(-10, 40):
        log.pose(EPOCH + k * S // 20, yaw_transform(0.0, (0.1 * k, 0.0, 0.0)))
    for name, ahead, period, start in (("front", 1.0, 0.1, 0.0), ("rear", -1.0, 1 / 7, 0.05)):
        for k in range(8):
            t = start + k * period
            world_T_sensor = yaw_transform(0.0, (2.0 * t, 0.0, 0.0)) @ MOUNTS[name]
            log.cloud(
                f"/{name}/points",
                EPOCH + round(t * S),
                name,
                rows(half_room(world_T_sensor, ahead, k)),
            )
    return Path(log.write())


@pytest.mark.parametrize("kind", ["ros2", "ros1", "protobuf"])
def test_two_lidars_see_one_room(recorder: Any, kind: str) -> None:
    session = open_session([drive(recorder(kind))])
    seen: dict[str, list[F64]] = {}
    for cloud in session.clouds():
        assert cloud.session_T_base is not None
        seen.setdefault(cloud.header.topic, []).append(
            transforms.apply(cloud.session_T_base, cloud.points)
        )
    assert {topic: len(clouds) for topic, clouds in seen.items()} == {
        "/front/points": 8,
        "/rear/points": 8,
    }
    for topic, side in (("/front/points", 1), ("/rear/points", -1)):
        points = np.concatenate(seen[topic])
        assert (points[:, 0] * side > -0.01).all()
        np.testing.assert_allclose(np.min(np.abs(HALF - np.abs(points)), axis=1), 0.0, atol=1e-3)
    assert session.problems == []
    np.testing.assert_allclose(session.base_T_sensors()["rear"], MOUNTS["rear"], atol=1e-9)


def test_the_fused_map_is_the_room(recorder: Any, tmp_path: Path) -> None:
    log = drive(recorder())
    # so little of a room does not show which way is up
    settings = ["--set", "fusion.voxel_size=0.3", "--set", "logs.up=0,0,1"]
    done = CliRunner().invoke(program, ["fuse", str(log), "-w", str(tmp_path / "w"), *settings])
    assert done.exit_code == 0, done.output
    table = pyarrow.parquet.read_table(tmp_path / "w" / "sessions" / "drive" / "voxels")
    centres = np.stack([table[f"i{a}"].to_numpy() for a in "xyz"], 1) * 0.3 + 0.15
    session_T_map = np.array(
        json.loads((tmp_path / "w" / "sessions" / "drive" / "session.json").read_text())[
            "session_T_map"
        ]
    )
    room = transforms.apply(session_T_map, centres)
    off = np.min(np.abs(HALF - np.abs(room)), axis=1)
    assert np.quantile(off, 0.99) < 0.35
    assert room[:, 0].min() < -9.5
    assert room[:, 0].max() > 9.5


def test_a_missing_extrinsic_costs_one_lidar_and_one_sentence(recorder: Any) -> None:
    session = open_session([drive(recorder(), mounts=("front",))])
    assert {c.header.topic for c in session.clouds()} == {"/front/points"}
    [sentence] = sentences(lost(session.problems))
    assert sentence.startswith(
        "/rear/points: 8 of 8 frames are left out: no transform leads from their "
        "frame 'rear' to the base frame 'base_link'"
    )


def publish_twice(log: Any, change: Callable[[F64], F64], name: str, frame: str = "front") -> Path:
    log.transform("base_link", "front", MOUNTS["front"], EPOCH - S)
    for k in range(-10, 40):
        log.pose(EPOCH + k * S // 20, yaw_transform(0.0, (0.1 * k, 0.0, 0.0)))
    for k in range(6):
        world_T_sensor = yaw_transform(0.0, (0.2 * k, 0.0, 0.0)) @ MOUNTS["front"]
        points = half_room(world_T_sensor, 1.0, k)
        log.cloud("/lidar", EPOCH + k * S // 10, "front", rows(points))
        log.cloud(name, EPOCH + k * S // 10, frame, rows(change(points)), late_ns=170_000_000)
    return Path(log.write())


def without_ground(points: F64) -> F64:
    return points[points[:, 2] > -1.0]


def centroids(points: F64) -> F64:
    cells = np.floor(points / 0.3).astype(np.int64)
    _, inverse, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    total = np.zeros((len(count), 3))
    np.add.at(total, inverse.reshape(-1), points)
    return total / count[:, None]


@pytest.mark.parametrize(
    ("change", "frame"),
    [
        (without_ground, "front"),
        (lambda p: p[::5], "front"),
        (centroids, "front"),
        (lambda p: transforms.apply(MOUNTS["front"], p), "base_link"),
    ],
    ids=["no ground", "thinned", "voxels", "in the base frame"],
)
def test_one_lidar_twice_is_used_once(
    recorder: Any, change: Callable[[F64], F64], frame: str
) -> None:
    path = publish_twice(recorder(), change, "/segmented_or_not", frame)
    session = open_session([path])
    assert [c.header.topic for c in session.clouds()] == ["/lidar"] * 6
    assert lost(session.problems) == []
    assert any(
        p.startswith("/segmented_or_not repeats points of /lidar")
        for p in sentences(session.problems)
    )
    both = open_session([path], SessionOptions(topics={"lidar": "/lidar,/segmented_or_not"}))
    assert len(list(both.clouds())) == 12


def test_a_filtered_topic_by_its_name(recorder: Any) -> None:
    path = publish_twice(recorder(), without_ground, "/lidar_filtered")
    session = open_session([path])
    assert [c.header.topic for c in session.clouds()] == ["/lidar"] * 6
    assert any(p.startswith("/lidar_filtered is left out") for p in sentences(session.problems))


def test_two_sensors_in_one_frame_are_both_used(recorder: Any) -> None:
    def other(points: F64) -> F64:
        return points + np.random.default_rng(len(points)).normal(0, 0.02, points.shape)

    session = open_session([publish_twice(recorder(), other, "/second")])
    assert len(list(session.clouds())) == 12
    assert session.problems == []


# -- other messages

CUSTOM = {
    "ros2": (
        "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 "
        "lidar_id\nuint8[3] rsvd\nCustomPoint[] points\n"
    ),
    "point": (
        "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 "
        "reflectivity\nuint8 tag\nuint8 line\n"
    ),
}
PACKAGES = ["livox_ros_driver", "livox_ros_driver2", "livox_interfaces"]


def livox_message(
    package: str,
    encoding: str,
    frame_id: str = "livox",
    count: int = 5,
    tags: tuple[int, ...] = (16,) * 5,
    step: int = 20_000_000,
) -> tuple[bytes, Definition]:
    store = get_typestore(Stores.ROS2_HUMBLE if encoding == "cdr" else Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(CUSTOM["point"], f"{package}/msg/CustomPoint"))
    store.register(get_types_from_msg(CUSTOM["ros2"], f"{package}/msg/CustomMsg"))
    t = store.types
    stamp = t["builtin_interfaces/msg/Time"](sec=1_700_000_000, nanosec=250)
    header = t["std_msgs/msg/Header"](
        stamp=stamp, frame_id=frame_id, **({} if encoding == "cdr" else {"seq": 0})
    )
    points = [
        t[f"{package}/msg/CustomPoint"](
            offset_time=k * step,
            x=1.0 + k,
            y=2.0,
            z=-k,
            reflectivity=7,
            tag=tags[k % len(tags)],
            line=k % 6,
        )
        for k in range(count)
    ]
    m = t[f"{package}/msg/CustomMsg"](
        header=header,
        timebase=EPOCH + 1250,
        point_num=count,
        lidar_id=3,
        rsvd=np.zeros(3, np.uint8),
        points=points,
    )
    text, _ = store.generate_msgdef(m.__msgtype__, ros_version=2 if encoding == "cdr" else 1)
    data = (
        store.serialize_cdr(m, m.__msgtype__)
        if encoding == "cdr"
        else store.serialize_ros1(m, m.__msgtype__)
    )
    return bytes(data), Definition("", "ros2msg" if encoding == "cdr" else "ros1msg", text.encode())


@pytest.mark.parametrize("frame_id", ["", "l", "livox", "livox_frame"])
@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
@pytest.mark.parametrize("package", PACKAGES)
def test_livox_with_and_without_its_definition(package: str, encoding: str, frame_id: str) -> None:
    data, definition = livox_message(package, encoding, frame_id)
    for known in (definition, Definition("", "", b"")):
        problems = Problems()
        frames = Decoder(problems).frames(
            Message("/livox/lidar", f"{package}/msg/CustomMsg", encoding, 1, data, known)
        )
        assert sentences(problems) == []
        [frame] = frames
        assert isinstance(frame, LidarFrame)
        assert (frame.header.stamp_ns, frame.header.frame_id) == (EPOCH + 250, frame_id)
        assert frame.points.tolist() == [[1 + k, 2, -k] for k in range(5)]
        assert frame.offset_ns is not None
        assert frame.offset_ns.tolist() == [1000 + k * 20_000_000 for k in range(5)]
        assert frame.ring is not None
        assert frame.ring.tolist() == list(range(5))


# (tag, is it noise): bits 0 and 1 by place, 2 and 3 by intensity, 4 and 5 the return
TAGS = [(0b00, 0), (0b01, 1), (0b10, 1), (0b11, 0), (0b0100, 1), (0b1000, 1), (0b1100, 0)]
TAGS += [(0b010000, 0), (0b100000, 0), (0b100001, 1)]


@pytest.mark.parametrize(("tag", "noise"), TAGS)
def test_points_that_a_livox_tags_as_noise(tag: int, noise: int) -> None:
    data, definition = livox_message(PACKAGES[1], "cdr", tags=(0, tag, 0, 0, 0))
    problems = Problems()
    type_ = f"{PACKAGES[1]}/msg/CustomMsg"
    [frame] = Decoder(problems).frames(Message("/l", type_, "cdr", 1, data, definition))
    assert isinstance(frame, LidarFrame)
    assert frame.points[:, 0].tolist() == [1, 3, 4, 5] if noise else [1, 2, 3, 4, 5]
    assert (frame.lost, sentences(problems)) == (0, [])


@pytest.mark.parametrize(
    ("step", "is_other", "last_ns"),
    [(500_000, False, 99_500_000), (50, True, 9_950_000), (1, True, 199_000_000)],
)
def test_livox_times_that_are_no_nanoseconds_are_named(
    step: int, is_other: bool, last_ns: int
) -> None:
    """200 points: 99.5 ms in nanoseconds, 9.95 ms in microseconds, 199 ms in milliseconds."""
    data, definition = livox_message(PACKAGES[1], "cdr", count=200, step=step)
    type_ = f"{PACKAGES[1]}/msg/CustomMsg"
    [frame] = Decoder(Problems()).frames(Message("/l", type_, "cdr", 1, data, definition))
    assert isinstance(frame, LidarFrame)
    assert frame.offset_ns is not None
    assert frame.offset_ns[[0, -1]].tolist() == [1000, 1000 + last_ns]
    assert frame.remark == (PointTimeRemark.OTHER_UNIT if is_other else None)
    tally = Tally()
    tally.saw("/l")
    tally.measured(frame)
    texts = sentences(tally.problems(PoseTrack(), "base_link"))
    assert texts == is_other * [
        "/l: 1 of 1 sweeps have point times in microseconds or milliseconds, it seems: in "
        "nanoseconds, as their message defines them, more points would be measured than any "
        "sensor can."
    ]


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_livox_claims_and_strange_definitions(encoding: str) -> None:
    data, definition = livox_message(PACKAGES[0], encoding)
    for cut in range(len(data)):
        problems = Problems()
        message = Message("/l", f"{PACKAGES[0]}/msg/CustomMsg", encoding, 1, data[:cut], definition)
        assert Decoder(problems).frames(message) == []
        assert len(sentences(problems)) == 1
    count = struct.pack("<I", 5)
    start = data.rindex(count, 0, len(data) - 5 * 19)
    problems = Problems()
    claimed = data[:start] + struct.pack("<I", 2**32 - 1) + data[start + 4 :]
    assert (
        Decoder(problems).frames(
            Message("/l", f"{PACKAGES[0]}/msg/CustomMsg", encoding, 1, claimed, definition)
        )
        == []
    )
    strange = Definition(
        "", definition.encoding, definition.text.replace(b"float32 x", b"float64 x")
    )
    assert (
        Decoder(problems).frames(
            Message("/l", f"{PACKAGES[0]}/msg/CustomMsg", encoding, 1, data, strange)
        )
        == []
    )
    assert (
        "differs from the Livox drivers" in sentences(problems)[0]
        or "need" in sentences(problems)[0]
    )


def test_livox_points_of_signalling_nan_are_dropped_without_a_warning() -> None:
    data, definition = livox_message(PACKAGES[0], "ros1")
    start = data.index(struct.pack("<fff", 2.0, 2.0, -1.0))
    damaged = data[:start] + struct.pack("<I", 0x7F800001) + data[start + 4 :]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        [frame] = Decoder(Problems()).frames(
            Message("/l", f"{PACKAGES[0]}/msg/CustomMsg", "ros1", 1, damaged, definition)
        )
    assert isinstance(frame, LidarFrame)
    assert (len(frame.points), frame.lost) == (4, 1)


def test_livox_is_a_lidar() -> None:
    assert find_roles(
        [Stream("/livox/lidar", "livox_ros_driver2/msg/CustomMsg", "cdr", 3)]
    ).lidar == ("/livox/lidar",)
    assert find_roles([Stream("/x", "other/msg/CustomMsg", "cdr", 3)]).lidar == ()


@pytest.mark.parametrize(
    "type_",
    ["velodyne_msgs/msg/VelodyneScan", "ouster_ros/msg/PacketMsg", "pandar_msgs/msg/PandarScan"],
)
def test_packets_are_named(type_: str, recorder: Any) -> None:
    streams = [Stream("/packets", type_, "cdr", 3)]
    assert no_sensor(streams).startswith(f"/packets holds {type_}, packets")
    streams.append(Stream("/points", "sensor_msgs/msg/PointCloud2", "cdr", 3))
    assert guess_roles(streams).lidar == ("/points",)
    assert any(n.startswith("/packets holds") for n in sentences(guess_roles(streams).notes))


def test_a_log_of_packets_is_refused_with_advice(recorder: Any) -> None:
    log = recorder()
    text = "std_msgs/Header header\nVelodynePacket[] packets\n"
    log.store = get_typestore(Stores.ROS2_HUMBLE)
    log.store.register(
        get_types_from_msg(
            "builtin_interfaces/Time stamp\nuint8[1206] data\n", "velodyne_msgs/msg/VelodynePacket"
        )
    )
    log.store.register(get_types_from_msg(text, "velodyne_msgs/msg/VelodyneScan"))
    scan = log.make(
        "velodyne_msgs/msg/VelodyneScan", header=log.header(EPOCH, "velodyne"), packets=[]
    )
    log.add("/velodyne_packets", scan, EPOCH)
    with pytest.raises(
        RoleError,
        match=(
            r"drive.mcap: /velodyne_packets holds velodyne_msgs/msg/VelodyneScan, "
            r"packets .* PointCloud2"
        ),
    ):
        open_session([log.write()])


def test_the_old_point_cloud(recorder: Any) -> None:
    log = recorder("ros1")
    point, channel = "geometry_msgs/msg/Point32", "sensor_msgs/msg/ChannelFloat32"
    points = [
        log.make(point, x=1.0, y=2.0, z=3.0),
        log.make(point, x=np.nan, y=0.0, z=0.0),
        log.make(point, x=4.0, y=5.0, z=6.0),
    ]
    times = log.make(channel, name="time", values=np.array([0.0, 0.05, 0.1], np.float32))
    message = log.make(
        "sensor_msgs/msg/PointCloud",
        header=log.header(EPOCH, "lidar"),
        points=points,
        channels=[times],
    )
    log.add("/scan", message, EPOCH)
    log.pose(EPOCH, np.eye(4))
    session = open_session([log.write()])
    [cloud] = session.clouds()
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]

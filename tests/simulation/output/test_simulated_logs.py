"""Simulated logs are read back by other people's readers and by ours."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from semloc_logs.errors import LogError, SemlocError, SettingsError
from semloc_logs.logs.inspection.inspect import inspect_log
from semloc_logs.numerics.transforms import apply, interpolate, inverse, transform, yaw_transform
from semloc_logs.simulation.demo import simulate_demo
from semloc_logs.simulation.drive_plan import Route, Town, plan_sessions
from semloc_logs.simulation.drives.drive import DriveFrame, mounting, simulate_drive
from semloc_logs.simulation.drives.trajectory import Trajectory, drive, smooth_line
from semloc_logs.simulation.meshes.world import ROAD, WALL, MeshBuilder, World, box
from semloc_logs.simulation.output.drive_log import write_session
from semloc_logs.simulation.output.truth_file import write_truth
from semloc_logs.simulation.sensors.lidar_models import MODELS
from semloc_logs.simulation.sensors.sensor import Sensor
from semloc_logs.simulation.sessions import simulate_sessions

START = 1_760_000_000_123_456_789


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    return drive(
        smooth_line(np.array([[0.0, 0], [25, 0]])),
        lambda x, y: 0.01 * x,
        np.random.default_rng(0),
        start_ns=START,
    )


@pytest.fixture(scope="module")
def yard() -> World:
    builder = MeshBuilder(lambda x, y: 0.01 * x)
    builder.add(box(60.0, 24.0, 1.0, x=12.0, z=-1.0), ROAD, ground="drape")
    for y in (-6.0, 6.0):
        builder.add(box(60.0, 1.0, 5.0, x=12.0, y=y), WALL, ground="drape")
    return builder.build()


@pytest.fixture(scope="module")
def frames(yard: World, trajectory: Trajectory) -> list[DriveFrame]:
    return list(simulate_drive(yard, trajectory, Sensor("vlp16", 2.0, 300)))


def test_drive_frames_are_on_time_and_in_place(
    frames: list[DriveFrame], trajectory: Trajectory
) -> None:
    assert [f.stamp_ns for f in frames[:3]] == [START, START + 500_000_000, START + 1_000_000_000]
    assert frames[-1].stamp_ns + 100_000_000 <= trajectory.stamps_ns[-1]
    for frame in frames:
        points = apply(frame.world_T_base @ frame.base_T_lidar, frame.sweep.points)
        walls = points[frame.sweep.labels == WALL]
        assert np.median(np.abs(walls[:, 1])) == pytest.approx(5.5, abs=0.05)


def test_points_are_where_the_vehicle_was_between_the_ends_of_a_sweep(
    yard: World, trajectory: Trajectory
) -> None:
    poses = trajectory.world_T_base.copy()
    poses[1::2] = poses[1::2] @ yaw_transform(0.03, (0.0, 0.0, 0.0))  # every other one: 50 ms
    shaken = Trajectory(trajectory.stamps_ns, poses, poses)

    def off_the_walls(trajectory: Trajectory) -> float:
        """The median distance (m) of points from the walls."""
        frame = list(simulate_drive(yard, trajectory, Sensor("vlp16", 2.0, 300)))[1]
        moments = frame.stamp_ns + (frame.sweep.turn * 1e8).astype(np.int64)
        placed = interpolate(trajectory.stamps_ns, trajectory.world_T_base, moments)
        at_moments = placed @ frame.base_T_lidar
        points = np.einsum("nij,nj->ni", at_moments[:, :3, :3], frame.sweep.points)
        walls = (points + at_moments[:, :3, 3])[frame.sweep.labels == WALL]
        return float(np.median(np.abs(np.abs(walls[:, 1]) - 5.5)))

    assert off_the_walls(shaken) == pytest.approx(off_the_walls(trajectory), abs=0.005)


def test_label_noise_leaves_the_points(
    yard: World, trajectory: Trajectory, frames: list[DriveFrame]
) -> None:
    noisy = list(simulate_drive(yard, trajectory, Sensor("vlp16", 2.0, 300, label_noise=0.15)))
    wrong = np.concatenate(
        [a.sweep.labels != b.sweep.labels for a, b in zip(frames, noisy, strict=True)]
    )
    assert 0.05 < wrong.mean() < 0.25
    np.testing.assert_array_equal(frames[0].sweep.points, noisy[0].sweep.points)


@pytest.fixture(scope="module", params=["drive.mcap", "drive.bag"])
def log(
    request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
    trajectory: Trajectory,
    frames: list[DriveFrame],
) -> Path:
    path: Path = tmp_path_factory.mktemp("log") / request.param
    assert write_session(path, trajectory, frames) == len(frames)
    return path


def messages(path: Path) -> Iterator[tuple[str, int, Any]]:
    if path.suffix == ".bag":
        with AnyReader([path]) as reader:
            for connection, time, data in reader.messages():
                yield connection.topic, time, reader.deserialize(data, connection.msgtype)
        return
    with path.open("rb") as stream:
        for _, channel, message, decoded in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            yield channel.topic, message.log_time, decoded


def test_other_readers_read_the_log(
    log: Path, trajectory: Trajectory, frames: list[DriveFrame]
) -> None:
    read = list(messages(log))
    times = [time for _, time, _ in read]
    assert times == sorted(times)
    by_topic = {topic: [m for t, _, m in read if t == topic] for topic, _, _ in read}
    assert set(by_topic) == {
        "/lidar/points",
        "/odometry",
        "/imu",
        "/gnss",
        "/tf_static",
        "/lidar/label_space",
    }
    assert len(by_topic["/odometry"]) == len(by_topic["/imu"]) == len(trajectory.stamps_ns)
    assert by_topic["/lidar/label_space"][0].data == "cityscapes"
    edge = by_topic["/tf_static"][0].transforms[0]
    assert (edge.header.frame_id, edge.child_frame_id, edge.transform.translation.z) == (
        "base_link",
        "lidar",
        MODELS["vlp16"].height,
    )
    odometry = by_topic["/odometry"][-1]
    assert (
        odometry.header.stamp.sec * 10**9 + odometry.header.stamp.nanosec
        == trajectory.stamps_ns[-1]
    )
    position = odometry.pose.pose.position
    np.testing.assert_allclose(
        [position.x, position.y, position.z], trajectory.odom_T_base[-1, :3, 3]
    )


def test_clouds_come_back_as_they_were(log: Path, frames: list[DriveFrame]) -> None:
    clouds = [m for topic, _, m in messages(log) if topic == "/lidar/points"]
    assert len(clouds) == len(frames)
    kinds = {7: "<f4", 4: "<u2", 6: "<u4"}
    for cloud, frame in zip(clouds, frames, strict=True):
        fields = cloud.fields
        row = np.dtype(
            {
                "names": [f.name for f in fields],
                "formats": [kinds[f.datatype] for f in fields],
                "offsets": [f.offset for f in fields],
            }
        )
        points = np.frombuffer(bytes(cloud.data), row)
        np.testing.assert_array_equal(
            np.column_stack([points[a] for a in "xyz"]), frame.sweep.points
        )
        np.testing.assert_array_equal(points["label"], frame.sweep.labels)
        np.testing.assert_array_equal(points["ring"], frame.sweep.ring)
        assert 0 <= points["t"].min() <= points["t"].max() < 100_000_000


def test_imu_feels_gravity(log: Path) -> None:
    up = np.array(
        [
            [m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z]
            for t, _, m in messages(log)
            if t == "/imu"
        ]
    )
    assert np.linalg.norm(up[5:-5].mean(0)) == pytest.approx(9.81, abs=0.2)
    assert up[:, 2].mean() == pytest.approx(9.81, abs=0.2)


def test_our_reader_finds_the_roles(log: Path) -> None:
    inspection = inspect_log(log)
    streams = inspection["streams"]
    assert isinstance(streams, list)
    assert {"/lidar/points": "lidar", "/odometry": "pose", "/imu": "imu"}.items() <= {
        s["topic"]: s["role"] for s in streams
    }.items()
    assert inspection["problems"] == []


def test_truth_is_tum_with_nine_decimals(tmp_path: Path, trajectory: Trajectory) -> None:
    write_truth(tmp_path / "t.tum", trajectory.stamps_ns, trajectory.world_T_base)
    lines = (tmp_path / "t.tum").read_text().splitlines()
    assert lines[0].split()[0] == "1760000000.123456789"
    rows = np.array([[float(v) for v in line.split()[1:]] for line in lines])
    np.testing.assert_allclose(
        transform(rows[:, :3], rows[:, 3:]), trajectory.world_T_base, atol=1e-8
    )


def test_an_interrupted_write_leaves_nothing(
    tmp_path: Path, trajectory: Trajectory, frames: list[DriveFrame]
) -> None:
    def broken() -> Iterator[DriveFrame]:
        yield frames[0]
        raise RuntimeError("stop")

    for name in ("a.mcap", "a.bag"):
        with pytest.raises(RuntimeError, match="stop"):
            write_session(tmp_path / name, trajectory, broken())
    assert list(tmp_path.iterdir()) == []


def test_other_endings_are_refused(tmp_path: Path, trajectory: Trajectory) -> None:
    with pytest.raises(LogError, match=r"neither \.mcap nor \.bag"):
        write_session(tmp_path / "a.txt", trajectory, [])


def test_a_folder_that_is_not_there_is_an_error(tmp_path: Path, trajectory: Trajectory) -> None:
    for name in ("a.mcap", "a.bag"):
        with pytest.raises(LogError, match="cannot be written"):
            write_session(tmp_path / "nowhere" / name, trajectory, [])


def test_sessions_share_a_town_and_have_truth(tmp_path: Path) -> None:
    drives = Town(2), Route(2, 60), Sensor("vlp16", 0.5)
    truth = simulate_sessions(tmp_path, *drives)
    entries = json.loads(truth.read_text())
    assert entries == {f"session_{k}.mcap": {"trajectory": f"session_{k}.tum"} for k in (0, 1)}
    for k in (0, 1):
        poses = np.loadtxt(tmp_path / f"session_{k}.tum")
        assert np.linalg.norm(np.diff(poses[:, 1:4], axis=0), axis=1).sum() == pytest.approx(
            60, abs=8
        )
    with pytest.raises(SemlocError, match="already has"):
        simulate_sessions(tmp_path, *drives)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: Route(0),
        lambda: Route(length_m=float("nan")),
        lambda: Route(length_m=1e9),
        lambda: Sensor("sonar"),
        lambda: Sensor(rate_hz=0.0),
        lambda: Sensor(label_noise=2.0),
        lambda: Sensor(drift=0.3),
        lambda: Sensor(wet=1.1),
        lambda: Sensor(imu_hz=0.5),
        lambda: plan_sessions(Town(), Route(), "db3"),
        lambda: plan_sessions(Town(seasons=()), Route()),
        lambda: plan_sessions(Town(daytimes=("midnight",)), Route()),
    ],
)
def test_impossible_settings_are_refused(wrong: Callable[[], object]) -> None:
    with pytest.raises(SettingsError):
        wrong()


def test_an_unknown_format_writes_nothing(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="choose one of mcap"):
        simulate_sessions(tmp_path / "out", Town(), Route(), Sensor(), format="db3")
    assert not (tmp_path / "out").exists()


def test_the_demo_meets_itself_in_both_directions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = MODELS["vlp16"]
    monkeypatch.setitem(MODELS, "hdl32", few)
    files = simulate_demo(tmp_path)
    assert [f.name for f in files] == [
        "monday.mcap",
        "tuesday.bag",
        "monday.tum",
        "tuesday.tum",
        "truth.json",
    ]
    assert all(f.exists() for f in files)
    monday, tuesday = (np.loadtxt(tmp_path / f"{day}.tum") for day in ("monday", "tuesday"))
    for poses in (monday, tuesday):
        assert 35 < poses[-1, 0] - poses[0, 0] < 75
    a, b = (transform(p[::20, 1:4], p[::20, 4:]) for p in (monday, tuesday))
    relative = inverse(a)[:, None] @ b[None]
    is_near = np.linalg.norm(relative[..., :3, 3], axis=-1) < 8
    ahead = relative[..., 0, 0]
    assert (is_near & (ahead > 0.9)).any(0).sum() > 5
    assert (is_near & (ahead < -0.9)).any(0).sum() > 5


def test_interpolated_poses_match_the_frames(
    frames: list[DriveFrame], trajectory: Trajectory
) -> None:
    stamps_ns = np.array([f.stamp_ns for f in frames])
    np.testing.assert_allclose(
        interpolate(trajectory.stamps_ns, trajectory.world_T_base, stamps_ns),
        [f.world_T_base for f in frames],
        atol=1e-9,
    )
    np.testing.assert_allclose(frames[0].base_T_lidar, mounting(MODELS["vlp16"]))

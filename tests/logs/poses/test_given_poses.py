"""Sessions whose poses come from a file or from LIDAR odometry instead of a stream of the log."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Collection, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError
from semloc_logs.frames import Frame, Header, LidarFrame, NavSatSample, PoseSample, TransformSample
from semloc_logs.logs.log import Message, Reading, Section, Stream
from semloc_logs.logs.poses import lidar_odometry
from semloc_logs.logs.poses.lidar_odometry import LidarOdometry
from semloc_logs.logs.poses.trajectory_file import TrajectoryFile
from semloc_logs.logs.problems import Problem, lost, sentences
from semloc_logs.logs.session.session import Session, SessionOptions
from semloc_logs.numerics.transforms import inverse, yaw_transform

S = 1_000_000_000
EPOCH = 1_700_000_000 * S
MOUNT = yaw_transform(np.pi / 2, (1.0, 0.0, 2.0))  # base_T_lidar
POINTS = np.array([[5.0, 0.0, 0.0], [0.0, 7.0, 0.0]], np.float32)
TYPES: dict[type, str] = {
    LidarFrame: "sensor_msgs/msg/PointCloud2",
    TransformSample: "tf2_msgs/msg/TFMessage",
    PoseSample: "nav_msgs/msg/Odometry",
    NavSatSample: "sensor_msgs/msg/NavSatFix",
}


class FakeLog:
    """Frames in memory as a log."""

    def __init__(self, frames: list[Frame]) -> None:
        self._frames = sorted(frames, key=lambda f: f.header.log_time_ns)
        self.path = Path("drive.mcap")
        self.format = "mcap"
        self.encoding = "ros2"
        self.start_ns: int | None = self._frames[0].header.log_time_ns
        self.end_ns: int | None = self._frames[-1].header.log_time_ns
        self.problems: list[Problem] = []
        topics = [f.header.topic for f in frames]
        kinds = {f.header.topic: TYPES[type(f)] for f in frames}
        self.streams = [
            Stream(topic, kind, "cdr", topics.count(topic)) for topic, kind in sorted(kinds.items())
        ]

    def sections(self) -> list[Section]:
        return []

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        return iter(())

    def frames(
        self, topics: Collection[str] | None = None, reading: Reading | None = None
    ) -> Iterator[Frame]:
        return (f for f in self._frames if topics is None or f.header.topic in topics)

    def close(self) -> None:
        pass


def header(topic: str, seconds: float, frame_id: str) -> Header:
    stamp = EPOCH + round(seconds * S)
    return Header(topic, stamp, stamp, frame_id)


def sweeps(count: int, topic: str = "/points", many: int = 1) -> list[Frame]:
    return [
        LidarFrame(header(topic, 0.1 * k, "lidar"), np.tile(POINTS, (many, 1)))
        for k in range(count)
    ]


STATIC: Frame = TransformSample(header("/tf_static", 0.0, "base_link"), "lidar", MOUNT, static=True)


def tum(path: Path, seconds: Collection[float]) -> Path:
    """A vehicle at 1 m/s along x that starts at x = 10."""
    path.write_text("".join(f"{1_700_000_000 + t:.9f} {10 + t} 0 0 0 0 0 1\n" for t in seconds))
    return path


# -- files


def test_a_tum_file_gives_the_poses_of_the_base_frame(tmp_path: Path) -> None:
    poses = TrajectoryFile(tum(tmp_path / "a.tum", np.arange(0, 1.05, 0.05).tolist()))
    session = Session([FakeLog([STATIC, *sweeps(10)])], SessionOptions(poses=poses))
    clouds = list(session.clouds())
    assert len(clouds) == 10
    assert clouds[3].session_T_base is not None
    np.testing.assert_allclose(
        clouds[3].session_T_base, yaw_transform(0.0, (10.3, 0, 0)), atol=1e-9
    )
    np.testing.assert_allclose(clouds[3].points[0], [1.0, 5.0, 2.0], atol=1e-5)
    assert (session.base_frame, session.session_frame) == ("base_link", "trajectory")
    assert len(session.trajectory()[0]) == 21
    assert lost(session.problems) == []
    assert session.problems == []
    content = session.to_json()["pose_source"]
    assert isinstance(content, dict)
    assert (content["kind"], content["path"], content["fingerprint"]) == (
        "file",
        str(poses.path),
        poses.fingerprint(),
    )


def test_poses_of_a_named_frame(tmp_path: Path) -> None:
    source = TrajectoryFile(tum(tmp_path / "a.tum", [0.0, 0.5, 1.0]), frame="lidar")
    session = Session([FakeLog([STATIC, *sweeps(10)])], SessionOptions(poses=source))
    clouds = list(session.clouds())
    assert session.base_frame == "base_link"
    assert clouds[5].session_T_base is not None
    np.testing.assert_allclose(
        clouds[5].session_T_base, yaw_transform(0.0, (10.5, 0, 0)) @ inverse(MOUNT), atol=1e-9
    )
    wrong = Session(
        [FakeLog([STATIC, *sweeps(10)])],
        SessionOptions(poses=TrajectoryFile(source.path, frame="velodine")),
    )
    with pytest.raises(
        LogError,
        match=r"poses of 'velodine', but the log has no such frame: name one of base_link, lidar\.",
    ):
        list(wrong.clouds())


def test_a_file_that_covers_part_of_the_log(tmp_path: Path) -> None:
    source = TrajectoryFile(tum(tmp_path / "a.tum", np.arange(2, 4.05, 0.1).tolist()))
    session = Session([FakeLog([STATIC, *sweeps(100)])], SessionOptions(poses=source))
    clouds = list(session.clouds())
    stamps = [c.header.stamp_ns - EPOCH for c in clouds]
    # poses are continued for a tenth of a second
    assert (min(stamps), max(stamps)) == (19 * S // 10, 41 * S // 10)
    after, before = sentences(lost(session.problems))
    assert after.startswith("/points: 58 of 100 frames are left out: their stamps")
    assert "after the last pose" in after
    assert before.startswith("/points: 19 of 100 frames are left out: their stamps")
    assert "begin 2.00 s before the first pose" in before


def test_the_logs_own_poses_are_not_used_beside_a_file(tmp_path: Path) -> None:
    own: list[Frame] = [
        PoseSample(header(t, 0.1 * k, "odom"), "base_link", np.eye(4))
        for k in range(11)
        for t in ("/a/odom", "/b/odom")
    ]
    own += [
        TransformSample(header("/tf", 0.1 * k, "odom"), "base_link", np.eye(4), static=False)
        for k in range(11)
    ]
    source = TrajectoryFile(tum(tmp_path / "a.tum", [0.0, 0.5, 1.0]))
    session = Session([FakeLog([STATIC, *sweeps(10), *own])], SessionOptions(poses=source))
    clouds = list(session.clouds())
    assert len(clouds) == 10
    assert clouds[-1].session_T_base is not None
    assert clouds[-1].session_T_base[0, 3] == pytest.approx(10.9)


def test_kitti_lines_belong_to_the_frames_of_the_first_lidar(tmp_path: Path) -> None:
    path = tmp_path / "00.txt"
    path.write_text("".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(10)))
    session = Session(
        [FakeLog([STATIC, *sweeps(10), *sweeps(5, "/rear")])],
        SessionOptions(topics={"lidar": "/points,/rear"}, poses=TrajectoryFile(path)),
    )
    clouds = list(session.clouds())
    assert len(clouds) == 15
    for cloud in clouds:
        assert cloud.session_T_base is not None
        assert cloud.session_T_base[0, 3] == pytest.approx(
            (cloud.header.stamp_ns - EPOCH) / S * 10, abs=1e-6
        )


# -- odometry with a stand-in for KISS-ICP


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> Any:
    """An odometry that gives the sensor poses that the test puts into ``steps``."""
    made = SimpleNamespace(steps=[], calls=[], last_pose=np.eye(4))

    def register_frame(points: F64, offsets: F64) -> tuple[F64, F64]:
        made.calls.append((points, offsets))
        made.last_pose = made.steps[len(made.calls) - 1]
        return points, points

    made.register_frame = register_frame
    monkeypatch.setattr(lidar_odometry, "_kiss_icp", lambda *_: (made, "1.3.0"))
    return made


def along(*x: float) -> list[F64]:
    return [yaw_transform(0.0, (v, 0.0, 0.0)) for v in x]


def test_odometry_of_the_sensor_becomes_that_of_the_base(engine: Any) -> None:
    engine.steps = along(*(0.2 * np.arange(10)))
    session = Session([FakeLog([STATIC, *sweeps(10, many=60)])], SessionOptions(odometry="lidar"))
    clouds = list(session.clouds())
    assert len(clouds) == len(engine.calls) == 10
    for k, cloud in enumerate(clouds):
        assert cloud.session_T_base is not None
        # the sensor looks to the left of the base: its x is the base's y
        np.testing.assert_allclose(
            cloud.session_T_base, yaw_transform(0.0, (0.0, 0.2 * k, 0.0)), atol=1e-9
        )
    assert (session.base_frame, session.session_frame) == ("base_link", "lidar_odometry")
    assert session.problems == []
    assert session.to_json()["pose_source"] == {
        "kind": "lidar_odometry",
        "topic": "/points",
        "sweeps": 10,
        "kiss_icp": "1.3.0",
    }


def test_every_sweep_is_registered_and_its_pose_is_that_of_its_last_point(engine: Any) -> None:
    engine.steps = along(0.0, 0.1, 0.2)
    offsets = np.linspace(0, S // 10, 120).astype(np.int64)
    frames: list[Frame] = [
        LidarFrame(header("/points", 0.1 * k, "lidar"), np.tile(POINTS, (60, 1)), offset_ns=offsets)
        for k in range(3)
    ]
    session = Session([FakeLog(frames)], SessionOptions(odometry="lidar"))
    clouds = list(session.clouds())
    stamps, poses = session.trajectory()
    assert ((stamps - EPOCH) / S).tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(poses[:, 0, 3], [-0.1, 0.0, 0.1, 0.2], atol=1e-9)
    assert session.to_json()["sweeps_deskewed"] == 3
    assert engine.calls[0][1][[0, -1]].tolist() == [0.0, 1.0]
    # a point measured at the end of the sweep was seen from 0.1 m further on
    np.testing.assert_allclose(clouds[1].points[-1], [0.1, 7.0, 0.0], atol=2e-3)


def test_a_jump_ends_the_poses_and_is_named(engine: Any) -> None:
    engine.steps = along(*(0.1 * np.arange(6)), 5.0, *([5.0] * 20))
    session = Session([FakeLog([STATIC, *sweeps(20, many=60)])], SessionOptions(odometry="lidar"))
    clouds = list(session.clouds())
    assert len(engine.calls) == 7
    assert len(clouds) == 7  # the poses are continued for a tenth of a second
    assert any(
        "LIDAR odometry lost track at 2023-11-14T22:13:20.600Z" in problem
        for problem in sentences(lost(session.problems))
    )
    assert any(
        "13 of 20 frames are left out: their stamps" in problem and "after the last pose" in problem
        for problem in sentences(lost(session.problems))
    )


def test_a_sweep_that_does_not_lie_on_the_one_before_ends_the_poses(engine: Any) -> None:
    # within what a vehicle can do, but the points stay where they are
    engine.steps = along(0.0, 0.1, 0.2, 0.7, 1.2)
    made = LidarOdometry("/points", min_range=0.5, max_range=80.0)
    for frame in sweeps(5, many=60):
        made.take(frame)
    assert len(engine.calls) == 4
    assert "lost track at 2023-11-14T22:13:20.300Z" in sentences(made.problems)[0]


@pytest.mark.parametrize(
    "pose", [yaw_transform(1.5), np.full((4, 4), np.nan), yaw_transform(0.0, (30.0, 0, 0))]
)
def test_steps_that_no_vehicle_makes_are_jumps(engine: Any, pose: F64) -> None:
    engine.steps = [np.eye(4), pose]
    made = LidarOdometry("/points", min_range=0.5, max_range=80.0)
    for frame in sweeps(2, many=60):
        made.take(frame)
    assert made.is_over
    assert len(made.problems) == 1


def test_sparse_and_repeated_sweeps_are_counted(engine: Any) -> None:
    engine.steps = along(0.0, 0.1)
    made = LidarOdometry("/points", min_range=0.5, max_range=80.0)
    first, second = sweeps(2, many=60)
    for frame in (first, first, *sweeps(2), second):
        made.take(frame)
    made.finish()
    assert len(list(made.poses(lambda *_: None))) == 2
    assert sentences(made.problems) == [
        "/points: 3 sweeps are too sparse or out of order for LIDAR odometry and were left out."
    ]


def test_one_sweep_has_the_identity(engine: Any) -> None:
    engine.steps = [np.eye(4)]
    session = Session([FakeLog([STATIC, *sweeps(1, many=60)])], SessionOptions(odometry="lidar"))
    (cloud,) = session.clouds()
    assert cloud.session_T_base is not None
    np.testing.assert_allclose(cloud.session_T_base, np.eye(4), atol=1e-12)


def test_without_kiss_icp_the_error_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "kiss_icp", None)
    with pytest.raises(
        LogError,
        match=(
            r"install it with pip install 'semloc_logs\[odometry\]', or give "
            r"poses with --poses FILE"
        ),
    ):
        Session([FakeLog(sweeps(1))], SessionOptions(odometry="lidar"))


# -- KISS-ICP itself


@pytest.mark.skipif(
    importlib.util.find_spec("kiss_icp") is None, reason="the extra 'odometry' is not installed"
)
def test_kiss_icp_finds_a_known_motion_twice_the_same() -> None:
    """A sensor that drives through a box of walls with pillars."""
    rng = np.random.default_rng(3)
    faces = [np.c_[rng.uniform(-20, 20, (6000, 2)), np.full(6000, -1.5)]]
    for axis, side in ((0, -20.0), (0, 20.0), (1, -12.0), (1, 12.0)):
        wall = np.c_[
            rng.uniform(-20, 20, 4000), rng.uniform(-20, 20, 4000), rng.uniform(-1.5, 4, 4000)
        ]
        wall[:, axis] = side
        faces.append(wall)
    faces += [
        np.r_[x, y, 0] + rng.normal(0, 0.2, (400, 3)) * [1, 1, 5]
        for x, y in rng.uniform(-10, 10, (12, 2))
    ]
    world = np.concatenate(faces)
    truth = [yaw_transform(0.02 * k, (0.3 * k, 0.01 * k * k, 0.0)) for k in range(15)]
    frames = [
        LidarFrame(
            header("/points", 0.1 * k, "lidar"),
            ((world - pose[:3, 3]) @ pose[:3, :3]).astype(np.float32),
        )
        for k, pose in enumerate(truth)
    ]
    runs = []
    for _ in range(2):
        made = LidarOdometry("/points", min_range=0.5, max_range=60.0)
        for frame in frames:
            made.take(frame)
        made.finish()
        runs.append(np.array([pose for _, pose in made.poses(lambda *_: None)]))
        assert made.problems == []
    np.testing.assert_array_equal(runs[0], runs[1])
    np.testing.assert_allclose(runs[0][:, :3, 3], np.array(truth)[:, :3, 3], atol=0.05)


# -- fixes


def fix(k: int) -> Frame:
    return NavSatSample(header("/fix", 0.1 * k, "base_link"), 48.0, 11.0 + 1e-5 * k, 500.0, None)


def test_fixes_serve_where_there_is_nothing_else() -> None:
    frames: list[Frame] = [STATIC, *sweeps(40), *[fix(k) for k in range(41)]]
    session = Session([FakeLog(frames)])
    clouds = list(session.clouds())
    assert len(clouds) == 40
    assert clouds[20].session_T_base is not None
    # 1e-5 degrees are 0.746 m at 48 degrees north and 500 m
    np.testing.assert_allclose(
        clouds[20].session_T_base, yaw_transform(0.0, (20 * 0.746, 0, 0)), atol=0.02
    )
    assert (session.base_frame, session.session_frame) == ("base_link", "enu")
    own: list[Frame] = [
        PoseSample(header("/odom", 0.1 * k, "odom"), "base_link", np.eye(4)) for k in range(41)
    ]
    tf: list[Frame] = [
        TransformSample(header("/tf", 0.1 * k, "odom"), "base_link", np.eye(4), static=False)
        for k in range(41)
    ]
    for better in (own, tf):
        session = Session([FakeLog([*frames, *better])])
        assert len(list(session.clouds())) == 40
        assert session.session_frame == "odom"
        session = Session([FakeLog([*frames, *better])], SessionOptions(topics={"pose": "/fix"}))
        assert len(list(session.clouds())) == 40
        assert session.session_frame == "enu"

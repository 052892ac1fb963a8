"""Frames that wait for late poses and transforms, in bounded memory."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np
import pytest

from semloc_logs.frames import (
    Frame,
    LidarFrame,
)
from semloc_logs.logs.log import Reading
from semloc_logs.logs.problems import lost
from semloc_logs.logs.session.session import Session, SessionOptions
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.settings import Logs
from tests.logs.session.memory_log import (
    EPOCH,
    MOUNT,
    FakeLog,
    S,
    header,
    moving,
    odometry,
    static,
    sweep,
)


def test_frames_wait_for_late_poses_in_bounded_memory() -> None:
    frames: list[Frame] = [static("base_link", "lidar", MOUNT)]
    frames += [sweep(0.1 * k) for k in range(400)]
    frames += [odometry(0.1 * k, late=2.0) for k in range(401)]
    log = FakeLog(frames)
    session = Session([log])
    most = seen = 0
    for cloud in session.clouds():
        seen += 1
        assert cloud.session_T_base is not None
        assert cloud.session_T_base[0, 3] == pytest.approx(
            (cloud.header.stamp_ns - EPOCH) / S, abs=1e-6
        )
        most = max(most, len(session._pass.waiting))
    assert seen == 400
    assert most <= 30


def test_transforms_that_come_late() -> None:
    frames: list[Frame] = [
        *[sweep(0.1 * k) for k in range(30)],
        *[odometry(0.1 * k) for k in range(31)],
    ]
    frames.append(static("base_link", "lidar", MOUNT, seconds=2.0))
    session = Session([FakeLog(frames)])
    assert len(list(session.clouds())) == 30
    assert session.base_frame == "base_link"


def test_a_turning_sensor_waits_for_its_transform() -> None:
    frames: list[Frame] = [
        *[sweep(0.1 * k) for k in range(20)],
        *[odometry(0.1 * k) for k in range(21)],
    ]
    frames += [
        moving("base_link", "lidar", 0.1 * k, yaw_transform(0.1 * k), late=0.3) for k in range(21)
    ]
    clouds = list(Session([FakeLog(frames)]).clouds())
    assert len(clouds) == 20
    np.testing.assert_allclose(
        clouds[10].points[0], [5 * np.cos(1.0), 5 * np.sin(1.0), 0.0], atol=1e-5
    )


class WatchedLog(FakeLog):
    """Calls ``watch`` whenever a frame has been taken."""

    def watch(self) -> None:
        pass

    def frames(
        self, topics: Collection[str] | None = None, reading: Reading | None = None
    ) -> Iterator[Frame]:
        for frame in super().frames(topics, reading):
            yield frame
            self.watch()


def test_sweeps_without_a_pose_wait_for_seconds_only() -> None:
    """500 sweeps in 50 s: the ones of the last 10 s wait, 0.1 s apart."""
    log = WatchedLog([*[sweep(0.1 * k) for k in range(500)], odometry(1000.0)])
    session = Session([log])
    waiting: list[int] = []
    log.watch = lambda: waiting.append(len(session._pass.waiting))  # type: ignore[method-assign]
    assert list(session.clouds()) == []
    assert session.to_json()["frames"] == {
        "/points": {"seen": 500, "used": 0, "left_out": {"before the poses": 500}}
    }
    assert max(waiting) == 101


def test_sweeps_that_wait_take_a_part_of_the_memory_only() -> None:
    """A quarter of 64 MiB; 60 sweeps of 1 MiB come within a second."""
    points = np.ones(((1 << 20) // 12, 3), np.float32)
    sweeps = [LidarFrame(header("/points", k / 60, "lidar"), points) for k in range(60)]
    log = WatchedLog([static("base_link", "lidar", MOUNT), *sweeps, odometry(1000.0)])
    session = Session([log], SessionOptions(logs=Logs(memory=64 << 20)))
    nbytes: list[int] = []
    log.watch = lambda: nbytes.append(session._pass.waiting.nbytes)  # type: ignore[method-assign]
    assert list(session.clouds()) == []
    assert 15 << 20 < max(nbytes) <= 16 << 20


def test_four_lidars_wait_for_poses_that_are_recorded_a_second_late() -> None:
    """72 sweeps wait at once, each for its own pose."""
    topics = [f"/lidar_{k}/points" for k in range(4)]
    frames: list[Frame] = [static("base_link", "lidar", MOUNT)]
    frames += [sweep(k / 18, topic) for k in range(90) for topic in topics]
    frames += [odometry(0.05 * k, late=1.0) for k in range(101)]
    session = Session([FakeLog(frames)], SessionOptions(topics={"lidar": ",".join(topics)}))
    clouds = list(session.clouds())
    assert len(clouds) == 360
    for cloud in clouds:
        assert cloud.session_T_base is not None
        seconds = (cloud.header.stamp_ns - EPOCH) / S
        assert cloud.session_T_base[0, 3] == pytest.approx(seconds, abs=1e-6)
    assert lost(session.problems) == []

"""One drive in every format that logs can be simulated in: read back by our reader it is the same
drive.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semloc_logs.errors import LogError
from semloc_logs.logs.inspection.inspect import inspect_log
from semloc_logs.mapping.session_fusion import FuseTask, fuse_session
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse
from semloc_logs.settings import Settings
from semloc_logs.simulation.drive_plan import Route, Town
from semloc_logs.simulation.drives.drive import simulate_drive
from semloc_logs.simulation.drives.trajectory import drive, smooth_line
from semloc_logs.simulation.drives.vehicle_sensors import VehicleSensors
from semloc_logs.simulation.meshes.world import BUILDING, ROAD, MeshBuilder, World, box
from semloc_logs.simulation.output.drive_log import FORMATS, write_session
from semloc_logs.simulation.sensors.sensor import Sensor
from semloc_logs.simulation.sessions import simulate_sessions
from semloc_logs.voxels.store import Keyframe, read_keyframe
from semloc_logs.workspace import Workspace


def yard() -> World:
    builder = MeshBuilder(lambda x, y: 0 * x)
    builder.add(box(80.0, 24.0, 1.0, x=12.0, z=-1.0), ROAD, ground="none")
    for y in (-6.0, 6.0):
        builder.add(box(60.0, 1.0, 5.0, x=12.0, y=y), BUILDING, ground="none")
    return builder.build()


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    start = 1_760_000_000_123_456_789
    trajectory = drive(
        smooth_line(np.array([[0.0, 0], [16, 0]])),
        lambda x, y: 0 * x,
        np.random.default_rng(0),
        start_ns=start,
    )
    folder = tmp_path_factory.mktemp("formats")
    out = {}
    for name, suffix in FORMATS.items():
        out[name] = folder / f"{name}{suffix}"
        frames = simulate_drive(yard(), trajectory, Sensor("vlp16", 2.0, 300))
        write_session(
            out[name],
            trajectory,
            frames,
            format=name,
            sensors=VehicleSensors(imu_hz=100.0, outage_km=0.002),
        )
    return out


@pytest.mark.parametrize("name", list(FORMATS))
def test_our_reader_finds_the_roles_in_every_format(logs: dict[str, Path], name: str) -> None:
    inspection = inspect_log(logs[name])
    streams = inspection["streams"]
    assert isinstance(streams, list)
    roles = {s["topic"]: s["role"] for s in streams}
    pose = {"/tf": "tf"} if name == "protobuf" else {"/odometry": "pose", "/imu": "imu"}
    assert (
        pose | {"/lidar/points": "lidar", "/gnss": "gnss", "/tf_static": "tf_static"}
    ).items() <= roles.items()
    assert inspection["problems"] == []
    counts = {s["topic"]: s["count"] for s in streams}
    if name != "protobuf":
        assert counts["/imu"] > 4.5 * counts["/odometry"]


def fused(log: Path, folder: Path) -> tuple[SessionMap, list[Keyframe]]:
    session = Workspace(folder).session(log.stem)
    fuse_session(FuseTask((log,), session, Settings().resolved()))
    whole = SessionMap(session)
    return whole, [read_keyframe(session.keyframes, k) for k in range(len(whole.map_T_base))]


def test_every_format_fuses_to_the_same_keyframes(logs: dict[str, Path], tmp_path: Path) -> None:
    expected_map, expected = fused(logs["mcap"], tmp_path / "mcap")
    assert len(expected) >= 4
    for name in FORMATS:
        found_map, keyframes = fused(logs[name], tmp_path / name)
        np.testing.assert_array_equal(found_map.stamps_ns, expected_map.stamps_ns)
        for ours, theirs in zip(keyframes, expected, strict=True):
            np.testing.assert_allclose(ours.points, theirs.points, atol=1e-3)
            np.testing.assert_array_equal(ours.label, theirs.label)
        moved, true = (inverse(m.map_T_base[0]) @ m.map_T_base for m in (found_map, expected_map))
        np.testing.assert_allclose(moved, true, atol=1e-6)


def test_a_ros2_bag_is_a_directory_that_others_read(logs: dict[str, Path]) -> None:
    from rosbags.highlevel import AnyReader

    assert sorted(p.name for p in logs["ros2"].iterdir()) == ["metadata.yaml", "ros2.db3"]
    with AnyReader([logs["ros2"]]) as reader:
        fixes: list[Any] = [
            reader.deserialize(data, c.msgtype)
            for c, _, data in reader.messages()
            if c.topic == "/gnss"
        ]
    lost = [f for f in fixes if f.status.status < 0]
    known = [f for f in fixes if f.status.status >= 0]
    assert lost
    assert all(np.isnan(f.latitude) for f in lost)
    assert all(abs(f.latitude - 49.01) < 1e-3 and abs(f.longitude - 8.42) < 1e-3 for f in known)


def test_protobuf_messages_are_read_by_others(logs: dict[str, Path]) -> None:
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    with logs["protobuf"].open("rb") as stream:
        read = [
            (c.topic, m)
            for _, c, _, m in make_reader(
                stream, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages()
        ]
    clouds = [m for topic, m in read if topic == "/lidar/points"]
    assert [f.name for f in clouds[0].fields] == ["x", "y", "z", "label", "ring", "t"]
    assert len(clouds[0].data) % clouds[0].point_stride == 0
    edges = {
        (m.parent_frame_id, m.child_frame_id) for topic, m in read if topic in ("/tf", "/tf_static")
    }
    assert edges == {("odom", "base_link"), ("base_link", "lidar"), ("base_link", "gnss")}


def test_a_format_and_its_ending_belong_together(tmp_path: Path) -> None:
    trajectory = drive(
        smooth_line(np.array([[0.0, 0], [5, 0]])),
        lambda x, y: 0 * x,
        np.random.default_rng(0),
        start_ns=10**18,
    )
    with pytest.raises(LogError, match="ending of its format"):
        write_session(tmp_path / "a.bag", trajectory, [], format="protobuf")


def test_sessions_come_as_ros2_bags_and_are_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("semloc_logs.simulation.sessions.build_street", lambda *_: yard())
    for overwrite in (False, True):
        truth = simulate_sessions(
            tmp_path,
            Town(1),
            Route(1, 50),
            Sensor("vlp16", 0.2, drift=0.0, imu_hz=50.0),
            format="ros2",
            overwrite=overwrite,
        )
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "session_0",
        "session_0.tum",
        "truth.json",
    ]
    assert (tmp_path / "session_0" / "metadata.yaml").exists()
    assert truth.exists()

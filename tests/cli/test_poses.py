"""What `semloc fuse` and `run` say and do about poses that are missing, wrong, or come from
elsewhere; small logs, whole programs.
"""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner, Result
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

from semloc_logs.cli.main import program
from semloc_logs.mapping.session_fusion import FuseTask, fuse_session
from semloc_logs.settings import load
from semloc_logs.workspace import SessionFolder

S = 1_000_000_000
EPOCH = 1_700_000_000 * S
SPEED = 1.0  # m/s along x
STORE = get_typestore(Stores.ROS2_HUMBLE)
TIMES = [0.1 * k for k in range(30)]


def semloc(*args: object) -> Result:
    return CliRunner().invoke(program, [str(a) for a in args], prog_name="semloc")


def make(kind: str, **fields: Any) -> Any:
    return STORE.types[kind](**fields)


def header(seconds: float, frame_id: str) -> Any:
    stamp = EPOCH + round(seconds * S)
    return make(
        "std_msgs/msg/Header",
        stamp=make("builtin_interfaces/msg/Time", sec=stamp // S, nanosec=stamp % S),
        frame_id=frame_id,
    )


def odometry(seconds: float, x: float) -> Any:
    zero = make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    pose = make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=x, y=0.0, z=0.0),
        orientation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )
    twist = make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    return make(
        "nav_msgs/msg/Odometry",
        header=header(seconds, "odom"),
        child_frame_id="lidar",
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )


def cloud(seconds: float, x: float) -> Any:
    """Ground, two walls, and one across at x = 20, seen from x."""
    rng = np.random.default_rng(round(seconds * 10) + 1000)
    side = np.c_[
        rng.uniform(-15, 20, 1200), rng.choice([-4.0, 4.0], 1200), rng.uniform(-1, 3, 1200)
    ]
    ahead = np.c_[np.full(800, 20.0), rng.uniform(-4, 4, 800), rng.uniform(-1, 3, 800)]
    ground = np.c_[rng.uniform(-15, 20, 800), rng.uniform(-4, 4, 800), np.full(800, -1.0)]
    points = (np.concatenate([side, ahead, ground]) - [x, 0, 0]).astype("<f4")
    fields = [
        make("sensor_msgs/msg/PointField", name=n, offset=4 * k, datatype=7, count=1)
        for k, n in enumerate("xyz")
    ]
    size = points.nbytes
    return make(
        "sensor_msgs/msg/PointCloud2",
        header=header(seconds, "lidar"),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=12,
        row_step=size,
        data=points.reshape(-1).view(np.uint8),
        is_dense=True,
    )


def drive(
    path: Path,
    poses: Sequence[tuple[float, float]] = (),
    sweeps: Sequence[float] = TIMES,
    stamps: Sequence[float] | None = None,
) -> Path:
    """A log of odometry (time, x), and of sweeps at the times ``sweeps`` that carry ``stamps``;
    messages listed later are recorded later.
    """
    messages: list[tuple[float, str, Any]] = []
    for k, (t, x) in enumerate(poses):
        messages.append((0.1 * k + 0.01, "/odom", odometry(t, x)))
    for t, stamp in zip(sweeps, sweeps if stamps is None else stamps, strict=True):
        messages.append((t, "/points", cloud(stamp, SPEED * t)))
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}
        for seconds, topic, message in sorted(messages, key=lambda m: m[0]):
            kind = message.__msgtype__
            if topic not in channels:
                schema = writer.register_schema(
                    kind, "ros2msg", STORE.generate_msgdef(kind, ros_version=2)[0].encode()
                )
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            stamp = EPOCH + round(seconds * S)
            writer.add_message(
                channels[topic], stamp, bytes(STORE.serialize_cdr(message, kind)), stamp
            )
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def fuse(log: Path, *args: object) -> tuple[Result, dict[str, Any]]:
    work = log.parent / "work"
    done = semloc("fuse", log, "-w", work, "--set", "labels.source=uniform", *args)
    written = work / "sessions" / log.stem / "session.json"
    return done, json.loads(written.read_text()) if written.exists() else {}


GOOD = [(t, SPEED * t) for t in TIMES]


def test_a_good_log_is_0(tmp_path: Path) -> None:
    done, session = fuse(drive(tmp_path / "a.mcap", GOOD))
    assert done.exit_code == 0, done.stderr
    assert session["posed"]
    assert session["skipped"] == []
    assert session["pose_source"] == {"kind": "log"}
    assert "Warning" not in done.stderr
    assert (tmp_path / "work" / "sessions" / "a" / "map.png").exists()


@pytest.mark.parametrize(
    ("poses", "says"),
    [
        (GOOD[:15], "s after the last pose ("),
        ([*GOOD[:10], GOOD[9], *GOOD[10:]], "/odom: poses that are 1 repeated were left out."),
        (
            [*GOOD[:10], (-5.0, 0.0), (0.35, 0.0), *GOOD[10:]],
            "/odom: poses that are 2 back in time were left out.",
        ),
        (
            [*GOOD[:10], (3600.0, 0.0), *GOOD[10:]],
            "/odom: poses that are 1 far ahead in time were left out.",
        ),
        (
            [(t, 7.0) for t in TIMES],
            "/odom gives the same position all the time, but the surroundings move by",
        ),
        (
            [(t, 1e-5 * SPEED * t) for t in TIMES],
            "m in all: in another unit than metres, or never filled in, but the surroundings move",
        ),
    ],
    ids=["stop", "repeat", "back", "ahead", "stand", "degrees"],
)
def test_poses_that_make_no_sense_are_3_and_a_sentence(
    tmp_path: Path, poses: list[tuple[float, float]], says: str
) -> None:
    done, session = fuse(drive(tmp_path / "a.mcap", poses))
    assert done.exit_code == 3, done.stderr
    warnings = [line for line in done.stderr.splitlines() if line.startswith("Warning: ")]
    assert sum(says in line for line in warnings) == 1
    assert any(says in sentence for sentence in session["skipped"])


def test_a_failure_half_way_leaves_no_thread_and_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = SessionFolder(tmp_path / "a")
    settings = load(
        assignments={
            "labels.source": "uniform",
            "fusion.keyframe_distance": "0.05",
            "fusion.submap_length": "0.2",
        }
    ).resolved()

    def fails(*_: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr("semloc_logs.mapping.map_tables.write_blocks", fails)
    # which holds all that it passed through
    with pytest.raises(OSError, match="no space") as problem:
        fuse_session(FuseTask((drive(tmp_path / "a.mcap", GOOD),), folder, settings))
    assert problem.value
    assert not [t for t in threading.enumerate() if t.name == "semloc-prefetch"]
    assert list(folder.path.iterdir()) == []


def test_poses_beyond_what_a_map_reaches_are_1_and_a_sentence(tmp_path: Path) -> None:
    # odometry at zero until the satellites are found, then in UTM: the northing is more than voxels
    # have numbers for
    done, session = fuse(
        drive(tmp_path / "a.mcap", [(t, x + (5.3e6 if t > 0.45 else 0.0)) for t, x in GOOD])
    )
    assert done.exit_code == 1
    assert (
        "the poses have come 5300 km from the first at 2023-11-14T22:13:20.500Z, but a map of 0.3"
        " m voxels reaches 900 km" in done.stderr
    )
    assert not session
    done, _ = fuse(drive(tmp_path / "b.mcap", [(t, x + 5.3e6) for t, x in GOOD]))
    assert done.exit_code == 0, done.stderr


@pytest.mark.parametrize(
    ("stamps", "count"),
    [([*TIMES[:20], *[t - 10 for t in TIMES[20:]]], 10), ([*TIMES[:10], 3600.0, *TIMES[11:]], 1)],
    ids=["back", "ahead"],
)
def test_sweeps_whose_clock_jumps_are_3_and_a_sentence(
    tmp_path: Path, stamps: list[float], count: int
) -> None:
    done, session = fuse(drive(tmp_path / "a.mcap", GOOD, stamps=stamps))
    assert done.exit_code == 3, done.stderr
    assert f"/points: {count} of 30 frames are left out: " in done.stderr
    assert session["frames"]["/points"]["used"] == 30 - count


def test_no_poses_is_0_with_a_note(tmp_path: Path) -> None:
    done, session = fuse(drive(tmp_path / "a.mcap"))
    assert done.exit_code == 0, done.stderr
    assert "a: The log has no pose stream" in done.stderr
    assert "--odometry lidar" in done.stderr
    assert "--poses FILE" in done.stderr
    assert not session["posed"]
    assert (tmp_path / "work" / "sessions" / "a" / "map.png").exists()


def tum(path: Path, x0: float = 0.0) -> Path:
    path.write_text(
        "# stamp x y z qx qy qz qw\n"
        + "".join(
            f"{1_700_000_000 + int(t)}.{round(t * S) % S:09d} {x0 + SPEED * t:.3f} 0 0 0 0 0 1\n"
            for t in TIMES
        )
    )
    return path


def test_a_trajectory_makes_a_map_and_is_part_of_the_fingerprint(tmp_path: Path) -> None:
    log = drive(tmp_path / "a.mcap")
    poses = tum(tmp_path / "a.tum", 100.0)
    done, session = fuse(log, "--poses", poses)
    assert done.exit_code == 0, done.stderr
    assert session["posed"]
    assert session["pose_source"]["path"] == str(poses)
    assert session["voxels"] > 1000
    trajectory = pq.read_table(tmp_path / "work/sessions/a/trajectory.parquet").to_pydict()
    assert trajectory["stamp_ns"] == [EPOCH + round(t * S) for t in TIMES]
    assert trajectory["t_x"][:2] == pytest.approx([100.0, 100.1])
    again, _ = fuse(log, "--poses", poses)
    assert "Done before: a" in again.stdout
    tum(poses, 200.0)
    refused, _ = fuse(log, "--poses", poses)
    assert refused.exit_code == 1
    assert "Session 'a' was made with other poses" in refused.stderr
    changed, _ = fuse(log, "--poses", poses, "--overwrite")
    assert "Fused: a" in changed.stdout
    trajectory = pq.read_table(tmp_path / "work/sessions/a/trajectory.parquet").to_pydict()
    assert trajectory["t_x"][0] == pytest.approx(200.0)
    framed, _ = fuse(log, "--poses", poses, "--pose-frame", "camera", "--overwrite")
    assert framed.exit_code == 1
    assert "the log has no such frame: name one of lidar." in framed.stderr


def test_kitti_poses_with_and_without_times(tmp_path: Path) -> None:
    log = drive(tmp_path / "a.mcap")
    poses = tmp_path / "00.txt"
    times = tmp_path / "times.txt"
    poses.write_text("".join(f"1 0 0 {SPEED * t} 0 1 0 0 0 0 1 0\n" for t in TIMES))
    times.write_text("".join(f"{t:.6e}\n" for t in TIMES))
    one, session = fuse(log, "--poses", poses)
    two, timed = fuse(log, "--poses", poses, "--pose-times", times, "--overwrite")
    assert (one.exit_code, two.exit_code) == (0, 0), one.stderr + two.stderr
    assert session["poses"] == timed["poses"]
    assert session["fingerprint"] != timed["fingerprint"]
    poses.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    short, _ = fuse(log, "--poses", poses, "--overwrite")
    assert short.exit_code == 1
    assert "has 1 poses without stamps but /points has 30 frames" in short.stderr


def test_a_bad_trajectory_is_1_with_file_and_line(tmp_path: Path) -> None:
    log = drive(tmp_path / "a.mcap")
    poses = tmp_path / "a.tum"
    poses.write_text("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0\n")
    done, _ = fuse(log, "--poses", poses)
    assert done.exit_code == 1
    assert f"Error: {poses}, line 2 has 7 numbers" in done.stderr
    missing, _ = fuse(log, "--poses", tmp_path / "none.tum")
    assert missing.exit_code == 1
    assert "none.tum cannot be read" in missing.stderr


def test_which_session_a_trajectory_belongs_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict[str, Any] = {}

    def run(sessions: Any, *_: Any, **__: Any) -> Any:
        seen.update({session.name: session.poses for session in sessions})
        raise SystemExit(9)

    monkeypatch.setattr("semloc_logs.stages.run.run", run)
    logs = ("run", tmp_path / "a.mcap", tmp_path / "b.bag", "-w", tmp_path / "w")
    assert semloc(*logs, "--poses", "x.tum").exit_code == 2
    assert semloc(*logs, "--poses", "c=x.tum").exit_code == 2
    assert semloc(*logs, "--poses", "a=x.tum", "--poses", "a=y.tum").exit_code == 2
    assert semloc(*logs, "--pose-times", "a=x.txt").exit_code == 2
    assert semloc(*logs, "--pose-frame", "imu").exit_code == 2
    assert seen == {}
    assert (
        semloc(
            *logs,
            "--poses",
            "a=x.tum",
            "--poses",
            "b=y=z.txt",
            "--pose-times",
            "b=t.txt",
            "--pose-frame",
            "imu",
        ).exit_code
        == 9
    )
    assert {n: (str(t.path), t.times and str(t.times), t.frame) for n, t in seen.items()} == {
        "a": ("x.tum", None, "imu"),
        "b": ("y=z.txt", "t.txt", "imu"),
    }


def test_odometry_is_a_setting_and_says_what_it_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "kiss_icp", None)
    log = drive(tmp_path / "a.mcap")
    for args in (["--odometry", "lidar"], ["--set", "fusion.odometry=lidar"]):
        done, _ = fuse(log, *args)
        assert done.exit_code == 1
        assert "pip install 'semloc_logs[odometry]'" in done.stderr
    assert semloc("fuse", log, "-w", tmp_path / "w", "--odometry", "visual").exit_code == 2

"""Trajectories from files: exact stamps, both formats, errors with their line, and sessions."""

from __future__ import annotations

import os
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError
from semloc_logs.frames import Frame, Header, LidarFrame
from semloc_logs.logs.poses.trajectory_file import (
    FilePoses,
    Trajectory,
    TrajectoryFile,
    read_trajectory,
    seconds_to_ns,
)

TUM_LINE = "{stamp} 1 2 3 0 0 0.6 0.8"


def file(folder: Path, text: str, name: str = "poses.txt") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def read(folder: Path, text: str, times: str | None = None) -> Trajectory:
    return read_trajectory(
        TrajectoryFile(
            file(folder, text), None if times is None else file(folder, times, "times.txt")
        )
    )


def kitti(pose: F64) -> str:
    return " ".join(f"{x:.9e}" for x in pose[:3].ravel())


def test_tum_with_comments_and_blank_lines(tmp_path: Path) -> None:
    trajectory = read(
        tmp_path,
        f"# stamp tx ty tz qx qy qz qw\n\n{TUM_LINE.format(stamp='1.5')}\n"
        f"{TUM_LINE.format(stamp='2')} # end\n",
    )
    assert trajectory.stamps_ns is not None
    assert trajectory.stamps_ns.tolist() == [1_500_000_000, 2_000_000_000]
    np.testing.assert_allclose(trajectory.poses[0][:3, 3], [1, 2, 3])
    # a quaternion of z = 0.6, w = 0.8 turns x to (1 - 2 z^2, 2 z w)
    np.testing.assert_allclose(trajectory.poses[0][:3, 0], [0.28, 0.96, 0.0], atol=1e-12)


def test_stamps_are_exact_where_floats_are_not(tmp_path: Path) -> None:
    text = "1700000000.123456789"
    assert round(float(text) * 1e9) != 1_700_000_000_123_456_789  # what the test is about
    trajectory = read(tmp_path, TUM_LINE.format(stamp=text))
    assert trajectory.stamps_ns is not None
    assert trajectory.stamps_ns.tolist() == [1_700_000_000_123_456_789]


@given(st.integers(-(10**18), 3 * 10**18))
def test_nanoseconds_survive_as_decimals(stamp_ns: int) -> None:
    assert seconds_to_ns(str(Decimal(stamp_ns).scaleb(-9)), Path("x"), 1) == stamp_ns


@pytest.mark.parametrize(
    "text", ["nan", "inf", "1e99999999", "x", "1700000000123456789", "1,5", "-9e99"]
)
def test_text_that_is_not_a_time(text: str) -> None:
    with pytest.raises(LogError, match=r"x.tum, line 7: '.*' is not a time in seconds\."):
        seconds_to_ns(text, Path("x.tum"), 7)


def test_kitti_round_trip_with_and_without_times(tmp_path: Path) -> None:
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = Rotation.random(5, random_state=1).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(1).normal(0, 100, (5, 3))
    text = "\n".join(map(kitti, poses))
    bare = read(tmp_path, text)
    assert bare.stamps_ns is None
    np.testing.assert_allclose(bare.poses, poses, atol=1e-6)
    timed = read(tmp_path, text, "0\n0.1\n0.2\n0.3\n0.4000000001\n")
    assert timed.stamps_ns is not None
    assert timed.stamps_ns.tolist() == [0, 100_000_000, 200_000_000, 300_000_000, 400_000_000]
    assert timed.is_relative
    assert not read(tmp_path, text, "5\n5.1\n5.2\n5.3\n5.4\n").is_relative


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "poses.txt has no poses"),
        ("# nothing\n", "poses.txt has no poses"),
        ("1 2 3\n", r"line 1 has 3 numbers: give a file with 8 \(TUM\) or 12"),
        (
            TUM_LINE.format(stamp=1) + "\n1 2 3\n",
            "line 2 has 3 numbers: give a file with 8 numbers like the lines before",
        ),
        (
            "# a\n" + TUM_LINE.format(stamp=1) + "\n2 1 x 3 0 0 0 1\n",
            "line 3 has a word that is not a number",
        ),
        (
            TUM_LINE.format(stamp=1) + "\n2 1 nan 3 0 0 0 1\n",
            "line 2 has a word that is not a number",
        ),
        ("1 1 2 3 0 0 0 0\n", "line 1: the quaternion .* has the length 0, not 1"),
        (
            "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 2 0\n",
            "line 2: the 3 x 3 part is not a rotation",
        ),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", "line 1: the 3 x 3 part is not a rotation"),
        ("1e200 0 0 0 0 1e200 0 0 0 0 1e200 0\n", "line 1: the 3 x 3 part is not a rotation"),
        ("1 " * 5000, "line 1 is longer than 4096 characters"),
    ],
)
def test_bad_files_are_one_sentence_with_the_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(LogError, match=message) as caught:
        read(tmp_path, text)
    assert str(tmp_path / "poses.txt") in str(caught.value)


def test_other_bad_files(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="cannot be read"):
        read_trajectory(TrajectoryFile(tmp_path / "none"))
    with pytest.raises(LogError, match="cannot be read"):
        TrajectoryFile(tmp_path / "none").fingerprint()
    (tmp_path / "binary").write_bytes(bytes(range(256)) * 10)
    with pytest.raises(LogError, match="is not text"):
        read_trajectory(TrajectoryFile(tmp_path / "binary"))
    with pytest.raises(LogError, match="cannot be read"):
        read_trajectory(TrajectoryFile(tmp_path))
    with pytest.raises(LogError, match="leave --pose-times"):
        read(tmp_path, TUM_LINE.format(stamp=1), "1\n")
    with pytest.raises(LogError, match=r"times.txt has 2 times but .* has 1 poses"):
        read(tmp_path, kitti(np.eye(4)), "1\n2\n")
    with pytest.raises(LogError, match=r"times.txt, line 1 has 2 numbers"):
        read(tmp_path, kitti(np.eye(4)), "1 2\n")


def test_the_fingerprint_is_that_of_content_and_frame(tmp_path: Path) -> None:
    one = TrajectoryFile(file(tmp_path, "a", "a"))
    assert one.fingerprint() == TrajectoryFile(file(tmp_path, "a", "b")).fingerprint()
    assert one.fingerprint() != TrajectoryFile(file(tmp_path, "b", "b")).fingerprint()
    assert one.fingerprint() != TrajectoryFile(one.path, frame="imu").fingerprint()
    assert one.fingerprint() != TrajectoryFile(one.path, times=one.path).fingerprint()


def sweep(stamp_ns: int) -> Frame:
    return LidarFrame(Header("/points", stamp_ns, stamp_ns, "lidar"), np.ones((3, 3), np.float32))


def given_by(source: FilePoses) -> list[int]:
    return [stamp for stamp, _ in source.poses(lambda *_: None)]


def test_kitti_lines_take_the_stamps_of_the_frames(tmp_path: Path) -> None:
    text = "\n".join([kitti(np.eye(4))] * 3)
    source = FilePoses(TrajectoryFile(file(tmp_path, text)), "/points", 3)
    assert given_by(source) == []
    source.take(sweep(100))
    assert given_by(source) == [100]
    source.take(sweep(200))
    with pytest.raises(LogError, match="Only 2 of 3 frames of /points can be read"):
        source.finish()
    source.take(sweep(250))
    assert given_by(source) == [200, 250]
    assert source.is_over
    source.finish()
    with pytest.raises(
        LogError, match=r"has 3 poses without stamps but /points has 4 frames: .*--pose-times FILE"
    ):
        FilePoses(TrajectoryFile(file(tmp_path, text)), "/points", 4)


def test_times_from_zero_count_from_the_first_frame(tmp_path: Path) -> None:
    source = FilePoses(
        TrajectoryFile(
            file(tmp_path, "\n".join([kitti(np.eye(4))] * 2)),
            file(tmp_path, "0.0\n0.5\n", "times.txt"),
        ),
        "/points",
        9,
    )
    assert given_by(source) == []
    assert not source.is_over
    source.take(sweep(7_000_000_000))
    assert given_by(source) == [7_000_000_000, 7_500_000_000]
    assert source.is_over
    assert given_by(source) == []


def test_a_pipe_is_refused_because_it_cannot_be_read_twice(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.tum")
    for path in (tmp_path / "pipe.tum", Path("/dev/zero"), tmp_path):
        with pytest.raises(LogError, match="is not a regular file"):
            TrajectoryFile(path).fingerprint()

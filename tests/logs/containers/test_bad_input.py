"""Logs with one fault each: skipped data are counted and named, the rest is used.

Nothing is allocated for a claim.
"""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray

from semloc_logs.cli.main import program
from semloc_logs.errors import LogError
from semloc_logs.logs.inspection.inspect import inspect_log
from semloc_logs.logs.messages.definitions import UndecodableError
from semloc_logs.logs.messages.image_codecs import decode_compressed, decode_compressed_depth
from semloc_logs.logs.problems import lost, sentences
from semloc_logs.logs.session.session import Session, open_session
from semloc_logs.numerics.transforms import yaw_transform

S = 1_000_000_000
EPOCH = 1_700_000_000 * S
XYZ = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])


def rows(dtype: Any = XYZ, count: int = 60) -> NDArray[np.void]:
    """Points on a wall 5 m ahead."""
    points = np.zeros(count, dtype)
    points["x"], points["y"], points["z"] = 5, np.arange(count), 1
    return points


def stage(log: Any, seconds: float = 2.0) -> None:
    """Transforms and poses."""
    log.transform("base_link", "lidar", np.eye(4), EPOCH - S)
    for k in range(round(20 * seconds)):
        log.pose(EPOCH + k * S // 20, yaw_transform(0.0, (0.1 * k, 0.0, 0.0)))


def all_of(log: Any) -> tuple[list[Any], Session]:
    session = open_session([log.write()])
    return list(session.clouds()), session


def good_and_bad(
    log: Any, bad: Callable[[int], None], good: int = 3, bads: int = 2
) -> tuple[list[Any], list[str]]:
    stage(log)
    for k in range(good):
        log.cloud("/points", EPOCH + k * S // 5, "lidar", rows())
    for k in range(bads):
        bad(EPOCH + (k + good) * S // 5)
    clouds, session = all_of(log)
    return clouds, sentences(lost(session.problems))


@pytest.mark.parametrize("kind", ["ros2", "ros1"])
@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"width": 61}, "61 x 1 points of 12 bytes need 732 bytes, but it has 720"),
        ({"width": 2**31, "height": 2**31 - 1}, "points of 12 bytes need"),
        ({"point_step": 0}, "its field x ends at byte 4, but a point has 0 bytes"),
        ({"point_step": 8}, "its field z ends at byte 12, but a point has 8 bytes"),
        ({"point_step": 16}, "60 x 1 points of 16 bytes need 960 bytes, but it has 720"),
        (
            {"height": 6, "width": 10, "row_step": 121},
            "10 x 6 points of 12 bytes need 725 bytes, but it has 720",
        ),
        ({"data": np.zeros(0, np.uint8)}, "need 720 bytes, but it has 0"),
        ({"fields": []}, "it has no field x"),
    ],
)
def test_layouts_that_do_not_fit(
    recorder: Any, kind: str, changes: dict[str, Any], reason: str
) -> None:
    log = recorder(kind)
    clouds, skipped = good_and_bad(
        log, lambda stamp: log.cloud("/points", stamp, "lidar", rows(), **changes)
    )
    assert len(clouds) == 3
    [sentence] = skipped
    assert sentence.startswith(
        "/points: 2 messages skipped; the first because sensor_msgs/msg/PointCloud2 at log time "
    )
    assert any(part in sentence for part in reason.split("|"))


@pytest.mark.parametrize("type_", ["i2", "u4", "i1"])
def test_whole_numbers_are_not_positions(recorder: Any, type_: str) -> None:
    log = recorder()
    whole = rows([(axis, f"<{type_}") for axis in "xyz"])
    clouds, skipped = good_and_bad(log, lambda stamp: log.cloud("/points", stamp, "lidar", whole))
    assert len(clouds) == 3
    assert f"its field x is {np.dtype(type_).name}, not floating point" in skipped[0]


@pytest.mark.parametrize("kind", ["ros2", "ros1", "protobuf"])
def test_double_positions_are_read(recorder: Any, kind: str) -> None:
    log = recorder(kind)
    double = rows([("z", "<f8"), ("x", "<f8"), ("y", "<f8")])
    clouds, skipped = good_and_bad(log, lambda stamp: log.cloud("/points", stamp, "lidar", double))
    assert (len(clouds), skipped) == (5, [])
    np.testing.assert_array_equal(clouds[-1].points, clouds[0].points)


def test_big_endian_and_padded_clouds_are_read(recorder: Any) -> None:
    log = recorder()
    big = np.frombuffer(rows().astype(XYZ.newbyteorder(">")).tobytes(), np.uint8)
    padded = np.full((6, 12 * 10 + 7), 255, np.uint8)
    padded[:, :120] = np.frombuffer(rows().tobytes(), np.uint8).reshape(6, 120)
    layout = {"height": 6, "width": 10, "row_step": 127, "data": padded.reshape(-1)}
    stage(log)
    log.cloud("/points", EPOCH, "lidar", rows())
    log.cloud("/points", EPOCH + S // 5, "lidar", rows(), is_bigendian=True, data=big)
    log.cloud("/points", EPOCH + 2 * S // 5, "lidar", rows(), **layout)
    clouds, session = all_of(log)
    assert session.problems == []
    assert len(clouds) == 3
    for cloud in clouds[1:]:
        np.testing.assert_array_equal(cloud.points, clouds[0].points)


def test_points_that_are_no_numbers_are_counted(recorder: Any) -> None:
    def holes(stamp: int, *, is_dense: bool) -> None:
        points = rows()
        points["x"][3], points["y"][4], points["z"][5:7] = np.nan, np.inf, -np.inf
        log.cloud("/points", stamp, "lidar", points, is_dense=is_dense)

    log = recorder()
    clouds, skipped = good_and_bad(log, lambda stamp: holes(stamp, is_dense=True))
    assert [len(c.points) for c in clouds] == [60, 60, 60, 56, 56]
    assert skipped == [
        "/points: 8 of 300 points are left out: they are not finite, although "
        "their clouds call themselves dense."
    ]
    log = recorder(name="honest")
    assert good_and_bad(log, lambda stamp: holes(stamp, is_dense=False))[1] == []


def test_clouds_of_nothing_are_counted(recorder: Any) -> None:
    nothing = rows()
    nothing["x"] = np.nan
    log = recorder()
    clouds, skipped = good_and_bad(
        log,
        lambda stamp: log.cloud(
            "/points", stamp, "lidar", nothing[:0] if stamp % S else nothing, is_dense=False
        ),
    )
    assert len(clouds) == 3
    assert skipped == [
        "/points: 2 of 5 frames are left out: they hold no points, or none whose "
        "position is a number."
    ]


def test_inspect_and_fuse_name_it_and_exit_with_3(recorder: Any, tmp_path: Path) -> None:
    log = recorder()
    stage(log)
    for k in range(5):
        log.cloud(
            "/points", EPOCH + k * S // 5, "lidar", rows(), **({"width": 61} if k == 0 else {})
        )
    path = log.write()
    for args in (["inspect", str(path)], ["fuse", str(path), "-w", str(tmp_path / "w")]):
        done = CliRunner().invoke(program, args)
        assert done.exit_code == 3, done.output
        assert (
            "/points: 1 message skipped; sensor_msgs/msg/PointCloud2 at log time"
            in done.output.replace("\n", " ").replace("  ", " ")
        )


# -- depth


def depth_log(
    log: Any,
    pictures: list[NDArray[Any]],
    encoding: str,
    *,
    info: tuple[int, int, float] = (8, 6, 5.0),
) -> None:
    stage(log)
    log.camera_info("/cam/depth/camera_info", EPOCH, "lidar", *info)
    for k, picture in enumerate(pictures):
        log.picture("/cam/depth/image", EPOCH + k * S // 10, "lidar", picture, encoding)


def test_depth_values_that_are_none(recorder: Any) -> None:
    whole = np.full((6, 8), 2000, np.uint16)
    whole[0, :4] = 0, 65535, 0, 65535
    real = np.full((6, 8), 2.0, np.float32)
    real[0, :6] = np.nan, np.inf, -np.inf, -2.0, 0.0, 1e38
    for encoding, picture, missing in (("16UC1", whole, 4), ("32FC1", real, 6)):
        log = recorder(name=encoding)
        depth_log(log, [picture, picture], encoding)
        clouds, session = all_of(log)
        assert [len(c.points) for c in clouds] == [48 - missing] * 2
        assert lost(session.problems) == []
    log = recorder(name="nothing")
    depth_log(log, [np.full((6, 8), 65535, np.uint16), whole], "16UC1")
    clouds, session = all_of(log)
    assert len(clouds) == 1
    assert sentences(lost(session.problems)) == [
        "/cam/depth/image: 1 of 2 frames are left out: they have no points within the range limits."
    ]


def test_a_calibration_of_another_size(recorder: Any) -> None:
    log = recorder()
    depth_log(log, [np.full((6, 8), 2000, np.uint16)] * 3, "16UC1", info=(16, 12, 5.0))
    clouds, session = all_of(log)
    assert clouds == []
    assert len(sentences(lost(session.problems))) == 2
    assert sentences(lost(session.problems))[0].startswith(
        "CameraInfo /cam/depth/camera_info is for 16 x 12 pixels but the depth image has 8 x 6"
    )
    assert (
        sentences(lost(session.problems))[1]
        == "/cam/depth/image: 3 of 3 frames are left out: their CameraInfo cannot be used."
    )


@pytest.mark.parametrize("kind", ["ros2", "ros1"])
def test_a_calibration_of_zeros(recorder: Any, kind: str) -> None:
    log = recorder(kind)
    depth_log(log, [np.full((6, 8), 2000, np.uint16)] * 3, "16UC1", info=(8, 6, 0.0))
    clouds, session = all_of(log)
    assert clouds == []
    assert (
        "/cam/depth/camera_info: 1 message skipped; sensor_msgs/msg/CameraInfo"
        in sentences(lost(session.problems))[0]
    )
    assert (
        "its camera is not calibrated (the focal length is zero)"
        in sentences(lost(session.problems))[0]
    )
    assert sentences(lost(session.problems))[1].startswith(
        "/cam/depth/image: 3 of 3 frames are left out: no CameraInfo"
    )


# -- time


def test_one_pose_from_the_future_does_not_end_the_poses(recorder: Any) -> None:
    for name, stamp in (("future", 2_100_000_000 * S), ("hour", EPOCH + 3600 * S), ("past", 5 * S)):
        log = recorder(name=name)
        stage(log)
        log.pose(stamp, np.eye(4), log_time_ns=EPOCH + S // 2 + 1)
        for k in range(8):
            log.cloud("/points", EPOCH + k * S // 5, "lidar", rows())
        clouds, session = all_of(log)
        assert len(clouds) == 8, name
        assert all(c.session_T_base is not None for c in clouds)
        assert any("1 " in p and "pose" in p.lower() for p in sentences(session.problems)), (
            sentences(session.problems)
        )


def test_sweeps_with_impossible_times_are_counted(recorder: Any) -> None:
    log = recorder()
    stage(log)
    for k in range(8):
        stamp = {2: 0, 3: 2_100_000_000 * S, 5: EPOCH - 86400 * S}.get(k, EPOCH + k * S // 5)
        log.cloud("/points", stamp, "lidar", rows(), late_ns=EPOCH + k * S // 5 - stamp)
    clouds, session = all_of(log)
    assert len(clouds) == 5
    after, before = sentences(lost(session.problems))
    assert after.startswith("/points: 1 of 8 frames are left out: their stamps (2036-07-18")
    assert "after the last pose (2023-11-14" in after
    assert before.startswith("/points: 2 of 8 frames are left out: their stamps (1970-01-01")
    assert "begin 53.9 years before the first pose (2023-11-14" in before


def test_a_clock_that_is_set_back(recorder: Any) -> None:
    log = recorder()
    log.transform("base_link", "lidar", np.eye(4), EPOCH - S)
    for k in range(80):  # after two seconds the clock starts at 1970
        t = k * S // 20
        stamp = EPOCH + t if k < 40 else t
        log.pose(stamp, yaw_transform(0.0, (0.1 * k, 0.0, 0.0)), log_time_ns=EPOCH + t)
        if k % 4 == 0:
            log.cloud("/points", stamp, "lidar", rows(), late_ns=EPOCH + t - stamp)
    clouds, session = all_of(log)
    assert 10 <= len(clouds) <= 20
    assert sentences(lost(session.problems))
    assert any("back in time" in p for p in sentences(session.problems))


def test_poses_that_stop(recorder: Any) -> None:
    log = recorder()
    stage(log, seconds=1.0)
    for k in range(40):
        log.cloud("/points", EPOCH + k * S // 10, "lidar", rows())
    clouds, session = all_of(log)
    assert 10 <= len(clouds) <= 12
    assert sentences(lost(session.problems))[0].startswith(
        f"/points: {40 - len(clouds)} of 40 frames are left out: their stamps (2023"
    )
    assert "after the last pose (2023-11-14T22:13:20.950Z)" in sentences(lost(session.problems))[0]


def test_one_bad_transform_does_not_cost_its_message(recorder: Any) -> None:
    log = recorder()
    log.transform("base_link", "lidar", np.eye(4), EPOCH - S)
    log.transform("base_link", "camera", np.eye(4), EPOCH - S)
    (_, _, good), (_, _, bad) = log.events
    bad.transforms[0].transform.rotation.w = 0.0
    good.transforms.insert(0, bad.transforms[0])
    del log.events[1]
    for k in range(20):
        log.pose(EPOCH + k * S // 20, np.eye(4))
    log.cloud("/points", EPOCH, "lidar", rows())
    clouds, session = all_of(log)
    assert len(clouds) == 1
    assert session.base_frame == "base_link"
    [sentence] = sentences(lost(session.problems))
    assert "1 of its 2 transforms cannot be used (the quaternion of its pose is zero)" in sentence


def test_euler_angles_in_place_of_a_quaternion_are_named(recorder: Any) -> None:
    log = recorder()
    log.transform("base_link", "lidar", np.eye(4), EPOCH - S)
    for k in range(20):
        log.pose(EPOCH + k * S // 20, np.eye(4))
        rotation = log.events[-1][2].pose.pose.orientation
        rotation.z = 0.02 * k
        rotation.w = 0.0 if k >= 2 else 1.0
    log.cloud("/points", EPOCH, "lidar", rows())
    _, session = all_of(log)
    [sentence] = sentences(lost(session.problems))
    assert "18 messages skipped" in sentence
    assert "has the length 0.04 and not 1: it is not a rotation; are these Euler" in sentence


# -- claims


def png_head(width: int, height: int, depth: int = 8, colour: int = 2, body: bytes = b"") -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content))
            + kind
            + content
            + struct.pack(">I", zlib.crc32(kind + content))
        )

    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(body))
        + chunk(b"IEND", b"")
    )


def jpeg_head(width: int, height: int) -> bytes:
    data = bytearray(np.array(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1]).tobytes())
    start = data.index(b"\xff\xc0")
    data[start + 5 : start + 9] = struct.pack(">HH", height, width)
    return bytes(data)


BOMBS = {
    "png": ("png", png_head(100_000, 100_000)),
    "png of many bits": ("png", png_head(8000, 8000, 16, 6, bytes(40_000_000))),
    "png 2^31": ("png", png_head(2**31 - 1, 2**31 - 1, 16, 6)),
    "png chunk": (
        "png",
        png_head(8, 8).replace(
            struct.pack(">I", len(zlib.compress(b""))) + b"IDAT", b"\x41\0\0\0IDAT"
        ),
    ),
    "jpeg": ("jpeg", jpeg_head(65_000, 65_000)),
    "rvl": ("16UC1; compressedDepth rvl", struct.pack("<iffIII", 0, 0, 0, 60_000, 60_000, 0)),
    "rvl of zeros": (
        "16UC1; compressedDepth rvl",
        struct.pack("<iffIIII", 0, 0, 0, 4096, 8192, 0xFFFFFFF7, 0),
    ),
    "depth png": (
        "16UC1; compressedDepth png",
        struct.pack("<iff", 0, 0, 0) + png_head(100_000, 100_000, 16, 0),
    ),
}


def test_bombs_in_a_log_cost_nothing(recorder: Any) -> None:
    """Read in a process whose memory is limited to little more than its imports need."""
    log = recorder()
    stage(log)
    log.camera_info("/cam/depth/camera_info", EPOCH, "lidar", 8, 6, 5.0)
    for k, (format_, data) in enumerate(BOMBS.values()):
        compressed = log.make(
            "sensor_msgs/msg/CompressedImage",
            header=log.header(EPOCH + k, "lidar"),
            format=format_,
            data=np.frombuffer(data, np.uint8),
        )
        log.add(
            "/cam/depth/image/compressedDepth"
            if "Depth" in format_
            else "/colour/image/compressed",
            compressed,
            EPOCH + k,
        )
    for k, changes in enumerate(
        ({"width": 2**32 - 1}, {"height": 2**32 - 1, "width": 2**32 - 1}, {"point_step": 2**32 - 1})
    ):
        log.cloud("/points", EPOCH + k * S // 10, "lidar", rows(), **changes)
    log.cloud("/points", EPOCH + S, "lidar", rows())
    path = log.write()
    code = f"""
import json, re, resource, sys
from semloc_logs.logs.problems import lost, sentences
from semloc_logs.logs.session.session import open_session
import cv2
session = open_session([{str(path)!r}])
held = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (held + (200 << 20),) * 2)
def peak():  # of this program; ru_maxrss counts what its parent had, too
    return int(re.search(r"VmHWM:\\s+(\\d+) kB", open("/proc/self/status").read())[1])
before = peak()
clouds = list(session.clouds(on_image=lambda image: None))
grown = peak() - before
print(json.dumps([len(clouds), sentences(lost(session.problems)), grown]))
"""
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=50
    )
    assert done.returncode == 0, done.stderr
    count, skipped, grown_kib = json.loads(done.stdout)
    assert count == 1
    assert not any("MemoryError" in s for s in skipped), skipped
    assert grown_kib < 100 << 10
    text = " ".join(skipped)
    assert "/colour/image/compressed: 5 messages skipped" in text
    assert "/cam/depth/image/compressedDepth: 3 messages skipped" in text
    assert "/points: 3 messages skipped" in text


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_are_refused_for_their_claim(name: str) -> None:
    """Before the decoder of pictures sees them: it would allocate the memory."""
    format_, data = BOMBS[name]
    with pytest.raises(UndecodableError, match=r"claim|cut off"):
        decode_compressed_depth(data, format_) if "Depth" in format_ else decode_compressed(data)


def test_pictures_that_shrink_well_are_read() -> None:
    black = np.zeros((2000, 3000), np.uint8)
    for suffix in (".png", ".jpg"):
        data = bytes(cv2.imencode(suffix, black)[1])
        assert decode_compressed(data).shape == (2000, 3000)
    noise = np.random.default_rng(0).integers(0, 65536, (40, 30), np.uint16)
    assert (decode_compressed(bytes(cv2.imencode(".png", noise)[1])) == noise).all()


def test_inspect_names_clouds_without_points(recorder: Any) -> None:
    log = recorder()
    stage(log)
    for k in range(3):
        log.cloud("/points", EPOCH + k * S // 5, "lidar", rows()[: 0 if k < 2 else 60])
    inspected: Any = inspect_log(log.write())
    assert inspected["sensors"]["/points"]["points"] == 60
    assert any(
        "/points: no point with a position in the first 2 clouds." in p
        for p in inspected["problems"]
    )


def test_nothing_but_damage_is_an_error(recorder: Any, tmp_path: Path) -> None:
    log = recorder()
    stage(log)
    log.cloud("/points", EPOCH, "lidar", rows(), width=61)
    done = CliRunner().invoke(program, ["fuse", str(log.write()), "-w", str(tmp_path / "w")])
    assert done.exit_code == 1
    assert "/points: 1 message skipped" in done.output.replace("\n", " ")
    assert not isinstance(done.exception, LogError)

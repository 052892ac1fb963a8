"""Sweeps of a moving sensor, with point times in every usual encoding, are plane walls."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.logs.messages.point_times import offsets_ns
from semloc_logs.logs.problems import lost, sentences
from semloc_logs.logs.session.session import open_session
from semloc_logs.numerics import transforms
from semloc_logs.numerics.transforms import yaw_transform

S = 1_000_000_000
EPOCH = 1_700_000_000 * S + 123_456_789
PERIOD_NS = 100_000_000
RINGS, COLUMNS = 16, 720
HALF = np.array([20.0, 12.0, 4.0])  # half the size of the room
BASE_T_LIDAR = yaw_transform(0.4, (1.0, 0.3, 1.2))
SWEEPS = 4


def pose(seconds: float) -> F64:
    """15 m/s and 0.5 rad/s: a circle of 30 m that passes the middle of the room."""
    a = 0.5 * seconds
    return yaw_transform(a, (30.0 * np.sin(a) - 3.0, 30.0 * (1 - np.cos(a)) - 1.0, 0.0))


@cache
def skewed(start: float) -> tuple[F64, NDArray[np.int64], NDArray[np.int64]]:
    """Points (n, 3) in the moving sensor, times in ns since the start, and rings; firing order."""
    turn = np.repeat(np.arange(COLUMNS) / COLUMNS, RINGS)
    ring = np.tile(np.arange(RINGS), COLUMNS)
    # rings fire one after the other
    offset = np.round(turn * PERIOD_NS + ring * 2304).astype(np.int64)
    azimuth = np.pi - 2 * np.pi * turn
    elevation = np.radians(-15 + 2.0 * ring)
    rays = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        1,
    )
    points = np.empty((len(turn), 3))
    for k, o in enumerate(offset):
        room_T_lidar = pose(start + o * 1e-9) @ BASE_T_LIDAR
        ray = room_T_lidar[:3, :3] @ rays[k]
        origin = room_T_lidar[:3, 3]
        with np.errstate(divide="ignore"):
            distance = np.min(np.where(ray > 0, HALF - origin, -HALF - origin) / ray)
        points[k] = rays[k] * distance
    return points, offset, ring


def off_the_walls(points: F64) -> float:
    """Largest distance of points (n, 3) in the room from a wall, without the worst 0.1 %."""
    return float(np.quantile(np.min(np.abs(HALF - np.abs(points)), axis=1), 0.999))


Encode = Callable[[NDArray[np.int64], int], NDArray[Any]]
# name of the field, type, and the recorded value of offsets from the stamp (ns) at a stamp (ns)
ENCODINGS: dict[str, tuple[str, str, Encode]] = {
    "ouster": ("t", "u4", lambda o, s: o),
    "velodyne": ("time", "f4", lambda o, s: o * 1e-9),
    "velodyne ms": ("time", "f4", lambda o, s: o * 1e-6),
    "us as float": ("time", "f4", lambda o, s: o * 1e-3),
    "us": ("t", "u4", lambda o, s: o // 1000),
    "ms": ("time_offset", "f8", lambda o, s: o * 1e-6),
    "hesai": ("timestamp", "f8", lambda o, s: o * 1e-9 + s * 1e-9),
    "robosense": ("timestamp", "f8", lambda o, s: o * 1e-9 + s * 1e-9),
    "livox pointcloud2": ("timestamp", "f8", lambda o, s: (o + s).astype(np.float64)),
    "livox offset": ("offset_time", "u4", lambda o, s: o),
    "autoware": ("time_stamp", "u4", lambda o, s: o),
    "aeva": ("time_offset_ns", "i4", lambda o, s: o),
    "since power-on": ("timestamp", "f8", lambda o, s: o * 1e-9 + 4321.5),
}
ABSOLUTE_INTEGERS = {"ns since 1970": 1, "us since 1970": 1000}


def record(
    log: Any, name: str, encode: Encode, kind: str, stamp_at: float = 0.0, order: Any = None
) -> Path:
    """Sweeps with their stamp at ``stamp_at`` (0: start, 1: end), and poses at 50 Hz."""
    log.transform("base_link", "lidar", BASE_T_LIDAR, EPOCH - S)
    for t in np.arange(-0.3, 0.1 * SWEEPS + 0.3, 0.02):
        log.pose(EPOCH + round(t * S), pose(t))
    dtype = np.dtype(
        [
            ("x", "<f4"),
            ("y", "<f4"),
            ("z", "<f4"),
            ("intensity", "<f4"),
            ("ring", "<u2"),
            (name, f"<{kind}"),
        ]
    )
    for k in range(SWEEPS):
        points, offset, ring = skewed(0.1 * k)
        stamp = EPOCH + round((k + stamp_at) * PERIOD_NS)
        rows = np.zeros(len(points), dtype)
        for axis in range(3):
            rows["xyz"[axis]] = points[:, axis]
        rows["ring"] = ring
        rows[name] = encode(offset - round(stamp_at * PERIOD_NS), stamp).astype(kind)
        log.cloud("/points", stamp, "lidar", rows if order is None else rows[order(rows)])
    return Path(log.write())


def walls(path: Path) -> tuple[list[float], Any]:
    """How far the points of each sweep are off the walls."""
    session = open_session([path])
    errors = []
    for cloud in session.clouds():
        assert cloud.session_T_base is not None
        errors.append(off_the_walls(transforms.apply(cloud.session_T_base, cloud.points)))
    assert len(errors) == SWEEPS, sentences(session.problems)
    return errors, session


@pytest.mark.parametrize("log_kind", ["ros2", "ros1", "protobuf"])
def test_the_room_is_bent_without_times_and_plane_with_them(recorder: Any, log_kind: str) -> None:
    bent, session = walls(record(recorder(log_kind), "intensity2", lambda o, s: o, "f4"))
    assert min(bent) > 0.3
    assert session.to_json()["sweeps_deskewed"] == 0
    plane, session = walls(record(recorder(log_kind), "t", lambda o, s: o, "u4"))
    assert max(plane) < 0.02
    assert session.to_json()["sweeps_deskewed"] == SWEEPS
    assert session.problems == []


@pytest.mark.parametrize("name", ENCODINGS)
def test_every_encoding_from_the_start(recorder: Any, name: str) -> None:
    field, kind, encode = ENCODINGS[name]
    plane, session = walls(record(recorder(), field, encode, kind))
    assert max(plane) < 0.02
    assert lost(session.problems) == []
    assert any("another clock" in p for p in sentences(session.problems)) == (
        name == "since power-on"
    )


@pytest.mark.parametrize(
    "name", [n for n, (_, kind, _) in ENCODINGS.items() if kind[0] != "u" and n != "since power-on"]
)
@pytest.mark.parametrize("stamp_at", [0.5, 1.0])
def test_stamps_within_and_at_the_end_of_the_sweep(
    recorder: Any, name: str, stamp_at: float
) -> None:
    field, kind, encode = ENCODINGS[name]
    plane, _ = walls(record(recorder(), field, encode, kind, stamp_at))
    assert max(plane) < 0.02


@pytest.mark.parametrize("stamp_at", [0.0, 1.0])
@pytest.mark.parametrize("name", ABSOLUTE_INTEGERS)
def test_absolute_integers(name: str, stamp_at: float) -> None:
    unit = ABSOLUTE_INTEGERS[name]
    """PointCloud2 has no 64-bit integers, so the function is called directly."""
    _, offset, _ = skewed(0.0)
    stamp = EPOCH + round(stamp_at * PERIOD_NS)
    decoded, _ = offsets_ns(((EPOCH + offset) // unit).astype(np.uint64), stamp)
    assert decoded is not None
    np.testing.assert_allclose(decoded, EPOCH + offset - stamp, atol=unit)


def test_points_that_are_all_far_from_their_stamp_are_named(recorder: Any) -> None:
    """The stamps are right; times of points are 0.25 s to 0.15 s before them."""
    path = record(recorder(), "time", lambda o, s: (o - 250_000_000) * 1e-9, "f4")
    _, session = walls(path)
    assert session.off_stamp_of("/points") == pytest.approx(0.15, abs=0.001)
    [sentence] = sentences(session.problems)
    assert "sweeps have points that were all measured 0.15 s or more before or after" in sentence
    assert session.problems[0].assumed
    _, session = walls(record(recorder(), "time", lambda o, s: (o - 50_000_000) * 1e-9, "f4"))
    assert session.off_stamp_of("/points") == 0.0
    assert session.problems == []


def test_a_counter_that_begins_again_is_of_another_clock_in_every_sweep(recorder: Any) -> None:
    """Within the third sweep of four; the last one looks as if 0.05 to 0.15 s after its stamp."""
    start = 2**32 - 250_000_000
    plane, session = walls(
        record(recorder(), "t", lambda o, s: (start + (s - EPOCH) + o) % 2**32, "u4")
    )
    assert max(plane) < 0.02
    assert session.off_stamp_of("/points") == 0.0
    [sentence] = sentences(session.problems)
    assert "4 of 4 sweeps have point times of another clock" in sentence


@pytest.mark.parametrize(
    "order",
    [
        lambda rows: np.lexsort((rows["t"], rows["ring"])),
        lambda rows: np.random.default_rng(1).permutation(len(rows)),
    ],
    ids=["ring by ring", "shuffled"],
)
def test_the_order_of_recording_does_not_matter(recorder: Any, order: Any) -> None:
    plane, _ = walls(record(recorder(), "t", lambda o, s: o, "u4", order=order))
    assert max(plane) < 0.02


NOISE = np.random.default_rng(2)
GARBAGE: dict[str, tuple[str, str, Encode]] = {
    "zero": ("time", "f4", lambda o, s: o * 0.0),
    "constant": ("time", "f4", lambda o, s: o * 0.0 + 0.7),
    "nan": ("time", "f8", lambda o, s: o * np.nan),
    "noise below a sweep": ("time", "f4", lambda o, s: NOISE.random(len(o)) * 0.1),
    "noise of integers": ("t", "u4", lambda o, s: NOISE.integers(0, 2**32, len(o))),
    "noise below a second": ("t", "u4", lambda o, s: NOISE.integers(0, 10**9, len(o))),
    "one wild value": ("t", "u4", lambda o, s: np.where(np.arange(len(o)) == 77, 4 * 10**9, o)),
    "absolute seconds as float32": ("timestamp", "f4", lambda o, s: o * 1e-9 + s * 1e-9),
}


@pytest.mark.parametrize("name", GARBAGE)
def test_times_that_are_none_leave_the_sweep_as_it_was(recorder: Any, name: str) -> None:
    field, kind, encode = GARBAGE[name]
    errors, session = walls(record(recorder(), field, encode, kind))
    measured = [
        off_the_walls(transforms.apply(pose(0.1 * k) @ BASE_T_LIDAR, skewed(0.1 * k)[0]))
        for k in range(SWEEPS)
    ]
    np.testing.assert_allclose(errors, measured, atol=1e-3)
    assert lost(session.problems) == []
    assert session.to_json()["sweeps_deskewed"] == 0
    assert any(
        "/points: 4 of 4 sweeps are used as measured" in p for p in sentences(session.problems)
    ) == (name not in ("zero", "constant", "absolute seconds as float32"))

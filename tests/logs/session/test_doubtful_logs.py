"""Frames, mountings and units that a log gives wrongly: turned round where sure, else named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semloc_logs.logs.session.session import Session, open_session
from semloc_logs.mapping.fit.findings import SessionFit
from semloc_logs.numerics.transforms import inverse, yaw_transform
from semloc_logs.settings import load
from semloc_logs.stages.log_check import check_log

S = 1_000_000_000
MS = 1_000_000
EPOCH = 1_700_000_000 * S
POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])

Recorder = Callable[..., Any]


def _sweep(scale: float = 1.0, seed: int = 0) -> Any:
    points = np.zeros(400, POINT)
    values = scale * np.random.default_rng(seed).uniform(3, 20, (400, 3))
    points["x"], points["y"], points["z"] = values.T
    return points


def _fused(log: Path) -> tuple[Session, list[Any]]:
    session = open_session([log])
    try:
        return session, list(session.clouds())
    finally:
        session.close()


def _check(log: Path) -> SessionFit:
    return check_log(log, load(), {})


@pytest.mark.parametrize("is_turned", [False, True], ids=["REP 105", "upside down"])
def test_a_tree_of_transforms_that_is_upside_down_gives_the_same_poses(
    recorder: Recorder, is_turned: bool
) -> None:
    log = recorder()
    for k in range(60):
        stamp_ns = EPOCH + k * 50 * MS
        pose = yaw_transform(0.01 * k, (0.1 * k, 0.0, 0.0))
        if is_turned:
            log.transform("base_link", "odom", inverse(pose), stamp_ns, "/tf")
        else:
            log.transform("odom", "base_link", pose, stamp_ns, "/tf")
        if k % 10 == 5:
            log.cloud("/points", stamp_ns, "base_link", _sweep(seed=k))
    session, clouds = _fused(log.write())
    assert session.session_frame == "odom"
    assert len(clouds) == 6
    expected = yaw_transform(0.25, (2.5, 0.0, 0.0))
    np.testing.assert_allclose(clouds[2].session_T_base, expected, atol=1e-6)
    named = [p for p in session.problems if "TF gives the fixed frame 'odom' below" in p.text]
    assert len(named) == is_turned


@pytest.mark.parametrize(
    ("mountings", "text"),
    [
        ([(0.0, 1.0), (0.0, 1.0)], ""),
        ([(0.0, 1000.0)], "its frame 'lidar' is mounted 1000 m from 'base_link'"),
        ([(0.0, 1.0), (0.35, 1.0)], "values that differ by 0.00 m and 20.1 degrees"),
    ],
    ids=["sent twice", "millimetres", "changed"],
)
def test_mountings_that_cannot_be_right_are_named(
    recorder: Recorder, mountings: list[tuple[float, float]], text: str
) -> None:
    log = recorder()
    for k in range(60):
        stamp_ns = EPOCH + k * 50 * MS
        if k % (60 // len(mountings)) == 0:
            yaw, ahead = mountings[k * len(mountings) // 60]
            log.transform("base_link", "lidar", yaw_transform(yaw, (ahead, 0, 0)), stamp_ns)
        log.pose(stamp_ns, yaw_transform(0.0, (0.2 * k, 0.0, 0.0)))
        if k % 10 == 5:
            log.cloud("/points", stamp_ns, "lidar", _sweep(seed=k))
    check = _check(log.write())
    texts = [finding.text for stream in check.streams for finding in stream.findings]
    assert check.fits == (not text)
    assert [text in problem for problem in texts] == [True] * bool(text)


@pytest.mark.parametrize("scale", [1.0, 1000.0], ids=["metres", "millimetres"])
def test_points_that_are_not_in_metres_are_named_by_their_unit(
    recorder: Recorder, scale: float
) -> None:
    log = recorder()
    for k in range(60):
        stamp_ns = EPOCH + k * 50 * MS
        log.pose(stamp_ns, yaw_transform(0.0, (0.2 * k, 0.0, 0.0)))
        if k % 10 == 5:
            log.cloud("/points", stamp_ns, "base_link", _sweep(scale, seed=k))
    session, clouds = _fused(log.write())
    named = [p for p in session.problems if "their unit is millimetres or centimetres" in p.text]
    assert len(named) == (scale > 1)
    assert bool(clouds) == (scale == 1.0)
    assert all(p.is_reported for p in named)


@pytest.mark.parametrize(("other", "first"), [("odom_2", 30), ("odom_2", 0), ("odom", 30)])
def test_a_frame_that_gets_another_parent_is_named(
    recorder: Recorder, other: str, first: int
) -> None:
    """From 1.5 s on, TF gives the vehicle in another frame only, 10 m away.

    Where that frame is its parent all along, it gets no other one.
    """
    log = recorder()
    for k in range(60):
        stamp_ns = EPOCH + k * 50 * MS
        is_moved = k >= 30 and other != "odom"
        pose = yaw_transform(0.0, (0.1 * k + 10.0 * is_moved, 0.0, 0.0))
        log.transform("odom" if k < 30 else other, "base_link", pose, stamp_ns, "/tf")
        if first <= k < 30:
            log.transform(other, "base_link", pose, stamp_ns, "/tf")
        if k % 10 == 5:
            log.cloud("/points", stamp_ns, "base_link", _sweep(seed=k))
    session, clouds = _fused(log.write())
    texts = [problem.text for problem in session.problems if "afterwards" in problem.text]
    if other == "odom":
        assert not texts
        assert len(clouds) == 6
        return
    if first == 0:
        assert not texts
        return
    [text] = texts
    assert text.startswith("TF gives 'base_link' in 'odom' until 2023-11-14T22:13:21.450Z")
    assert "and afterwards in 'odom_2'" in text
    assert len(clouds) == 3


def test_stamps_farther_off_than_the_search_reaches_are_named_by_their_recording(
    recorder: Recorder,
) -> None:
    """A steady drive hides the clock, which is 4 s behind."""
    log = recorder()
    for k in range(200):
        stamp_ns = EPOCH + k * 50 * MS
        log.pose(stamp_ns, yaw_transform(0.0, (0.1 * k, 0.0, 0.0)))
        if k % 10 == 5:
            sweep = _sweep(seed=1)
            sweep["x"] -= 0.1 * k
            log.cloud("/points", stamp_ns - 4 * S, "base_link", sweep, late_ns=4 * S)
    [finding] = _check(log.write()).streams[0].findings
    assert finding.text.startswith("its stamps are 4.00 s earlier beside their recording")
    assert "--set logs.time_offset./points=+4.00" in finding.text


@pytest.mark.parametrize(("period", "is_named"), [(20, True), (4, False)])
def test_poses_too_far_apart_for_the_turns_are_named(
    recorder: Recorder, period: int, is_named: bool
) -> None:
    """5 m/s on a circle of 10 m, poses 1 or 0.2 s apart: halfway 0.31 or 0.01 m off."""
    log = recorder()
    for k in range(400):
        angle = 0.025 * k
        place = (10.0 * np.sin(angle), 10.0 * (1.0 - np.cos(angle)), 0.0)
        if k % period == 0:
            log.pose(EPOCH + k * 50 * MS, yaw_transform(angle, place))
        if k % period == period // 2:
            log.cloud("/points", EPOCH + k * 50 * MS, "base_link", _sweep(seed=k))
    texts = [finding.text for finding in _check(log.write()).streams[0].findings]
    apart = "the poses are 1.0 s apart, too far for this drive: between them they are off by up to"
    assert any(apart + " 0.3 m and 0 degrees" in text for text in texts) is is_named

"""Header stamps beside log times: other clocks, missing stamps, and what overrules them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semloc_logs.errors import LogError
from semloc_logs.frames import Header, LidarFrame, PosedCloud, PoseSample
from semloc_logs.logs.inspection.inspect import inspect_log
from semloc_logs.logs.problems import Problem, ProblemKind
from semloc_logs.logs.session.session import Session, SessionOptions, open_session
from semloc_logs.logs.session.stamp_offsets import StampOffsets, edge_topic
from semloc_logs.numerics.transforms import translation_quaternion, yaw_transform
from semloc_logs.settings import Logs

S = 1_000_000_000
MS = 1_000_000
EPOCH = 1_700_000_000 * S
POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])
ABSOLUTE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", "<f8")])

Recorder = Callable[..., Any]


def drive(
    recorder: Recorder,
    *,
    sweeps: float | None = 0.0,
    poses: float | None = 0.0,
    every: Callable[[int], int] = lambda stamp_ns: stamp_ns,
    kind: str = "ros2",
) -> Path:
    """6 s at 1 m/s: sweeps at 10 Hz, recorded 0.1 s later, poses at 20 Hz, recorded at once.

    ``sweeps`` and ``poses``: seconds that their clocks are ahead, None for stamps of 0. ``every``:
    log time of a time.
    """
    log = recorder(kind)
    points = np.zeros(3, POINT)
    points["x"] = (5.0, 6.0, 7.0)

    def stamp(time_ns: int, ahead: float | None) -> int:
        return 0 if ahead is None else time_ns + round(ahead * S)

    for k in range(60):
        time_ns = EPOCH + k * 100 * MS
        log.cloud("/points", stamp(time_ns, sweeps), "base_link", points)
        _, topic, message = log.events.pop()
        log.add(topic, message, every(time_ns + 100 * MS))
    for k in range(122):
        time_ns = EPOCH + k * 50 * MS
        pose = yaw_transform(0.0, (k * 0.05, 0.0, 0.0))
        log.pose(stamp(time_ns, poses), pose, log_time_ns=every(time_ns))
    path: Path = log.write()
    return path


def fused(path: Path, **settings: Any) -> tuple[Session, list[PosedCloud]]:
    session = open_session([path], SessionOptions(logs=Logs(**settings)))
    clouds = list(session.clouds())
    session.close()
    return session, clouds


def stamp_problems(session: Session) -> list[Problem]:
    return [p for p in session.problems if p.kind is ProblemKind.STAMP]


def forward(clouds: list[PosedCloud]) -> list[float]:
    """Metres that each cloud lies ahead of the start."""
    return [float(c.session_T_base[0, 3]) for c in clouds if c.session_T_base is not None]


def test_a_good_log_has_figures_and_no_problem(recorder: Recorder) -> None:
    path = drive(recorder)
    session, clouds = fused(path)
    offset = session.stamp_offsets.of("/points")
    assert offset is not None
    assert (offset.messages, offset.without_stamp) == (60, 0)
    assert offset.median == pytest.approx(0.1, abs=1e-6)
    assert (offset.least, offset.greatest) == pytest.approx((0.1, 0.1), abs=1e-6)
    assert session.to_json()["stamps"]["/odom"]["median"] == 0.0  # type: ignore[index]
    assert stamp_problems(session) == []
    assert forward(clouds) == pytest.approx([0.1 * k for k in range(60)], abs=1e-6)
    inspection = inspect_log(path)
    assert inspection["problems"] == []
    assert set(inspection["stamps"]) == {"/odom", "/points"}  # type: ignore[call-overload]


@pytest.mark.parametrize(
    ("ahead", "shift", "cause"),
    [
        (37.0, "-37.00", "TAI beside UTC"),
        (-18.0, "18.00", "GPS time beside UTC"),
        (7200.0, "-7200.00", "a time zone"),
        (-3600.0, "3600.00", "a time zone"),
        (0.5, "-0.40", "0.40 s later than their recording"),
        (-6.0, "6.10", "6.10 s earlier than their recording"),
    ],
)
def test_sweeps_of_another_clock_are_named_with_the_shift(
    recorder: Recorder, ahead: float, shift: str, cause: str
) -> None:
    """The sweeps lie 0.1 s behind in any case: a usual shift is given without this latency."""
    path = drive(recorder, sweeps=ahead)
    session, _ = fused(path)
    [problem] = stamp_problems(session)
    assert problem.topic == "/points"
    assert problem.assumed
    assert f"--set logs.time_offset./points={shift}, or --stamps log" in problem.text
    assert cause in problem.text
    assert problem.text in inspect_log(path)["skipped"]  # type: ignore[operator]


@pytest.mark.parametrize(("given", "wanted"), [(-30.0, "-36.90"), (4.0, "-36.90")])
def test_the_offset_that_is_named_replaces_the_one_that_is_given(
    recorder: Recorder, given: float, wanted: str
) -> None:
    """36.9 s ahead of their recording in all: what the settings add already is part of it."""
    path = drive(recorder, sweeps=37.0)
    session, _ = fused(path, time_offset={"/points": given})
    [problem] = stamp_problems(session)
    assert f"--set logs.time_offset./points={wanted}, or --stamps log" in problem.text
    assert session.time_offset_of("/points") == pytest.approx(given)
    logs = Logs(time_offset={"/points": given})
    assert problem.text in inspect_log(path, logs=logs)["skipped"]  # type: ignore[operator]


@pytest.mark.parametrize(("ahead", "is_assumed"), [(0.01, None), (0.05, False), (0.2, True)])
def test_stamps_that_are_a_little_later_than_their_recording(
    recorder: Recorder, ahead: float, is_assumed: bool | None
) -> None:
    """10 ms are the latency of a network, 50 ms a note, 0.2 s another clock."""
    session, _ = fused(drive(recorder, poses=ahead))
    assert [p.assumed for p in stamp_problems(session)] == (
        [] if is_assumed is None else [is_assumed]
    )


def test_poses_of_another_clock_are_named_and_not_the_sweeps(recorder: Recorder) -> None:
    session, _ = fused(drive(recorder, poses=37.0))
    [problem] = stamp_problems(session)
    assert problem.topic == "/odom"
    assert "logs.time_offset./odom=-37.00" in problem.text


@pytest.mark.parametrize("ahead", [37.0, -86_400.0 * 900])
def test_all_stamps_of_another_clock_agree_with_each_other(
    recorder: Recorder, ahead: float
) -> None:
    """TAI on the whole vehicle, or a log that was replayed 900 days later: a note only."""
    session, clouds = fused(drive(recorder, sweeps=ahead, poses=ahead))
    [problem] = stamp_problems(session)
    assert not problem.is_reported
    assert "they agree with each other" in problem.text
    assert forward(clouds) == pytest.approx([0.1 * k for k in range(60)], abs=1e-6)


def test_a_replay_at_another_speed_is_a_note_too(recorder: Recorder) -> None:
    """At a twentieth of the speed, log times are up to 2 minutes late, sweeps and poses alike."""
    session, clouds = fused(drive(recorder, every=lambda ns: EPOCH + 20 * (ns - EPOCH)))
    assert len(clouds) == 60
    assert not any(p.is_reported for p in stamp_problems(session))


def test_a_clock_that_is_set_during_the_log_is_named(recorder: Recorder) -> None:
    log = recorder()
    points = np.ones(3, POINT)
    for k in range(60):
        time_ns = EPOCH + k * 100 * MS
        stamp_ns = time_ns + (7 * S if k >= 40 else 0)
        log.cloud("/points", stamp_ns, "base_link", points, late_ns=time_ns - stamp_ns)
        log.pose(time_ns, yaw_transform(0.0, (0.1 * k, 0.0, 0.0)))
    session, _ = fused(log.write())
    [problem] = stamp_problems(session)
    assert problem.assumed
    assert "/points: its header stamps change by 7.00 s against the ones of /odom" in problem.text


@pytest.mark.parametrize(
    ("stamp_of", "stuck"),
    [
        (lambda ns: EPOCH, 59),
        (lambda ns: min(ns, EPOCH + 3 * S), 29),
        (lambda ns: ns // S * S, 54),
        (lambda ns: ns // S * S + ns % S // 1000, 54),
    ],
    ids=["all", "from the middle on", "whole seconds", "microseconds"],
)
def test_stamps_that_stand_still_are_named(
    recorder: Recorder, stamp_of: Callable[[int], int], stuck: int
) -> None:
    log = recorder()
    for k in range(60):
        time_ns = EPOCH + k * 100 * MS
        points = np.full(3, k, POINT)
        stamp_ns = stamp_of(time_ns)
        log.cloud("/points", stamp_ns, "base_link", points, late_ns=time_ns - stamp_ns)
        log.pose(time_ns, yaw_transform(0.0, (0.1 * k, 0.0, 0.0)))
    session, _ = fused(log.write())
    [problem] = stamp_problems(session)
    assert problem.assumed
    assert f"/points: {stuck} of 60 header stamps hardly differ" in problem.text
    assert "--set logs.stamps=log" in problem.text
    assert session.is_stuck("/points")
    assert not session.is_stuck("/odom")


@pytest.mark.parametrize(
    ("until", "after", "lead"), [(0.0, 0.5, 0.5), (0.4, 0.4, 0.4), (0.0, -0.5, 0.0), (0, 0.05, 0)]
)
def test_stamps_later_than_their_recording_lead_by_what_a_clock_cannot(
    recorder: Recorder, until: float, after: float, lead: float
) -> None:
    """A clock that is ahead, from the start or since it was set halfway; one behind may be late."""
    log = recorder()
    for k in range(60):
        time_ns = EPOCH + k * 100 * MS
        stamp_ns = time_ns + round((until if k < 30 else after) * S)
        log.cloud(
            "/points", stamp_ns, "base_link", np.full(3, k, POINT), late_ns=time_ns - stamp_ns
        )
        log.pose(time_ns, yaw_transform(0.0, (0.1 * k, 0.0, 0.0)))
    session, _ = fused(log.write())
    assert session.lead_of("/points") == pytest.approx(lead, abs=0.02)


@pytest.mark.parametrize(
    ("late", "shift"), [(lambda k: 4.0, 4.0), (lambda k: -4.0, -4.0), (lambda k: 0.1 * k, 0.0)]
)
def test_stamps_far_from_their_recording_are_of_another_clock_where_that_is_steady(
    recorder: Recorder, late: Callable[[int], float], shift: float
) -> None:
    """Sweeps that a queue holds back are recorded later and later, by their own clock."""
    log = recorder()
    for k in range(60):
        time_ns = EPOCH + k * 100 * MS
        points = np.full(3, k, POINT)
        log.cloud("/points", time_ns, "base_link", points, late_ns=round(late(k) * S))
        log.pose(time_ns, yaw_transform(0.0, (0.1 * k, 0.0, 0.0)))
    session, _ = fused(log.write())
    assert session.shift_of("/points") == pytest.approx(shift, abs=0.01)


def test_zero_stamps_mean_log_times(recorder: Recorder) -> None:
    """Sweeps are recorded 0.1 s late: without stamps, that is their time."""
    path = drive(recorder, sweeps=None, poses=None)
    session, clouds = fused(path)
    assert forward(clouds) == pytest.approx([0.1 * k + 0.1 for k in range(60)], abs=1e-6)
    assert [c.header.stamp_ns for c in clouds[:2]] == [EPOCH + 100 * MS, EPOCH + 200 * MS]
    assert [(p.topic, p.is_reported) for p in stamp_problems(session)] == [
        ("/odom", False),
        ("/points", False),
    ]
    assert "all 122 header stamps are 0 or missing" in stamp_problems(session)[0].text
    assert len([p for p in inspect_log(path)["problems"] if "header stamps are 0" in p]) == 2  # type: ignore[attr-defined]


def test_zero_stamps_of_one_topic_leave_the_others_as_they_are(recorder: Recorder) -> None:
    session, clouds = fused(drive(recorder, sweeps=None))
    assert forward(clouds) == pytest.approx([0.1 * k + 0.1 for k in range(60)], abs=1e-6)
    assert [p.topic for p in stamp_problems(session)] == ["/points"]


def test_header_stamps_of_zero_are_kept_where_the_user_wants_them(recorder: Recorder) -> None:
    session, clouds = fused(drive(recorder, sweeps=None), stamps="header")
    assert clouds == []
    assert any(p.lost for p in session.problems)


def test_a_single_zero_among_good_stamps_is_not_replaced(recorder: Recorder) -> None:
    """A time that is a latency off would put the pose, and interpolated ones, elsewhere."""
    log = recorder()
    for k in range(60):
        log.cloud("/points", EPOCH + k * 100 * MS, "base_link", np.ones(3, POINT))
        stamp_ns = 0 if k == 30 else EPOCH + k * 100 * MS
        pose = yaw_transform(0.0, (0.1 * k, 0.0, 0.0))
        log.pose(stamp_ns, pose, log_time_ns=EPOCH + k * 100 * MS + 80 * MS)
    session, clouds = fused(log.write())
    stamps, _ = session.trajectory()
    assert len(stamps) == 59
    assert forward(clouds) == pytest.approx([0.1 * k for k in range(60)], abs=1e-6)


@pytest.mark.parametrize("name", ["t", "timestamp"])
def test_point_times_follow_the_log_time(recorder: Recorder, name: str) -> None:
    """Relative times count from the log time; absolute ones are what they are."""
    log = recorder()
    measured_ns = EPOCH - 60 * MS  # recorded 0.15 s after its stamp of 0 would have been
    points = np.ones(100, POINT if name == "t" else ABSOLUTE)
    ramp = np.arange(100) * MS
    points[name] = ramp if name == "t" else (measured_ns + ramp) * 1e-9
    log.cloud("/points", 0, "base_link", points, late_ns=EPOCH)
    log.pose(EPOCH, np.eye(4))
    session = open_session([log.write()])
    [frame] = session.logs[0].frames(["/points"])
    assert isinstance(frame, LidarFrame)
    assert frame.offset_ns is not None
    assert frame.header.stamp_ns == EPOCH
    assert frame.header.lacks_stamp
    expected = ramp if name == "t" else ramp - 60 * MS
    np.testing.assert_allclose(frame.offset_ns, expected, atol=1000)


def test_log_times_on_request(recorder: Recorder) -> None:
    session, clouds = fused(drive(recorder, sweeps=37.0), stamps="log")
    assert forward(clouds) == pytest.approx([0.1 * k + 0.1 for k in range(60)], abs=1e-6)
    assert stamp_problems(session) == []


def test_an_offset_puts_the_stamps_right(recorder: Recorder) -> None:
    session, clouds = fused(drive(recorder, sweeps=37.0), time_offset={"/points": -37.0})
    assert forward(clouds) == pytest.approx([0.1 * k for k in range(60)], abs=1e-6)
    assert clouds[3].header.stamp_ns == EPOCH + 300 * MS
    assert stamp_problems(session) == []
    offset = session.stamp_offsets.of("/points")
    assert offset is not None
    assert offset.median == pytest.approx(0.1, abs=1e-6)


def test_an_offset_keeps_the_times_of_points_beside_their_stamp(recorder: Recorder) -> None:
    """Absolute times of points are of the clock of the header: they are shifted with it."""
    log = recorder()
    points = np.ones(100, ABSOLUTE)
    points["timestamp"] = (EPOCH + np.arange(100) * MS) * 1e-9
    log.cloud("/points", EPOCH, "base_link", points)
    log.pose(EPOCH, np.eye(4))
    session = open_session([log.write()], SessionOptions(logs=Logs(time_offset={"points": 0.4})))
    [frame] = session.logs[0].frames(["/points"], session._reading)
    assert isinstance(frame, LidarFrame)
    assert frame.offset_ns is not None
    assert frame.header.stamp_ns == EPOCH + 400 * MS
    np.testing.assert_allclose(frame.offset_ns, np.arange(100) * MS, atol=1000)


def test_the_offset_of_an_unknown_topic_is_refused_by_name(recorder: Recorder) -> None:
    path = drive(recorder)
    with pytest.raises(LogError, match=r"time_offset names /lidar, .*topics are /odom, /points"):
        open_session([path], SessionOptions(logs=Logs(time_offset={"/lidar": 1.0})))


def test_edges_of_tf_are_compared_each_by_itself(recorder: Recorder) -> None:
    """map -> odom is stamped 1 s ahead, as AMCL does; the poses are odom -> base_link."""
    log = recorder()
    for k in range(60):
        time_ns = EPOCH + k * 100 * MS
        log.cloud("/points", time_ns, "base_link", np.ones(3, POINT))
        log.transform("odom", "base_link", yaw_transform(0.0, (0.1 * k, 0, 0)), time_ns, "/tf")
        log.transform("map", "odom", np.eye(4), time_ns + S, "/tf")
        log_time_ns, topic, message = log.events.pop()
        log.add(topic, message, log_time_ns - S)
    session, clouds = fused(log.write())
    assert len(clouds) == 60
    assert stamp_problems(session) == []
    ahead = session.stamp_offsets.of(edge_topic("/tf", ("map", "odom")))
    assert ahead is not None
    assert ahead.median == pytest.approx(-1.0)


def test_memory_is_bounded_and_the_figures_stay() -> None:
    """100,000 messages: the clock is 1 s behind for the first half of them, 3 s for the other."""
    offsets = StampOffsets()
    for k in range(100_000):
        behind_ns = S if k < 50_000 else 3 * S
        header = Header("/x", EPOCH + k * MS - behind_ns, EPOCH + k * MS, "")
        offsets.take(PoseSample(header, "", np.eye(4)))
        steady = Header("/y", EPOCH + k * MS, EPOCH + k * MS, "")
        offsets.take(PoseSample(steady, "", np.eye(4)))
    offset = offsets.of("/x")
    assert offset is not None
    assert (offset.messages, offset.least, offset.greatest) == (100_000, 1.0, 3.0)
    relative = offsets.relative("/x", "/y")
    assert 1000 < len(relative) <= 2048
    assert relative[0] == pytest.approx(1.0)
    assert relative[-1] == pytest.approx(3.0)
    assert offsets.of("/z") is None


def test_json_without_stamps_takes_log_times_and_a_note(tmp_path: Path) -> None:
    import json

    from mcap.writer import Writer

    path = tmp_path / "drive.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("")
        schema = writer.register_schema("foxglove.PoseInFrame", "jsonschema", b"{}")
        channel = writer.register_channel("/pose", "json", schema)
        for k in range(3):
            t, q = translation_quaternion(np.eye(4))
            pose = {
                "position": dict(zip("xyz", t, strict=True)),
                "orientation": dict(zip("xyzw", q, strict=True)),
            }
            data = json.dumps({"frame_id": "map", "pose": pose}).encode()
            writer.add_message(channel, EPOCH + k * S, data, EPOCH + k * S)
        writer.finish()  # type: ignore[no-untyped-call]
    inspection = inspect_log(path)
    assert inspection["poses"]["count"] == 3  # type: ignore[index]
    assert any("all 3 header stamps are 0 or missing" in p for p in inspection["problems"])  # type: ignore[attr-defined]

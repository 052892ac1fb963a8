"""Two sensors in one street: how far the mounting of the second is off, as it was made."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.frames import Header, PosedCloud
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.mapping.fit import fit_check
from semloc_logs.mapping.fit.findings import StreamFit
from semloc_logs.mapping.fit.keyframe_pairs import Clouds
from semloc_logs.mapping.fit.shared_surfaces import NO_OFFSET, Offset, offset_between
from semloc_logs.numerics.transforms import apply, exp_se3


def second_sensor(
    clouds: Clouds, offset: F64, *, late_ns: int = 0, beyond: float = -np.inf
) -> tuple[Clouds, Clouds]:
    """A stream, and another one whose mounting is off by ``offset`` (6,), from the same places.

    Its stamps are ``late_ns`` later, and it sees what lies ``beyond`` x.
    """
    collected = clouds.collected
    moved = exp_se3(-offset[:3], -offset[3:])
    for number in range(len(clouds.rows)):
        points = clouds.points(number)
        points = apply(moved, points[points[:, 0] > beyond])
        stamp_ns = int(clouds.stamps_ns()[number]) + late_ns
        cloud = PosedCloud(
            Header("/rear", stamp_ns, stamp_ns, "rear"),
            points.astype(np.float32),
            np.zeros(3, np.float32),
            clouds.pose(number),
            None,
        )
        collected.add(cloud, np.arange(len(points)))
    rows = np.arange(len(clouds.rows), 2 * len(clouds.rows))
    return clouds, Clouds(collected, rows, clouds.voxel)


def steps(*values: float) -> F64:
    """An offset (6,): metres, and degrees about x, y, z."""
    return np.array([*values[:3], *np.radians(values[3:])])


@pytest.fixture
def drive(tmp_path: Path, streets: SimpleNamespace) -> tuple[Clouds, PoseTrack]:
    clouds, track = streets.drive(tmp_path, streets.straight)
    return clouds, track


@pytest.mark.parametrize(
    "offset",
    [
        steps(0, 0, 1, 0, 0, 0),
        steps(-1.2, 0, 0, 0, 0, 0),
        steps(0, 0, 0, 4, 0, 0),
    ],
)
def test_the_mounting_is_off_by_what_it_was_moved(
    drive: tuple[Clouds, PoseTrack], offset: F64
) -> None:
    """A straight drive hides each of them from the poses."""
    clouds, track = drive
    offset_found = offset_between(*second_sensor(clouds, offset), track.at_many)
    measured = np.r_[offset_found.shift, np.degrees(offset_found.turn)]
    made = np.r_[offset[:3], np.degrees(offset[3:])]
    assert measured == pytest.approx(made, abs=0.1)
    assert np.array_equal(measured != 0, made != 0)


@pytest.mark.parametrize(
    ("offset", "how"),
    [
        (steps(0, 0, 0, 0, 0, 0), {}),
        (steps(0.1, 0, 0.1, 0, 0, 0), {}),  # less than a voxel
        (steps(0, 0, 1, 0, 0, 0), {"late_ns": 6 * 10**8}),  # none at about the same time
        (steps(0, 0, 1, 0, 0, 0), {"beyond": 30.0}),  # it sees none of the surfaces
    ],
)
def test_nothing_is_said_where_mountings_agree_or_nothing_shows_it(
    drive: tuple[Clouds, PoseTrack], offset: F64, how: dict[str, float]
) -> None:
    clouds, track = drive
    clouds = Clouds(clouds.collected, clouds.rows[:1] if "late_ns" in how else clouds.rows, 0.3)
    assert not offset_between(*second_sensor(clouds, offset, **how), track.at_many)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("shift", "direction", "rest"),
    [
        ((1.0, 0.0, 0.0), None, (1.0, 0.0, 0.0)),
        ((1.0, 0.2, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 0.0)),  # along the ranges of a camera
        ((1.0, 0.4, 0.0), (1.0, 0.0, 0.0), (1.0, 0.4, 0.0)),  # across by more than a voxel
        ((0.0, 0.0, 0.4), (0.6, 0.8, 0.0), (0.0, 0.0, 0.4)),
    ],
)
def test_a_shift_along_the_ranges_of_a_camera_may_be_their_bias(
    shift: tuple[float, ...], direction: tuple[float, ...] | None, rest: tuple[float, ...]
) -> None:
    offset = Offset(np.array(shift), np.array([0.0, 0.0, 0.1]), np.ones(6))
    left = offset.without(None if direction is None else np.array(direction), 0.3)
    assert left.shift.tolist() == list(rest)
    assert left.turn.tolist() == [0.0, 0.0, 0.1]


def test_a_stream_that_is_off_is_none_that_others_are_compared_with(
    drive: tuple[Clouds, PoseTrack],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of three sensors the second one is refused, and the third fits the first."""
    clouds, track = drive
    compared: list[tuple[Clouds, Clouds]] = []

    def differs(others: Clouds, own: Clouds, _: object) -> Offset:
        compared.append((others, own))
        is_off = own is streams[1]
        return Offset(np.ones(3), np.zeros(3), np.ones(6)) if is_off else NO_OFFSET

    streams = [clouds, second_sensor(clouds, np.zeros(6))[1], second_sensor(clouds, np.zeros(6))[1]]
    monkeypatch.setattr(fit_check, "offset_between", differs)
    before: list[tuple[str, Clouds]] = []
    wrong = []
    for number, own in enumerate(streams):
        stream = StreamFit(f"/{number}")
        fit_check.compare(stream, own, before, track.at_many)
        wrong.append(stream.is_wrong)
    assert wrong == [False, True, False]
    assert [others is clouds for others, _ in compared] == [True, True]

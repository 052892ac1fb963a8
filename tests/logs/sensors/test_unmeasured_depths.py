"""Depths that pixels without a measurement are given."""

from __future__ import annotations

import numpy as np

from semloc_logs.arrays import F32
from semloc_logs.logs.problems import sentences
from semloc_logs.logs.sensors.unmeasured_depths import FEWEST, UnmeasuredDepths

TOPIC = "/depth"


def picture(number: int, filled: int, fill: float = 8.0) -> F32:
    """100 pixels of a scene that changes, of which the first ``filled`` have no measurement."""
    depth = np.linspace(1.0, 5.0, 100, dtype=np.float32) + np.float32(0.01 * number)
    depth[:filled] = fill
    return depth.reshape(10, 10)


def shown(limits: UnmeasuredDepths, pictures: list[F32], max_range: float = 20.0) -> list[int]:
    """How many pixels of each picture were measured."""
    return [int((limits.measured(TOPIC, p, max_range) > 0).sum()) for p in pictures]


def test_pixels_of_one_largest_depth_are_left_out_and_named_once_it_is_sure() -> None:
    limits = UnmeasuredDepths()
    assert shown(limits, [picture(number, 30) for number in range(FEWEST - 1)]) == [70] * 9
    assert sentences(limits.problems) == []
    assert shown(limits, [picture(FEWEST, 30)]) == [70]
    [sentence] = sentences(limits.problems)
    assert sentence.startswith("/depth: many pixels of nearly all pictures have the largest depth,")
    assert "8.000 m" in sentence
    [problem] = limits.problems
    assert (problem.lost, problem.assumed) == (False, False)  # nothing was measured there
    # a picture without such pixels is as it was measured
    assert shown(limits, [picture(0, 0)]) == [100]


def test_what_changes_with_the_scene_is_measured() -> None:
    few = UnmeasuredDepths()
    assert shown(few, [picture(n, 4) for n in range(20)]) == [100] * 20
    assert shown(UnmeasuredDepths(), [picture(0, 5)]) == [95]  # a twentieth
    moving = UnmeasuredDepths()
    walls = [picture(n, 60, fill=8.0 - 0.05 * n) for n in range(20)]
    assert shown(moving, walls) == [40] + [100] * 19  # the first one may be a limit
    sometimes = UnmeasuredDepths()
    assert shown(sometimes, [picture(n, 30 * (n % 2)) for n in range(40)])[2:] == [100] * 38
    for limits in (few, moving, sometimes):
        assert sentences(limits.problems) == []


def test_four_of_five_pictures_are_enough() -> None:
    filled = [30] * 7 + [0] * 2 + [30]
    pictures = [picture(n, count) for n, count in enumerate(filled)]
    assert shown(UnmeasuredDepths(), pictures)[-1] == 70
    assert shown(UnmeasuredDepths(), [picture(99, 0), *pictures])[-1] == 100


def test_a_limit_out_of_range_is_left_out_without_a_word() -> None:
    limits = UnmeasuredDepths()
    shown(limits, [picture(n, 30, fill=1000.0) for n in range(20)])
    assert sentences(limits.problems) == []


def test_a_limit_that_is_seen_later_is_found() -> None:
    limits = UnmeasuredDepths()
    counts = shown(limits, [picture(n, 0) for n in range(4)])
    assert counts == [100] * 4
    counts = shown(limits, [picture(n, 30) for n in range(40)])
    assert counts[-1] == 70


def test_pictures_of_one_depth_alone_are_a_wall_unless_others_showed_the_limit() -> None:
    limits = UnmeasuredDepths()
    wall = picture(0, 100)
    wall[0, :3] = 0.0, np.nan, -1.0
    assert shown(limits, [wall] * 20) == [97] * 20
    assert sentences(limits.problems) == []
    shown(limits, [picture(n, 30) for n in range(FEWEST)])
    assert shown(limits, [wall]) == [0]


def test_nothing_measured_is_no_limit() -> None:
    limits = UnmeasuredDepths()
    empty = np.zeros((10, 10), np.float32)
    assert shown(limits, [empty] * 20) == [0] * 20
    unknown = np.full((10, 10), np.nan, np.float32)
    assert shown(limits, [unknown] * 20) == [0] * 20
    assert sentences(limits.problems) == []

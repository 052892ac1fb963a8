"""Which places are one, rivals or neither, and how much a neighbour may be off."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.closures.acceptance.consistency import _sums, place_odds
from semloc_logs.closures.acceptance.placements import Placed, pairs_of
from semloc_logs.numerics.transforms import yaw_transform


def two_alignments(
    second: F64, *, queries: tuple[int, int] = (0, 0), along: float = 0.0, target_road: float = 0.0
) -> Placed:
    """Of a session in another one: at the origin and at ``second``, which ``along`` and
    ``target_road`` metres of road lead to.
    """
    return Placed(
        np.full(2, "a", object),
        np.full(2, "b", object),
        np.array(queries),
        np.array([500.0, 500.0 + along]),
        np.array([500.0, 500.0 + target_road]),
        np.tile(np.eye(4), (2, 1, 1)),
        np.array([np.eye(4), second]),
        np.full(2, 0.01),
        np.zeros(2),
        np.ones(2, bool),
    )


SAME = (2.0, 0.0)  # odds of a place, and of its rivals, where each alignment has odds of 1
RIVALS = (1.0, 1.0)
NEITHER = (1.0, 0.0)


@pytest.mark.parametrize(
    ("off", "degrees", "target_road", "expected"),
    [
        # 2 x 3.3 voxels, 8 degrees
        *(
            (sign * distance * np.eye(3)[axis], 0.0, 0.0, expected)
            for distance, expected in ((1.95, SAME), (2.01, RIVALS))
            for axis in range(3)
            for sign in (1, -1)
        ),
        (np.zeros(3), 7.9, 0.0, SAME),
        (np.zeros(3), -8.1, 0.0, RIVALS),
        # 1 % of the road, and 0.02 degrees a metre, from 50 voxels of it on
        (np.array([2.1, 0.0, 0.0]), 0.0, 14.0, RIVALS),
        (np.array([2.1, 0.0, 0.0]), 0.0, 16.0, NEITHER),
        (np.array([2.1, 0.0, 0.0]), 0.0, -16.0, NEITHER),
        (np.array([3.0, 0.0, 0.0]), 0.0, 101.0, RIVALS),
        (np.array([3.0, 0.0, 0.0]), 0.0, 103.0, NEITHER),
        (np.zeros(3), 9.9, 100.0, NEITHER),
        (np.zeros(3), 10.1, 100.0, RIVALS),
    ],
)
def test_which_two_places_are_one_or_may_be_or_are_rivals(
    off: F64, degrees: float, target_road: float, expected: tuple[float, float]
) -> None:
    second = yaw_transform(np.radians(degrees), off)
    placed = two_alignments(second, target_road=target_road)
    odds = place_odds(placed, pairs_of(placed), placed.log_odds, 0.3)
    assert list(zip(odds.place, odds.rivals, strict=True)) == [expected, expected]


@pytest.mark.parametrize(
    ("voxel_size", "degrees", "agrees"),
    [
        (0.30, 4.3, True),  # 4 degrees, and 0.02 for each of 20 m of road
        (0.30, 4.5, False),
        (0.05, 6.3, True),  # six times as many a metre at voxels of 5 cm
        (0.05, 6.5, False),
    ],
)
def test_how_much_a_neighbour_may_be_turned(
    voxel_size: float, degrees: float, agrees: bool
) -> None:
    placed = two_alignments(yaw_transform(np.radians(degrees)), queries=(0, 1), along=20.0)
    [sums] = _sums(placed, (np.full(2, 0.5),), voxel_size)
    support, conflict = sums[0::2].sum(axis=0), sums[1::2].sum(axis=0)
    assert support.tolist() == [0.5 * agrees] * 2
    assert conflict.tolist() == [0.5 * (not agrees)] * 2


def test_rounding_of_rotations_takes_no_vote() -> None:
    """The trace of the turn between two poses that agree is a little more than 3."""
    longer = np.eye(4)
    longer[:3, :3] *= 1 + 1e-9
    [sums] = _sums(two_alignments(longer, queries=(0, 1)), (np.full(2, 0.5),), 0.3)
    assert sums.tolist() == [[0.5, 0.5], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]]

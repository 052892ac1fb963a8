"""The parts of the hypotheses about poses and range data, on pairs made by hand."""

import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.mapping.fit.model import MEDIAN_OF_6, Pairs, agree_about_scale, scatter
from semloc_logs.numerics.transforms import yaw_transform


def _poses_at(stamps_ns: NDArray[np.int64]) -> tuple[F64, NDArray[np.bool_]]:
    """A drive of 1 m/s along x."""
    poses = np.array([yaw_transform(0.0, (s / 1e9, 0.0, 0.0)) for s in stamps_ns])
    return poses, np.ones(len(stamps_ns), bool)


@pytest.mark.parametrize(
    ("factors", "agree"),
    [
        ([0.9, 0.89, 0.91, 0.9, 0.5], True),  # one pair went wrong
        ([1.0, 0.98, 0.9, 0.7, 0.5], False),  # a camera's clouds, pulled together
        ([1.0, 1.01, 0.99, 1.02, 0.98], False),  # no scale at all
    ],
)
def test_a_scale_is_common_to_the_pairs(factors: list[float], agree: bool) -> None:
    """Clouds 4 m apart by the poses that were registered at so many times the distance."""
    stamps = np.array([[k, k + 4] for k in range(len(factors))], np.int64) * 1_000_000_000
    measured = np.array([yaw_transform(0.0, (4.0 * f, 0.0, 0.0)) for f in factors])
    pairs = Pairs(stamps, measured, np.tile(np.eye(6), (len(factors), 1, 1)))
    assert agree_about_scale(pairs, _poses_at) is agree


def test_standing_still_tells_no_scale() -> None:
    stamps = np.zeros((3, 2), np.int64)
    pairs = Pairs(stamps, np.tile(np.eye(4), (3, 1, 1)), np.tile(np.eye(6), (3, 1, 1)))
    assert not agree_about_scale(pairs, _poses_at)


def test_pairs_that_scatter_less_than_expected_narrow_estimates_as_far_as_they_show_it() -> None:
    """With 3 pairs as expected: 27 pairs of a tenth make (3 + 2.7) / 30."""
    tenth = np.full(27, 0.1 * MEDIAN_OF_6)
    assert scatter(tenth) == pytest.approx(0.19)
    assert scatter(tenth[:3]) == pytest.approx(0.55)
    assert scatter(np.full(3, 4.0 * MEDIAN_OF_6)) == pytest.approx(4.0)
    assert scatter(np.full(3, np.nan)) == 1.0

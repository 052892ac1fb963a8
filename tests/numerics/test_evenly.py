"""Numbers that are evenly spread."""

import pytest

from semloc_logs.numerics.evenly import evenly


@pytest.mark.parametrize(
    ("count", "most", "expected"),
    [
        (0, 3, []),
        (1, 3, [0]),
        (3, 5, [0, 1, 2]),
        (5, 3, [0, 2, 4]),
        (10, 4, [0, 3, 6, 9]),
        (10, 2, [0, 9]),
        (7, 1, [3]),
        (1, 1, [0]),
    ],
)
def test_the_first_the_last_and_some_between(count: int, most: int, expected: list[int]) -> None:
    assert evenly(count, most).tolist() == expected

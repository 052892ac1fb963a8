"""Numbers of clusters are told from classes: a street of two walls, seen from sweep to sweep."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.arrays import F64, I64
from semloc_logs.labels.label_check import LabelCheck
from semloc_logs.labels.space import BUILDING, ROAD, SIDEWALK

ORIGIN = np.array([0.0, 0.0, 1.8])
POLE, CAR = 5, 13


def street() -> F64:
    """Points of a level street of 40 m x 20 m between two walls of 6 m."""
    x, y = np.meshgrid(np.arange(-20, 20, 0.4), np.arange(-9.9, 10, 0.4))
    ground = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    x, z = np.meshgrid(np.arange(-20, 20, 0.3), np.arange(0.6, 6, 0.3))
    walls = [np.stack([x.ravel(), np.full(x.size, side), z.ravel()], 1) for side in (-10.1, 10.1)]
    return np.concatenate([ground, *walls])


POINTS = street()
IS_GROUND = POINTS[:, 2] == 0.0
# each wall has a stretch of parked vans
IS_VAN = (np.abs(POINTS[:, 0] + 5.0) < 5.0) & ~IS_GROUND
CLASSES = np.where(IS_GROUND, ROAD, np.where(IS_VAN, CAR, BUILDING))


def doubt(*sweeps: I64, classes: list[I64] | None = None) -> str:
    check = LabelCheck(1.0)
    for k, ids in enumerate(sweeps):
        train = ids if classes is None else classes[k]
        check.add(POINTS, ORIGIN, ids, train.astype(np.uint8), follows=k > 0)
    return check.doubt()


def with_errors(seed: int, share: float) -> I64:
    rng = np.random.default_rng(seed)
    wrong = rng.random(len(CLASSES)) < share
    return np.where(wrong, rng.choice([SIDEWALK, BUILDING, POLE, CAR, 255], len(CLASSES)), CLASSES)


@pytest.mark.parametrize("share", [0.0, 0.15, 0.3])
def test_true_classes_with_the_errors_of_a_network_are_not_doubted(share: float) -> None:
    assert doubt(*(with_errors(seed, share) for seed in range(4))) == ""


def test_labels_of_one_sweep_and_of_a_single_class() -> None:
    assert doubt(CLASSES) == ""
    assert doubt(*[np.where(IS_VAN, CAR, 255)] * 3) == ""
    assert doubt(np.full(len(POINTS), 255), np.full(len(POINTS), 255)) == ""


@pytest.mark.parametrize("label", [ROAD, BUILDING, CAR])
def test_one_class_for_everything_says_nothing(label: int) -> None:
    assert doubt(*[np.full(len(POINTS), label)] * 3) != ""


def test_one_class_on_the_ground_and_above_it_is_named_as_such() -> None:
    reason = doubt(*[np.full(len(POINTS), ROAD)] * 3)
    assert reason == (
        "100% of the labelled points have one class, on the ground and above it alike"
    )


def clusters(seed: int) -> I64:
    """Patches of 4 m, numbered anew in each sweep; the ground is a cluster of its own."""
    cell = np.floor(POINTS[:, 0] / 4) * 2 + (POINTS[:, 1] > 0)
    number = np.unique(np.where(IS_GROUND, 1e6, cell), return_inverse=True)[1].reshape(-1)
    return np.random.default_rng(seed).permutation(number.max() + 1)[number]


def test_clusters_that_are_numbered_anew_in_each_sweep() -> None:
    reason = doubt(*(clusters(seed) % 19 for seed in range(4)))
    assert "the same place has other ids from sweep to sweep" in reason
    # also where the ground has its own number, and the number is the class of the road
    ground_is_0 = [np.where(IS_GROUND, ROAD, 11 + clusters(seed) % 8) for seed in range(4)]
    assert "the same place has other ids" in doubt(*ground_is_0)


def test_numbers_that_stay_but_do_not_fit_the_geometry() -> None:
    # building on the street, and road on the walls
    swapped = np.where(IS_GROUND, BUILDING, ROAD)
    assert "0% of the labelled ground has the class of a ground" in doubt(swapped, swapped)
    # the road is the road, but object number 1 is a wall, and 1 the class of a sidewalk
    sidewalk = np.where(IS_VAN, SIDEWALK, CLASSES)
    assert "100% of the points of a ground class lie away from the ground" in doubt(sidewalk)

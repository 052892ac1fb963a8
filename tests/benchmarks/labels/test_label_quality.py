from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from semloc_logs.benchmarks.labels.label_quality import (
    confusion,
    intersection_over_union,
    measure_labels,
)
from semloc_logs.errors import SemlocError
from semloc_logs.settings import Settings

KITTI = ("kitti00_000052", "kitti00_000088", "kitti00_000850", "kitti00_004501")


def test_confusion_by_hand() -> None:
    truth = np.array([0, 1, 9, 2, 4, 8, 8, 5, 7, 13, 11, 255, 255], np.uint8)
    label = np.array([0, 0, 2, 2, 8, 8, 255, 5, 5, 255, 2, 0, 255], np.uint8)
    counts = confusion(truth, label)
    expected = np.zeros((5, 5), int)
    expected[0] = [2, 1, 0, 0, 0]
    expected[1] = [0, 1, 1, 0, 0]
    expected[2] = [0, 0, 1, 0, 1]
    expected[3] = [0, 0, 0, 2, 0]
    expected[4] = [0, 1, 0, 0, 1]
    assert counts.tolist() == expected.tolist()
    assert intersection_over_union(counts) == pytest.approx([2 / 3, 1 / 4, 1 / 3, 1.0])


def test_a_class_that_the_truth_lacks_has_no_iou() -> None:
    counts = confusion(np.array([0, 0], np.uint8), np.array([0, 5], np.uint8))
    iou = intersection_over_union(counts)
    assert iou[0] == pytest.approx(0.5)
    assert np.isnan(iou[1:]).all()


def test_real_sweeps(shared: Callable[[str], Path]) -> None:
    """Thresholds are what has been reached, less a margin."""
    figures = measure_labels([shared(f"logs/{name}.mcap") for name in KITTI], Settings().resolved())
    least = {"mean": 0.59, "ground": 0.88, "construction": 0.75, "vegetation": 0.42, "pole": 0.25}
    for name, iou in least.items():
        for what in ("points", "voxels"):
            value = figures[f"{what}: {name}"]["ours"]
            assert isinstance(value, float)
            assert value > iou, (what, name, value)
    assert float(figures["points: vehicle or other"]["unlabelled"]) > 0.7


def test_a_log_without_labels_is_refused(shared: Callable[[str], Path]) -> None:
    with pytest.raises(SemlocError, match="label"):
        measure_labels([shared("logs/kitti_drive_camera_lidar.mcap")], Settings().resolved())

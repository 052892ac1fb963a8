"""Keyframes on their way through the scratch folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semloc_logs.errors import WorkspaceError
from semloc_logs.frames import Header, PosedCloud
from semloc_logs.mapping.keyframes import Collected

CLOUD = PosedCloud(
    Header("/points", 1, 2, "lidar"),
    np.arange(12, dtype=np.float32).reshape(4, 3),
    np.zeros(3, np.float32),
    None,
)


def test_keyframes_come_back_as_they_were_kept(tmp_path: Path) -> None:
    collected = Collected(tmp_path, 0.1)
    collected.add(CLOUD, np.array([0, 2]))
    collected.add(CLOUD, np.array([1]), np.array([7], np.uint32))
    points, label, sigma = collected.load(0)
    assert points.tolist() == [[0, 1, 2], [6, 7, 8]]
    assert label is None
    assert sigma is None
    points, label, _ = collected.load(1)
    assert points.tolist() == [[3, 4, 5]]
    assert label is not None
    assert label.tolist() == [7]


def test_a_scratch_folder_that_was_removed_is_no_empty_keyframe(tmp_path: Path) -> None:
    collected = Collected(tmp_path, 0.1)
    collected.add(CLOUD, np.array([0, 2]))
    (tmp_path / "0-points.npy").unlink()
    with pytest.raises(WorkspaceError, match="in one process at a time"):
        collected.load(0)

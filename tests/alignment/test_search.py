"""Hypotheses at the same pose are merged; hypotheses with opposite headings stay separate."""

from __future__ import annotations

import numpy as np

from semloc_logs.alignment.hypotheses import Hypothesis
from semloc_logs.alignment.search import _Searched, _suppressed


def test_only_hypotheses_of_one_place_and_heading_are_one() -> None:
    poses = [
        (0.1, 5.0, 5.0, 0.0),
        (0.1 + np.pi, 5.0, 5.0, 0.0),
        (0.12, 5.1, 5.0, 0.0),
        (0.1 + 2 * np.pi, 5.0, 5.1, 0.0),
        (0.1, 9.0, 5.0, 0.0),
    ]
    searched = [_Searched(Hypothesis(3, pose, 1, 1.0), np.array(pose), 0.5) for pose in poses]
    kept = _suppressed(searched, 1.0, 10)
    assert [s.hypothesis.pose for s in kept] == [poses[0], poses[1], poses[4]]
    assert len(_suppressed(searched, 1.0, 2)) == 2
    submaps = [
        _Searched(Hypothesis(group, poses[0], 1, 1.0), np.array(poses[0]), 0.5) for group in (1, 2)
    ]
    assert len(_suppressed(submaps, 1.0, 10)) == 2
    assert _suppressed([], 1.0, 10) == []

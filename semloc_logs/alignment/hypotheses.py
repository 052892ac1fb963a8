"""Transformation hypotheses from word matches, pooled by voting (paper 3.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """``target_T_query`` as (yaw, x, y, z), radians and metres, in submap ``group``, with the word matches that voted for it."""

    group: int
    pose: tuple[float, float, float, float]
    votes: int
    weight: float


def pool(group: NDArray[np.integer], yaw: F64, translation: F64, weight: F64, cell: float, most: int) -> list[Hypothesis]:
    """The ``most`` heaviest cells of (submap, yaw, translation) space.

    Each match gives one hypothesis: ``yaw`` (n,) one of the search's headings, ``translation`` (n, 3). Votes are counted in cells of
    ``cell`` metres, once as they lie and once moved by half a cell, so that no true pose is split at a border in both.
    """
    if not len(group):
        return []
    heading = np.unique(yaw, return_inverse=True)[1]
    found: list[Hypothesis] = []
    for offset in (0.0, 0.5):
        ijk = np.floor(translation / cell + offset).astype(np.int64)
        key = np.stack([group, heading, ijk[:, 0], ijk[:, 1], ijk[:, 2]], 1)
        order = np.lexsort(key.T[::-1])
        start = np.flatnonzero(np.r_[True, (key[order][1:] != key[order][:-1]).any(1)])
        total = np.add.reduceat(weight[order], start)
        count = np.diff(np.r_[start, len(order)])
        best = np.lexsort((start, -total))[:most]
        mean = np.add.reduceat(translation[order] * weight[order, None], start)[best] / total[best, None]
        for i, b in enumerate(best):
            first = order[start[b]]
            pose = (float(yaw[first]), float(mean[i, 0]), float(mean[i, 1]), float(mean[i, 2]))
            found.append(Hypothesis(int(group[first]), pose, int(count[b]), float(total[b])))
    found.sort(key=lambda h: (-h.weight, h.group, h.pose))
    kept: list[Hypothesis] = []
    by_heading: dict[tuple[int, float], list[Hypothesis]] = {}
    for h in found:  # the same cell found twice is one hypothesis
        beside = by_heading.setdefault((h.group, h.pose[0]), [])
        if any(max(abs(a - b) for a, b in zip(h.pose, o.pose, strict=True)) < cell / 4 for o in beside):
            continue
        beside.append(h)
        kept.append(h)
        if len(kept) == most:
            break
    return kept


def of_best_groups(hypotheses: Sequence[Hypothesis], most: int) -> list[Hypothesis]:
    """Those in the ``most`` submaps that have the heaviest ones; of equals the submap with the lesser number."""
    heaviest: dict[int, float] = {}
    for h in hypotheses:
        heaviest[h.group] = max(heaviest.get(h.group, 0.0), h.weight)
    best = set(sorted(heaviest, key=lambda group: (-heaviest[group], group))[:most])
    return [h for h in hypotheses if h.group in best]

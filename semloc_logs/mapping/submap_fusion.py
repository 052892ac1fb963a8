"""Submaps: stretches of keyframes fused in one pass over them (paper 3.1)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.settings import ResolvedFusion
from semloc_logs.voxels.carve import Carver
from semloc_logs.voxels.grid import BlockMap, Fuser
from semloc_logs.voxels.store import Keyframe


def fuse_ranges(
    keyframes: Iterable[Keyframe],
    ranges: Sequence[tuple[int, int]],
    poses: F64,
    origins: Sequence[NDArray[np.floating]],
    fusion: ResolvedFusion,
) -> Iterator[BlockMap]:
    """The map of each of ``ranges`` [first, last) of ``keyframes``, which come one by one.

    Both bounds of the ranges never decrease. ``poses`` (n, 4, 4) are map_T_base, ``origins`` (3,)
    of the sensor in the base frame. Only the ranges that hold the current keyframe are in memory:
    the others are not begun, or done.
    """
    carver = Carver(fusion)
    active = dict[int, Fuser]()
    begun = 0
    for i, keyframe in enumerate(keyframes):
        while begun < len(ranges) and ranges[begun][0] <= i:
            active[begun] = Fuser(fusion)
            begun += 1
        if active:
            marks = carver.marks(
                keyframe.points, keyframe.label, origins[i], keyframe.sigma, poses[i]
            )
            for fuser in active.values():
                fuser.take(marks)
        for number in [n for n in active if ranges[n][1] == i + 1]:
            yield active.pop(number).finish()

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from semloc_logs.mapping.selection import submap_ranges
from semloc_logs.mapping.submap_fusion import fuse_ranges
from semloc_logs.settings import Fusion, Settings
from semloc_logs.voxels.grid import Fuser
from semloc_logs.voxels.store import Keyframe

FUSION = Settings(fusion=Fusion(voxel_size=0.5, max_range=6.0)).resolved().fusion
N = 9
RNG = np.random.default_rng(0)
KEYFRAMES = [
    Keyframe(
        RNG.uniform(-5, 5, (40, 3)).astype(np.float32), RNG.integers(0, 19, 40).astype(np.uint8)
    )
    for _ in range(N)
]
POSES = np.tile(np.eye(4), (N, 1, 1))
POSES[:, 0, 3] = np.arange(N)
ORIGINS = [np.array([0.1, 0.2, 0.3], np.float32)] * N


@given(st.floats(0.5, 12.0), st.floats(0.0, 0.8))
@settings(max_examples=25)
def test_submaps_fused_in_passing_are_those_fused_one_by_one(length: float, overlap: float) -> None:
    ranges = submap_ranges(np.arange(N, dtype=float), length, overlap)
    submaps = list(fuse_ranges(KEYFRAMES, ranges, POSES, ORIGINS, FUSION))
    assert len(submaps) == len(ranges)
    for (first, last), blocks in zip(ranges, submaps, strict=True):
        alone = Fuser(FUSION)
        for i in range(first, last):
            alone.add(KEYFRAMES[i].points, KEYFRAMES[i].label, ORIGINS[i], None, POSES[i])
        expected = alone.finish()
        for name in ("keys", "log_odds", "state", "ballots", "votes"):
            np.testing.assert_array_equal(getattr(blocks, name), getattr(expected, name))


def test_a_submap_is_given_as_soon_as_its_road_ends() -> None:
    seen = []

    def coming() -> Iterator[Keyframe]:
        for i, keyframe in enumerate(KEYFRAMES):
            seen.append(i)
            yield keyframe

    submaps = fuse_ranges(coming(), [(0, 3), (2, 5), (6, 9)], POSES, ORIGINS, FUSION)
    next(submaps)
    assert seen == [0, 1, 2]
    next(submaps)
    assert seen == [0, 1, 2, 3, 4]
    assert len(list(submaps)) == 1
    assert seen == list(range(N))
    assert not list(fuse_ranges(coming(), [], POSES, ORIGINS, FUSION))
    assert seen[-N:] == list(range(N))  # keyframes that are in no submap are taken all the same

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.voxels.carve import CLASSES, Grid, Rays, addresses, carve, mark_ends, to_rays
from semloc_logs.voxels.keys import BLOCK

Walk = Callable[..., NDArray[np.uint8]]


def walk_rays(
    origin: NDArray[np.float64],
    ends: NDArray[np.float64],
    hit: list[bool],
    blocks: tuple[int, int, int] = (1, 1, 1),
    guard: int = 0,
) -> NDArray[np.uint8]:
    """Marks (x, y, z) of rays in voxels: 0 nothing, 1 passed, 2 hit. ``guard`` bytes around the
    grid have to stay untouched.
    """
    count = int(np.prod(blocks)) << 12
    room = np.zeros(count + 2 * guard, np.uint8)
    marks = room[guard : guard + count]
    touched = np.zeros(count >> 12, np.uint8)
    grid = Grid(marks, touched, *addresses(blocks))
    nothing = np.zeros(0, np.float32)
    for end, is_hit in zip(ends, hit, strict=True):
        # a limit of almost the length makes it a ray that ends at its end and does not hit
        limit = 1e9 if is_hit else float(np.linalg.norm(end - origin)) * (1 - 1e-15)
        votes = np.zeros((1, CLASSES), np.uint32)
        label = np.full(1, 2, np.uint8)  # a class whose surfaces are not level
        offset, length, low, high = to_rays(end[None], np.eye(4), origin, 1.0, limit)
        assert (low <= np.minimum(origin, origin + offset[0])).all()
        assert (high >= np.maximum(origin, origin + offset[0])).all()
        _, carved = mark_ends(grid, Rays(origin, offset, length, limit, label, nothing), votes)
        carve(grid, origin, carved)
    assert not room[:guard].any()
    assert not room[guard + count :].any()
    dense = (
        marks.reshape(*blocks, BLOCK, BLOCK, BLOCK)
        .transpose(0, 3, 1, 4, 2, 5)
        .reshape(np.array(blocks) * BLOCK)
    )
    assert set(np.flatnonzero(touched)) == set(np.flatnonzero(marks.reshape(-1, 4096).any(1)))
    return np.where(dense > 1, 2, dense).astype(np.uint8)


@pytest.fixture
def walk() -> Walk:
    return walk_rays

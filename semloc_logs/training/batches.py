"""Batches of training pairs out of packed shards: a fixed random sequence, the same from whichever
step it is begun.

A pool is some row groups of some scenes; batches are drawn from it until each of its pairs was
drawn about once. The next pool is read by other threads meanwhile. Scenes come into use one after
the other and leave again (``schedule.scene_window``), so that they can be made while the network
trains and dropped afterwards. What is random about a pair is drawn where the network runs.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from semloc_logs.arrays import U8
from semloc_logs.errors import SettingsError
from semloc_logs.settings import Training
from semloc_logs.training.pairs import ROW_GROUP, read_shard
from semloc_logs.training.schedule import FIRST_SCENES, samples_after, scene_window
from semloc_logs.voxels.grid import UNOBSERVED_STATE

Pairs = tuple[U8, U8, U8]
# s beyond a deadline for pairs that are being read; scenes that are still to be made take longer
PATIENCE = 5.0
READERS = 4
AHEAD = 3  # batches that are put together before they are needed


class OutOfTime(Exception):
    """The deadline passed while a scene was being made."""


class Batch(NamedTuple):
    """Voxel states uint8: incomplete (b, 64, 64, 32), complete (b, 32, 32, 32), complete and a
    little moved (b, 64, 64, 32).
    """

    incomplete: Tensor
    complete: Tensor
    other: Tensor


def _plan(number: int, samples: int, shards: int, training: Training) -> list[tuple[int, int]]:
    """Scene and row group of each part of the pool ``number``, before which ``samples`` samples
    have been seen.
    """
    draw = np.random.default_rng((training.seed, number))
    parts = max(FIRST_SCENES, training.batch)
    window = scene_window(samples, shards, training.method)
    rounds = [draw.permutation(window) for _ in range(-(-parts // len(window)))]
    scenes = np.concatenate(rounds)[:parts]
    return list(zip(scenes.tolist(), draw.integers(1 << 16, size=parts).tolist(), strict=True))


def batches(
    shards: Sequence[Path],
    training: Training,
    first: int,
    steps: int,
    device: str = "cpu",
    *,
    deadline: float = math.inf,
) -> Iterator[Batch]:
    """The batches of the steps ``first`` .. ``steps`` - 1.

    ``shards[i]`` may wait until the scene is there. Raises OutOfTime where it still waits when
    ``time.monotonic()`` has passed ``deadline`` by a few seconds, and SettingsError when shards
    without a single pair are all there is.
    """
    per_pool = max(1, max(FIRST_SCENES, training.batch) * ROW_GROUP // training.batch)
    pools = -(-steps // per_pool)
    readers = ThreadPoolExecutor(READERS)

    def begin(number: int) -> list[Future[Pairs]]:
        plan = _plan(number, samples_after(number * per_pool, training), len(shards), training)
        return [readers.submit(_read, shards, scene, group) for scene, group in plan]

    try:
        coming = begin(first // per_pool)
        for number in range(first // per_pool, pools):
            pool = [
                pairs
                for pairs in (_in_time(future, deadline) for future in coming)
                if len(pairs[0])
            ]
            coming = begin(number + 1) if number + 1 < pools else []
            if not pool:
                raise SettingsError(
                    "There is nothing to train on: "
                    "none of the scenes or stretches of road gave a pair of subvolumes."
                )
            wanted = iter(range(max(first, number * per_pool), min(steps, (number + 1) * per_pool)))
            drawn = deque(
                readers.submit(_drawn, pool, training, step) for step in islice(wanted, AHEAD)
            )
            while drawn:
                this = drawn.popleft().result()
                drawn.extend(
                    readers.submit(_drawn, pool, training, step) for step in islice(wanted, 1)
                )
                yield _turned(this, training, device)
    finally:
        readers.shutdown(wait=False, cancel_futures=True)


def _in_time(future: Future[Pairs], deadline: float) -> Pairs:
    if deadline == math.inf:
        return future.result()
    try:
        return future.result(max(0.0, deadline - time.monotonic()) + PATIENCE)
    except TimeoutError:
        raise OutOfTime from None


def _read(shards: Sequence[Path], scene: int, group: int) -> Pairs:
    # waits, in a thread of its own, for a scene that is not there yet
    return read_shard(shards[scene], group)


class _Drawn(NamedTuple):
    """Pairs of one step, and how they are to be turned, mirrored and thinned."""

    views: Pairs
    quarter: int
    mirror: bool
    seed: int


def _drawn(pool: Sequence[Pairs], training: Training, step: int) -> _Drawn:
    rng = np.random.default_rng((training.seed, 1, step))
    scenes = rng.integers(len(pool), size=training.batch)
    rows = [int(rng.integers(len(pool[s][0]))) for s in scenes]
    a, b, c = (
        np.stack([pool[s][k][r] for s, r in zip(scenes, rows, strict=True)]) for k in range(3)
    )
    quarter = int(rng.integers(4))
    mirror = bool(rng.integers(2)) and training.method == "ours"
    return _Drawn((a, b, c), quarter, mirror, int(rng.integers(1 << 62)))


def _turned(drawn: _Drawn, training: Training, device: str) -> Batch:
    """The batch where the network runs; quarter turns and mirror images of the whole triple are as
    good as new streets. The paper turns, and does not mirror.
    """
    views = (torch.from_numpy(view).to(device) for view in drawn.views)
    a, b, c = (torch.rot90(v.flip(1) if drawn.mirror else v, drawn.quarter, (1, 2)) for v in views)
    generator = torch.Generator(device).manual_seed(drawn.seed)
    dropped = torch.rand(a.shape, generator=generator, device=device) < training.dropout
    return Batch(a.masked_fill(dropped, UNOBSERVED_STATE), b.contiguous(), c.contiguous())

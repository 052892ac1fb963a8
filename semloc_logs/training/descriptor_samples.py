"""Descriptors of packed training pairs: what a vocabulary is trained on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from semloc_logs.subvolumes.cut import SIZE, code_table
from semloc_logs.subvolumes.network import Encoder, descriptors
from semloc_logs.subvolumes.plain_network import PlainEncoder
from semloc_logs.training.pairs import read_shard

TOGETHER = 8  # views that are described together
# corners (9, 3) of the subvolumes of a complete view
NINE = np.array([(x, y, 0) for x in range(0, 33, SIZE // 2) for y in range(0, 33, SIZE // 2)])


@torch.inference_mode()
def shard_descriptors(
    shards: Sequence[Path],
    encoder: Encoder,
    pairs_per_shard: int | None = None,
    note: Callable[[str], None] | None = None,
) -> NDArray[np.float16]:
    """Unit descriptors (n, N), nine of the complete view of each of the first pairs (of all without
    ``pairs_per_shard``).

    One shard is in memory at a time; descriptors have half precision, which is finer than the
    rounding of a vocabulary.
    """
    table = code_table(encoder.variant)
    out = []
    for done, path in enumerate(shards, 1):
        views = read_shard(path)[2][:pairs_per_shard]
        for i in range(0, len(views), 16):
            with torch.autocast("cpu", dtype=torch.bfloat16):
                mu = encoder(torch.from_numpy(table[views[i : i + 16]]))
            out.append(descriptors(mu).half().numpy())
        if note is not None:
            note(f"{encoder.variant}: descriptors of {done} of {len(shards)} shards")
    return np.concatenate(out) if out else np.zeros((0, 256), np.float16)


def plain_shard_descriptors(
    shards: Sequence[Path],
    encoder: PlainEncoder,
    pairs_per_shard: int | None = None,
    note: Callable[[str], None] | None = None,
) -> NDArray[np.float32]:
    """Descriptors mu (n, N) of the paper's network, nine of the complete view of each pair, 16
    voxels apart: the words of the training maps.
    """
    table = code_table(encoder.variant)

    @torch.inference_mode()  # of a thread
    def nine_each(some: NDArray[np.uint8]) -> NDArray[np.float32]:
        codes = table[some].reshape(-1, *some.shape[2:])  # one behind the other along x
        along = np.arange(len(some))[:, None, None] * (some.shape[1], 0, 0)
        corners = (NINE + along).reshape(-1, 3)
        return torch.cat([*encoder.of_windows(codes, corners, len(corners))]).numpy()

    out: list[NDArray[np.float32]] = []
    # the first block is compiled code of one thread
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for done, path in enumerate(shards, 1):
            views = read_shard(path)[2][:pairs_per_shard]
            parts = [views[i : i + TOGETHER] for i in range(0, len(views), TOGETHER)]
            out += pool.map(nine_each, parts)
            if note is not None:
                note(f"{encoder.variant}: descriptors of {done} of {len(shards)} shards")
    return np.concatenate(out) if out else np.zeros((0, encoder.latent), np.float32)

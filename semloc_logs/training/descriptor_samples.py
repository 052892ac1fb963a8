"""Descriptors of packed training pairs: what a vocabulary is trained on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from semloc_logs.subvolumes.cut import code_table
from semloc_logs.subvolumes.network import Encoder, descriptors
from semloc_logs.training.pairs import read_shard


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

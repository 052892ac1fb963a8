"""Descriptors of packed training pairs: what a vocabulary is trained on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from semloc_logs.subvolumes.cut import code_table
from semloc_logs.subvolumes.network import Encoder, descriptors
from semloc_logs.subvolumes.pairs import read_shard


@torch.inference_mode()
def shard_descriptors(shards: Sequence[Path], encoder: Encoder, pairs_per_shard: int = 150) -> NDArray[np.float32]:
    """Unit descriptors (n, 256), nine of each of the first pairs' complete view."""
    table = code_table(encoder.variant)
    out = []
    for path in shards:
        views = read_shard(path)[2][:pairs_per_shard]
        for i in range(0, len(views), 16):
            with torch.autocast("cpu", dtype=torch.bfloat16):
                mu = encoder(torch.from_numpy(table[views[i : i + 16]]))
            out.append(descriptors(mu).numpy())
    return np.concatenate(out) if out else np.zeros((0, 256), np.float32)

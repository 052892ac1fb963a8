"""Subvolumes as the network completes them, to measure and to look at (paper 3.2, 4.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from semloc_logs.arrays import U8
from semloc_logs.settings import Training
from semloc_logs.subvolumes.cut import CLASSES, SIZE, code_table
from semloc_logs.subvolumes.network import Completion
from semloc_logs.subvolumes.weight_files import load_weights
from semloc_logs.voxels.grid import FREE_STATE

BATCH = 16


COUNTED = Training().occupied_weight


# of 1, 2, 3, 5 and 10 the best mean IoU on a simulated street that is not among the SEEDS
BALANCED = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Completed:
    """Subvolumes as network codes (n, 32, 32, 32): observed, completed, true.

    As few frames observed them; as the network completes them; the same with the most probable
    label of each voxel; as all frames observed them. ``classes`` is the code of free voxels.
    """

    given: U8
    completed: U8
    probable: U8
    truth: U8
    classes: int


def load_completion(variant: str, weights: Path | None = None) -> Completion:
    """The shipped network of ``variant`` with its decoder, or the network of a file.

    SettingsError when the file does not hold one.
    """
    return load_weights(Completion, "", variant, weights)


@torch.inference_mode()
def completed(model: Completion, pairs: tuple[U8, U8, U8]) -> Completed:
    """The incomplete views of ``pairs``, as :func:`training.pairs.read_shard` gives, completed."""
    table = code_table(model.encoder.variant)
    classes = CLASSES[model.encoder.variant]
    given = table[pairs[0]]
    predicted, probable = (np.zeros((len(given), SIZE, SIZE, SIZE), np.uint8) for _ in range(2))
    for i in range(0, len(given), BATCH):
        logits = model.complete(torch.from_numpy(given[i : i + BATCH]))[:, : classes + 1]
        for out, weight in ((predicted, BALANCED), (probable, COUNTED)):
            # an occupied voxel counted so often in training: its odds are too large by that
            excess = torch.tensor([math.log(weight)] * classes + [0.0])
            out[i : i + BATCH] = (logits - excess[:, None, None, None]).argmax(1).numpy()
    return Completed(
        np.ascontiguousarray(given[:, 16:-16, 16:-16]),
        predicted,
        probable,
        table[pairs[1]],
        classes,
    )


def states_of(codes: U8, classes: int) -> U8:
    """Voxel states of codes: classes, 254 free, 253 unobserved, 255 occupied of no known class."""
    table = np.full(256, 255, np.uint8)
    if classes > 1:
        table[:classes] = np.arange(classes)
    table[[classes, classes + 1]] = FREE_STATE, 253
    return table[codes]

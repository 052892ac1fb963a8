"""How well the network completes subvolumes: what counts, and the scores on a held-out shard (paper
3.2 and 4.3).
"""

from __future__ import annotations

import numpy as np
import torch

from semloc_logs.arrays import U8
from semloc_logs.subvolumes.cut import CLASSES, code_table
from semloc_logs.subvolumes.network import Network, descriptors
from semloc_logs.training.network_training import targets


@torch.inference_mode()
def completion_scores(model: Network, pairs: tuple[U8, U8, U8]) -> dict[str, float]:
    """How well the subvolumes of a held-out shard are completed, beside the trivial answers, and
    found again.

    ``accuracy``: share of the complete map's observed voxels with the right label (the paper's
    figure); ``iou``: mean over the classes that occur; ``unobserved_accuracy``: over voxels that
    the input did not observe; ``all_free``, ``copy_input``: accuracy of the two trivial answers;
    ``recall5``: share of incomplete subvolumes with their partner among the five nearest.
    """
    model.eval()
    variant = model.encoder.variant
    table = code_table(variant)
    classes = CLASSES[variant]
    confusion = np.zeros((classes + 1, classes + 1), np.int64)
    right = seen = free = copied = hidden = hidden_right = 0
    ours = []
    theirs = []
    for i in range(0, len(pairs[0]), 32):
        part, whole, other = (a[i : i + 32] for a in pairs)
        codes = torch.from_numpy(table[part])
        logits, mu, _ = model(codes, None)
        ours.append(descriptors(_middle(mu)))
        theirs.append(descriptors(_middle(model.encoder(torch.from_numpy(table[other])))))
        completed = model.volumes(logits)[:, : classes + 1].argmax(1).numpy()
        target, known = (
            t.numpy() for t in targets(torch.from_numpy(whole), torch.from_numpy(table), classes)
        )
        given = table[part[:, 16:-16, 16:-16]]
        seen += int(known.sum())
        right += int((known & (completed == target)).sum())
        free += int((known & (target == classes)).sum())
        copied += int((known & (given == target)).sum())
        unseen = known & (given == classes + 1)
        hidden += int(unseen.sum())
        hidden_right += int((unseen & (completed == target)).sum())
        np.add.at(confusion, (target[known], completed[known]), 1)
    inter = np.diag(confusion)[:classes]
    union = confusion.sum(0)[:classes] + confusion.sum(1)[:classes] - inter
    occurs = confusion.sum(1)[:classes] > 0
    rank = torch.cdist(torch.cat(ours), torch.cat(theirs))
    recall = (rank < rank.diag()[:, None]).sum(1).lt(5).float().mean()
    return {
        "accuracy": right / max(seen, 1),
        "all_free": free / max(seen, 1),
        "copy_input": copied / max(seen, 1),
        "unobserved_accuracy": hidden_right / max(hidden, 1),
        "iou": float((inter[occurs] / union[occurs]).mean()) if occurs.any() else 0.0,
        "recall5": float(recall),
    }


def _middle(mu: torch.Tensor) -> torch.Tensor:
    """Of the subvolumes (b, latent, i, j) the one in the middle, (b, latent, 1, 1)."""
    i, j = (count // 2 for count in mu.shape[2:])
    return mu[:, :, i : i + 1, j : j + 1]

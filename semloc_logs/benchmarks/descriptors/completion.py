"""`semloc benchmark completion`: how well the network completes subvolumes of streets that no
training has seen (paper 4.3, figure 3).
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from semloc_logs.arrays import I64
from semloc_logs.benchmarks.versions import simulation_version
from semloc_logs.pictures.completion_picture import draw_completions
from semloc_logs.settings import Resolved
from semloc_logs.subvolumes.completed import Completed, completed, load_completion, states_of
from semloc_logs.training.pairs import read_shard
from semloc_logs.training.scene_shards import SceneTask, make_shard

Figures = dict[str, dict[str, float | str]]

SEEDS = (9001, 9002, 9003, 9004)  # of held-out streets; seeds of training count from 0
PAIRS = 150  # of a street at most
PAPER = 0.87  # accuracy (4.3)
SHOWN = 6  # subvolumes in the picture


def completion_figures(completions: Completed) -> Figures:
    """Over the voxels that the complete map observed, as classes or free; ``all_free`` and
    ``copy_input`` are the two trivial answers.

    ``ours`` weighs occupied voxels three times, ``most_probable`` is the likeliest label of each
    voxel, ``input_completed`` keeps the observations of the input and is ours elsewhere.

    ``accuracy``: share of right labels (the paper's figure); ``unobserved_accuracy``: the same
    where the input observed nothing; ``mean_iou``: mean over the occupied classes that occur;
    ``occupied_iou``, ``free_iou``: of occupied and free whatever the class.
    """
    known = completions.truth <= completions.classes
    truth = completions.truth[known]
    answers = {
        "ours": completions.completed[known],
        "most_probable": completions.probable[known],
        "all_free": np.full_like(truth, completions.classes),
        "copy_input": completions.given[known],
    }
    hidden = answers["copy_input"] == completions.classes + 1
    answers["input_completed"] = np.where(hidden, answers["ours"], answers["copy_input"])
    figures: Figures = {}
    for who, codes in answers.items():
        confusion = np.bincount(truth.astype(np.int64) * 32 + codes, minlength=32 * 32).reshape(
            32, 32
        )
        scores = _scores(confusion, completions.classes)
        scores["unobserved_accuracy"] = (
            float((codes == truth)[hidden].mean()) if hidden.any() else 0.0
        )
        for name, value in scores.items():
            figures.setdefault(name, {})[who] = value
    figures["accuracy"]["paper"] = PAPER
    for name, row in figures.items():
        row["unit"] = f"{'IoU' if name.endswith('iou') else 'share'} of {len(truth)} voxels"
    return figures


def _scores(confusion: I64, classes: int) -> dict[str, float]:
    """Of a confusion (32, 32) of true and given codes."""
    total = max(int(confusion.sum()), 1)
    right = np.diag(confusion)
    union = confusion.sum(0) + confusion.sum(1) - right
    occurs = np.flatnonzero(confusion.sum(1)[:classes])
    # occupied, class unknown: as good as any class for whether something is there
    unknown = classes + 2
    filled = np.isin(np.arange(32), [*range(classes), unknown])
    both = int(confusion[filled][:, filled].sum())
    either = int(confusion[filled].sum() + confusion[:, filled].sum()) - both
    return {
        "accuracy": int(right.sum()) / total,
        "mean_iou": float((right[occurs] / union[occurs]).mean()) if len(occurs) else 0.0,
        "occupied_iou": both / max(either, 1),
        "free_iou": int(right[classes]) / max(int(union[classes]), 1),
    }


def completion_benchmark(
    variant: str,
    settings: Resolved,
    weights: Path | None = None,
    work: Path | None = None,
    picture: Path | None = None,
    note: Callable[[str], None] = lambda _: None,
) -> Figures:
    """Figures on held-out streets, whose pairs are kept in the folder ``work``; ``picture`` is a
    PNG of some of them to look at.
    """
    model = load_completion(variant, weights)
    with ExitStack() as stack:
        folder = work or Path(
            stack.enter_context(tempfile.TemporaryDirectory(prefix="semloc-completion-"))
        )
        parts = []
        for number, seed in enumerate(SEEDS):
            shard = (
                folder
                / "pairs"
                / simulation_version()
                / f"street-{seed}-{settings.fingerprint('fusion', 'training')}.parquet"
            )
            shard.parent.mkdir(parents=True, exist_ok=True)
            pairs = read_shard(make_shard(SceneTask(seed, shard, settings)))
            rows = np.random.default_rng(seed).permutation(len(pairs[0]))[:PAIRS]
            parts.append(tuple(a[np.sort(rows)] for a in pairs))
            note(f"pairs of {number + 1} of {len(SEEDS)} streets are cut")
    a, b, c = (np.concatenate([p[k] for p in parts]) for k in range(3))
    completions = completed(model, (a, b, c))
    if picture is not None:
        rows = _worth_seeing(completions)
        draw_completions(
            picture,
            variant,
            *(
                states_of(v[rows], completions.classes)
                for v in (completions.given, completions.completed, completions.truth)
            ),
        )
    return completion_figures(completions)


def _worth_seeing(completions: Completed) -> I64:
    """Rows with much to complete and many classes, far from each other in the list."""
    occupied = completions.truth < completions.classes
    hidden = (occupied & (completions.given == completions.classes + 1)).sum(
        (1, 2, 3)
    ) / np.maximum(occupied.sum((1, 2, 3)), 1)
    kinds = np.array([len(np.unique(t[t < completions.classes])) for t in completions.truth])
    score = kinds + 5 * hidden + 5 * np.minimum(occupied.mean((1, 2, 3)) / 0.1, 1)
    groups = np.array_split(np.arange(len(score)), min(SHOWN, len(score)))
    return np.array([g[np.argmax(score[g])] for g in groups if len(g)], np.int64)

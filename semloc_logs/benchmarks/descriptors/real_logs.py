"""Two real logs whose true alignment is known, for the benchmarks of the descriptor."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from semloc_logs.benchmarks.descriptors.places import Street
from semloc_logs.benchmarks.descriptors.word_matches import (
    WordRecall,
    real_street,
    true_queries,
    word_recall,
)
from semloc_logs.benchmarks.fused_sessions import fused_maps
from semloc_logs.evaluation.truth import read_truth
from semloc_logs.settings import Resolved
from semloc_logs.subvolumes.describe import load_encoder
from semloc_logs.subvolumes.network import Encoder, random_encoder
from semloc_logs.words.vocabulary import Vocabulary, load_vocabulary

Figures = dict[str, dict[str, float | str]]
VARIANTS = ("semantic", "geometric")
SEEDS = 3  # random networks, of which the mean counts
# sources of labels, and the scenarios of the retrieval benchmark that use them
SCENARIOS = {"auto": ("real_log", "real_geometric"), "geometry": ("real_geometry_labels",)}


def word_recalls(logs: Sequence[Path], truth: Path, settings: Resolved) -> Figures:
    """Recall at 5 of word matches within 1.5 m between two logs, trained beside random weights.

    Every query of the second log is matched with the map of the first one, in the search's heading
    nearest to the true one; queries farther than 10 m from the first log's road do not count.
    ``random`` is the mean over three seeds, with a vocabulary of their own.
    """
    with tempfile.TemporaryDirectory(prefix="semloc-words-") as folder:
        target, query = fused_maps(logs, Path(folder), settings)
        tracks = read_truth(truth, {m.folder.name: m for m in (target, query)})
        queries = true_queries(query, target, tracks, settings)

        def recalls(encoder: Encoder, vocabulary: Vocabulary | None) -> list[WordRecall]:
            return [word_recall(true, settings, encoder, vocabulary) for true in queries]

        figures: Figures = {}
        for variant in VARIANTS:
            encoder = load_encoder(variant, settings.descriptor.weights)
            vocabulary = load_vocabulary(variant, settings.descriptor.vocabulary)
            by_weights = {
                "ours": recalls(encoder, vocabulary),
                "random weights": [
                    recall
                    for seed in range(SEEDS)
                    for recall in recalls(random_encoder(variant, seed), None)
                ],
            }
            for attribute, name in (
                ("exact", "by descriptor"),
                ("coded", "by word and code"),
            ):
                row: dict[str, float | str] = {
                    weights: float(np.mean([getattr(recall, attribute) for recall in rows]))
                    for weights, rows in by_weights.items()
                    if rows
                }
                figures[f"{variant}, {name}"] = row | {"unit": "recall at 5"}
        return figures


def real_streets(logs: Sequence[Path], truth: Path, settings: Resolved) -> dict[str, Street]:
    """The queries of the first log and the map of the second one, by scenario.

    With the log's labels and with labels from geometry, under the names of
    :data:`semloc_logs.benchmarks.descriptors.retrieval.REAL`.
    """
    streets: dict[str, Street] = {}
    for source, names in SCENARIOS.items():
        labelled = settings.model_copy(
            update={"labels": settings.labels.model_copy(update={"source": source})}
        )
        with tempfile.TemporaryDirectory(prefix="semloc-real-") as folder:
            query, target = fused_maps(logs, Path(folder), labelled)
            tracks = read_truth(truth, {m.folder.name: m for m in (query, target)})
            streets |= {name: real_street(query, target, tracks, name, labelled) for name in names}
    return streets

"""Ablations: our pipeline without one of the things that it has beyond the paper.

A query is localised by itself in these experiments, so no row has the votes of neighbours; their
gain is in the acceptance, which ``semloc benchmark localisation`` measures. Rows whose network was
trained otherwise need its weights and vocabulary (:func:`training_command`). Layers that do not
turn with their input have no row: the stages describe a map once for all quarter turns, which such
a network cannot do (``benchmarks/ablation.py`` compares networks by themselves).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from semloc_logs.alignment.hypotheses import Hypothesis
from semloc_logs.alignment.mask_grid import FREE_BIT, MaskGrid
from semloc_logs.alignment.query_map import Query as QueryMap
from semloc_logs.alignment.search import Candidate
from semloc_logs.arrays import F32
from semloc_logs.benchmarks.localisation.our_method import sweep_words
from semloc_logs.closures.closure import Alignment
from semloc_logs.closures.database import Database
from semloc_logs.closures.matching import (
    MatchWords,
    QueryContext,
    find_hypotheses,
    match_words,
    turned_matches,
)
from semloc_logs.errors import SettingsError, did_you_mean
from semloc_logs.experiments.system import RankedPose
from semloc_logs.experiments.systems.ours import Ours
from semloc_logs.settings import Resolved, Settings, validated
from semloc_logs.subvolumes.cut import MARGIN, SIZE, WIDE, code_table
from semloc_logs.subvolumes.describe import (
    Described,
    Windows,
    describe_map,
    load_encoder,
    quarter_turns,
)
from semloc_logs.subvolumes.network import Encoder, descriptors
from semloc_logs.voxels.grid import UNOBSERVED_STATE
from semloc_logs.words.index import Allowed, Matches

BATCH = 64  # subvolumes that are encoded together


@dataclass(frozen=True, slots=True)
class Ablation:
    """A row: our pipeline with other ``settings`` (by key path), or with parts replaced.

    ``match`` finds the words of a query; ``contradicts``: free space counts against a pose;
    ``fitted``: candidates are fitted on points; ``training``: settings that its network was trained
    with, if not ours.
    """

    settings: Mapping[str, object] = field(default_factory=dict)
    match: MatchWords = match_words
    contradicts: bool = True
    fitted: bool = True
    training: Mapping[str, object] = field(default_factory=dict)


def alone_words(
    database: Database, variant: str, allowed: Allowed, query: QueryMap, ground_z: float
) -> tuple[Described, Matches]:
    """Word matches of subvolumes of the query that are described one by one, without a margin."""
    settings = database.settings
    descriptor = settings.descriptor
    closures = settings.closures
    low, high = query.blocks.bounds()
    state = query.blocks.dense(low, tuple((high - low).tolist()))
    encoder = load_encoder(variant, descriptor.weights)
    windows = Windows(settings.fusion.voxel_size, descriptor.query_stride, descriptor.min_occupied)
    together = describe_map(state, low, ground_z, encoder, windows)
    alone = Described(together.centre, described_alone(state, low, together.centre, encoder))
    words = database.words(variant)
    quarters = [
        words.search(
            quarter_turns(alone.descriptor, turns), closures.neighbours, closures.probes, allowed
        )
        for turns in range(4)
    ]
    return alone, turned_matches(quarters)


@torch.inference_mode()
def described_alone(
    state: NDArray[np.uint8], low: NDArray[np.integer], centre: F32, encoder: Encoder
) -> F32:
    """Descriptors (n, latent) of the subvolumes at ``centre`` (n, 3), each cut out of the map."""
    table = code_table(encoder.variant)
    pad = SIZE
    box = np.pad(state, pad, constant_values=UNOBSERVED_STATE)
    corners = np.round(centre - SIZE / 2).astype(np.int64) - np.asarray(low) + pad
    out = np.zeros((len(centre), encoder.latent), np.float32)
    inner = slice(MARGIN, MARGIN + SIZE)
    for first in range(0, len(corners), BATCH):
        part = corners[first : first + BATCH]
        wide = np.full((len(part), WIDE, WIDE, SIZE), UNOBSERVED_STATE, np.uint8)
        for row, (x, y, z) in enumerate(part.tolist()):
            wide[row, inner, inner] = box[x : x + SIZE, y : y + SIZE, z : z + SIZE]
        with torch.autocast("cpu", dtype=torch.bfloat16):
            mu = encoder(torch.from_numpy(table[wide]))
        out[first : first + BATCH] = descriptors(mu).numpy()
    return out


ABLATIONS: dict[str, Ablation] = {
    "ours-no-classes": Ablation({"descriptor.variant": "geometric"}),
    "ours-every-heading": Ablation(match=sweep_words),
    "ours-alone": Ablation(match=alone_words),
    "ours-stride-4": Ablation({"descriptor.stride": 4, "descriptor.query_stride": 4}),
    "ours-one-neighbour": Ablation({"closures.neighbours": 1}),
    "ours-no-free-space": Ablation(contradicts=False),
    "ours-not-refined": Ablation(fitted=False),
    "ours-no-contrast": Ablation(training={"contrastive_weight": 0}),
    "ours-64": Ablation(training={"latent": 64}),
    "ours-512": Ablation(training={"latent": 512}),
}


def with_settings(settings: Resolved, changes: Mapping[str, object]) -> Resolved:
    """The settings with some changed, by key path."""
    content = settings.model_dump()
    for key, value in changes.items():
        section, name = key.split(".")
        content[section][name] = value
    return validated(content).resolved()


def training_command(name: str, folder: Path) -> str:
    """The commands that make the network and the words of a row."""
    options = " ".join(f"--set training.{k}={v}" for k, v in ABLATIONS[name].training.items())
    weights = folder / "semantic.safetensors"
    return (
        f"semloc train --variant semantic -o {folder} {options} && semloc vocabulary --variant"
        f" semantic -o {folder / 'words.safetensors'} --checkpoint {folder / 'checkpoint'}"
        f" --set descriptor.weights={weights}"
    )


def ablated(
    name: str,
    settings: Resolved | None = None,
    weights: Path | None = None,
    work: Path | None = None,
) -> Ours:
    """The system of a row of ``ABLATIONS``; SettingsError for another name.

    A row with a network of its own finds it in the folder ``weights``; SettingsError where it is
    not there.
    """
    if name not in ABLATIONS:
        raise SettingsError(
            f"Unknown ablation '{name}': there are {', '.join(ABLATIONS)}."
            f"{did_you_mean(name, ABLATIONS)}"
        )
    row = ABLATIONS[name]
    changes = dict(row.settings)
    if row.training:
        folder = weights or Path("weights")
        files = {
            "descriptor.weights": folder / "semantic.safetensors",
            "descriptor.vocabulary": folder / "words.safetensors",
        }
        missing = [str(path) for path in files.values() if not path.exists()]
        if missing:
            raise SettingsError(
                f"its network is not trained, {missing[0]} is missing:"
                f" {training_command(name, folder)}"
            )
        changes |= files
    chosen = with_settings(settings or Settings().resolved(), changes)
    return _Ablated(name, chosen, work, row)


@dataclass(eq=False)
class _Ablated(Ours):
    """Our pipeline as a row has it."""

    row: Ablation = field(default_factory=Ablation)

    def _ranked(self, context: QueryContext) -> list[RankedPose]:
        if not self.row.contradicts:
            query = context.query
            query.__dict__["mask_grid"] = without_free_space(query.mask_grid)
        return super()._ranked(context)

    def _hypotheses(self, context: QueryContext) -> list[Hypothesis]:
        hypotheses = find_hypotheses(context, self.row.match)
        if not self.row.contradicts:
            for group in {h.group for h in hypotheses}:
                target = context.visible.target(group)
                target.__dict__["mask_grid"] = without_free_space(target.mask_grid)
        return hypotheses

    def _aligned(self, context: QueryContext, candidates: list[Candidate]) -> list[Alignment]:
        return super()._aligned(context, candidates) if self.row.fitted else []

    def _score(self, alignment: Alignment) -> float:
        return super()._score(alignment) if self.row.contradicts else alignment.features.structure


def without_free_space(grid: MaskGrid) -> MaskGrid:
    """The masks without the bit of free space: it neither contradicts nor is observed."""
    return MaskGrid(grid.mask & np.uint8(FREE_BIT - 1), grid.corner, grid.cell)

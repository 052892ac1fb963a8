"""Describing the submaps of a session: blocks -> semantic words (paper 3.3)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semloc_logs.settings import Settings
from semloc_logs.subvolumes.describe import Described, describe_map, load_encoder
from semloc_logs.subvolumes.network import Encoder
from semloc_logs.voxels.store import blocks_path, read_blocks
from semloc_logs.workspace import SessionFolder


@dataclass(frozen=True, slots=True)
class DescribeTask:
    """One submap to describe; picklable."""

    folder: SessionFolder
    submap: int
    ground_z: float
    variants: tuple[str, ...]
    output: Path
    metadata: dict[str, Any]
    settings: Settings  # resolved


def describe_submap(folder: SessionFolder, submap: int, ground_z: float, variant: str, settings: Settings) -> Described:
    """Centres (voxels) and descriptors of every described subvolume of a submap, by the encoder of ``variant``."""
    return describe_submap_with(folder, submap, ground_z, load_encoder(variant, settings.descriptor.weights), settings)


def describe_submap_with(folder: SessionFolder, submap: int, ground_z: float, encoder: Encoder, settings: Settings) -> Described:
    """As :func:`describe_submap`, by any encoder."""
    blocks = read_blocks(blocks_path(folder.blocks, submap))
    low, high = blocks.bounds()
    state = blocks.dense(low, tuple((high - low).tolist()))
    d = settings.descriptor
    return describe_map(state, low, ground_z, settings.fusion.voxel_size, encoder, d.stride, d.min_occupied)


def variants_for(label_source: str, settings: Settings) -> tuple[str, ...]:
    """Networks that describe a session: the geometric one always, the semantic one where classes come from a log or a model."""
    if settings.descriptor.variant != "auto":
        return (settings.descriptor.variant,)
    return ("geometric", "semantic") if label_source in ("log", "onnx") else ("geometric",)

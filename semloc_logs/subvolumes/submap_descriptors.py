"""Describing the submaps of a session: blocks -> semantic words (paper 3.3)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from semloc_logs.labels.space import KNOWS_CLASSES
from semloc_logs.settings import Resolved
from semloc_logs.subvolumes.cut import turned_map
from semloc_logs.subvolumes.describe import Described, Windows, describe_map
from semloc_logs.voxels.store import read_blocks
from semloc_logs.workspace import SessionFolder

if TYPE_CHECKING:
    from semloc_logs.subvolumes.network import Encoder


@dataclass(frozen=True, slots=True, eq=False)
class DescribeTask:
    """One submap to describe; picklable."""

    folder: SessionFolder
    submap: int
    ground_z: float
    road: NDArray[np.float64]
    variants: tuple[str, ...]
    output: Path
    metadata: dict[str, Any]
    settings: Resolved


def describe_submap(
    blocks: Path,
    ground_z: float,
    road: NDArray[np.floating],
    encoder: Encoder,
    settings: Resolved,
    yaws: Sequence[float] = (0.0,),
) -> list[Described]:
    """Centres (voxels) and descriptors of the subvolumes of a submap, close to its ``road``.

    ``blocks`` is the submap's table, ``road`` (m, 2) are the keyframes' positions, metres. One set
    for each of ``yaws``, as a query at that heading sees the submap.
    """
    held = read_blocks(blocks, states_only=True)
    low, high = held.bounds()
    state = held.dense(low, tuple((high - low).tolist()))
    v = settings.fusion.voxel_size
    d = settings.descriptor
    windows = Windows(v, d.stride, d.min_occupied, d.reach)
    out = []
    for turned in (turned_map(state, low, yaw) for yaw in yaws):
        positions = turned.from_map(road / v) * v
        described = describe_map(turned.state, turned.low, ground_z, encoder, windows, positions)
        out.append(Described(turned.to_map(described.centre), described.descriptor))
    return out


def known_headings(settings: Resolved) -> list[float]:
    """The yaws that maps are described at, within a quarter turn (rad)."""
    return [
        2 * np.pi * k / settings.descriptor.headings
        for k in range(settings.descriptor.headings // 4)
    ]


def variants_for(label_source: str, others: Iterable[str], settings: Resolved) -> tuple[str, ...]:
    """Networks that describe a session among ``others`` (their label sources).

    Semantic where classes come from a log or a model, geometric elsewhere, and both where it must
    be comparable with either kind.
    """
    if settings.descriptor.variant != "auto":
        return (settings.descriptor.variant,)
    if label_source not in KNOWS_CLASSES:
        return ("geometric",)
    return ("semantic",) if all(o in KNOWS_CLASSES for o in others) else ("geometric", "semantic")

"""Words of the submaps as tables: what describing a session leaves behind."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semloc_logs.subvolumes.describe import load_encoder
from semloc_logs.subvolumes.submap_descriptors import DescribeTask, describe_submap, known_headings
from semloc_logs.tables import contracts
from semloc_logs.tables.table import write_table
from semloc_logs.voxels.store import blocks_path
from semloc_logs.words.vocabulary import load_vocabulary

# variant, yaw, centres (n, 3), words, codes
Part = tuple[str, float, NDArray[np.floating], NDArray[np.uint16], NDArray[np.uint64]]


def index_submap(task: DescribeTask) -> int:
    """Write the words of one submap in all of the task's variants; returns their number."""
    parts: list[Part] = []
    yaws = known_headings(task.settings)
    for variant in task.variants:
        encoder = load_encoder(variant, task.settings.descriptor.weights)
        vocabulary = load_vocabulary(variant, task.settings.descriptor.vocabulary)
        headings = describe_submap(
            blocks_path(task.folder.blocks, task.submap),
            task.ground_z,
            task.road,
            encoder,
            task.settings,
            yaws,
        )
        for yaw, described in zip(yaws, headings, strict=True):
            parts.append(
                (
                    variant,
                    yaw,
                    described.centre * task.settings.fusion.voxel_size,
                    *vocabulary.words(described.descriptor),
                )
            )
    return write_words(task.output, task.submap, parts, task.metadata)


def write_words(path: Path, submap: int, parts: Sequence[Part], metadata: dict[str, Any]) -> int:
    """One table of words/; returns the number of its rows."""
    centre = np.concatenate([np.zeros((0, 3)), *(p[2] for p in parts)])
    columns = {
        "submap": np.full(len(centre), submap),
        "variant": [p[0] for p in parts for _ in range(len(p[2]))],
        "yaw": np.concatenate(
            [np.zeros(0, np.float32), *(np.full(len(p[2]), p[1], np.float32) for p in parts)]
        ),
        **{c: centre[:, k].astype(np.float32) for k, c in enumerate("xyz")},
        "word": np.concatenate([np.zeros(0, np.uint16), *(p[3] for p in parts)]),
        "code": np.concatenate([np.zeros(0, np.uint64), *(p[4] for p in parts)]),
    }
    write_table(path, contracts.table("words", columns), metadata)
    return len(centre)

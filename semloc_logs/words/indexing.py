"""Words of the submaps as tables: what describing a session leaves behind."""

from __future__ import annotations

from pathlib import Path

from semloc_logs import contracts
from semloc_logs.subvolumes.describing import DescribeTask, describe_submap, word_columns
from semloc_logs.tables import write_table
from semloc_logs.words.vocabulary import load_vocabulary


def index_submap(task: DescribeTask) -> tuple[Path, int]:
    """Write the words of one submap in all of the task's variants; returns the path and the number of words."""
    parts = []
    for variant in task.variants:
        described = describe_submap(task.folder, task.submap, task.ground_z, variant, task.settings)
        word, code = load_vocabulary(variant, task.settings.descriptor.vocabulary).words(described.descriptor)
        parts.append((variant, described.centre * task.settings.fusion.voxel_size, word, code))
    table = contracts.table("words", word_columns(task.submap, parts))
    write_table(task.output, table, task.metadata)
    return task.output, table.num_rows

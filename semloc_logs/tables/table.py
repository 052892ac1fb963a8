"""Parquet tables and JSON files that appear complete or not at all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from semloc_logs.errors import ContractError, WorkspaceError
from semloc_logs.tables.atomic_files import replacing_file

ROW_GROUP = 131_072


def write_json(path: Path, content: dict[str, Any]) -> None:
    """JSON with sorted keys, by rename."""
    with replacing_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Raises WorkspaceError when the file is missing or no JSON object."""
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as problem:
        raise WorkspaceError(
            f"{path} cannot be read ({problem}): run the stage that writes it again."
        ) from None
    if not isinstance(content, dict):
        raise WorkspaceError(
            f"{path} does not hold a JSON object: run the stage that writes it again."
        )
    return content


def write_table(
    path: Path,
    table: pa.Table,
    metadata: dict[str, Any],
    sorting: tuple[str, ...] = (),
    row_group: int = ROW_GROUP,
) -> None:
    """Write ``table``, in groups of ``row_group`` rows, with the JSON ``semloc`` key in its
    metadata; rows are read back and counted before the rename."""
    table = table.replace_schema_metadata({"semloc": json.dumps(metadata, sort_keys=True)})
    columns = [pq.SortingColumn(table.schema.get_field_index(name)) for name in sorting]
    with replacing_file(path) as temporary:
        pq.write_table(
            table,
            temporary,
            compression="zstd",
            row_group_size=row_group,
            sorting_columns=columns or None,
        )
        rows = pq.read_metadata(temporary).num_rows
        if rows != table.num_rows:
            raise ContractError(
                f"{path}: {rows} rows were written of {table.num_rows}; is the disk full?"
            )


def read_table(path: Path, columns: list[str] | None = None) -> pa.Table:
    """Raises WorkspaceError when the file is missing or damaged."""
    try:
        return pq.read_table(path, columns=columns, partitioning=None)
    except (OSError, pa.ArrowException) as problem:
        raise WorkspaceError(
            f"{path} cannot be read ({str(problem).splitlines()[0]}): "
            "run the stage that writes it with --overwrite."
        ) from None


def read_metadata(path: Path) -> dict[str, Any]:
    """The JSON ``semloc`` key of a table's metadata."""
    try:
        metadata = pq.read_schema(path).metadata or {}
        content: dict[str, Any] = json.loads(metadata[b"semloc"])
    except (OSError, KeyError, ValueError, pa.ArrowException) as problem:
        raise WorkspaceError(
            f"{path} has no semloc metadata ({problem}): "
            "run the stage that writes it with --overwrite."
        ) from None
    return content

"""Parquet tables that appear complete or not at all: written under a temporary name, read back,
renamed.
"""

from __future__ import annotations

import glob
import json
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from semloc_logs.errors import ContractError, WorkspaceError

ROW_GROUP = 131_072
_UMASK = os.umask(0o022)
os.umask(_UMASK)


def fsync_folder(folder: Path) -> None:
    """Make renames within ``folder`` durable."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def replacing_file(path: Path, suffix: str = ".tmp") -> Iterator[Path]:
    """A temporary path beside ``path``, ending in ``suffix``; it is renamed onto ``path`` when the
    block ends well, else removed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}{suffix}")
    try:
        yield temporary
        with temporary.open("rb+") as written:
            os.fchmod(written.fileno(), 0o666 & ~_UMASK)  # some writers make private files
            os.fsync(written.fileno())
        os.replace(temporary, path)
        fsync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """A temporary folder beside ``path`` that takes its place, synced, when the block ends well.

    Two renames do it, so a reader in between, or after a kill in between, finds no folder; never
    half of one.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    for stale in path.parent.glob(f".{glob.escape(path.name)}.*.tmp"):  # of a run that was killed
        shutil.rmtree(stale, ignore_errors=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    temporary.mkdir()
    try:
        yield temporary
        for folder, _, names in os.walk(temporary):
            for name in names:
                with open(os.path.join(folder, name), "rb") as written:
                    os.fsync(written.fileno())
            fsync_folder(Path(folder))
        if path.exists():
            old = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.old.tmp")
            os.replace(path, old)
            os.replace(temporary, path)
            shutil.rmtree(old, ignore_errors=True)
        else:
            os.replace(temporary, path)
        fsync_folder(path.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


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
    metadata; rows are read back and counted before the rename.
    """
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
        found = pq.read_metadata(temporary).num_rows
        if found != table.num_rows:
            raise ContractError(
                f"{path}: {found} rows were written of {table.num_rows}; is the disk full?"
            )


def read_table(path: Path, columns: list[str] | None = None) -> pa.Table:
    """Raises WorkspaceError when the file is missing or damaged."""
    try:
        return pq.read_table(path, columns=columns, partitioning=None)
    except (OSError, pa.ArrowException) as problem:
        raise WorkspaceError(
            f"{path} cannot be read ({str(problem).splitlines()[0]}): run the stage that writes it with --overwrite."
        ) from None


def read_metadata(path: Path) -> dict[str, Any]:
    """The JSON ``semloc`` key of a table's metadata."""
    try:
        found = pq.read_schema(path).metadata or {}
        content: dict[str, Any] = json.loads(found[b"semloc"])
    except (OSError, KeyError, ValueError, pa.ArrowException) as problem:
        raise WorkspaceError(
            f"{path} has no semloc metadata ({problem}): run the stage that writes it with --overwrite."
        ) from None
    return content

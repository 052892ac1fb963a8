"""A segment of the index: the words of some sessions, sorted by word, in one file of plain arrays.

Every process maps it into memory. The file, little-endian: 8 bytes ``SEMLOCIX``; uint32 format
version, length of the header and CRC-32 of it; uint32 CRC-32 of each array; the header, JSON:
``variant``, ``entries``, and ``sessions``, in the order of their names, each with ``name``,
``key``, its ``submaps`` and number of ``entries``; then the arrays of :data:`ARRAYS`, each at a
multiple of 64 bytes. Entries are sorted by word, session, submap and row, so a segment's bytes
depend on its content alone. Files never change: they appear by rename and vanish.
"""

from __future__ import annotations

import json
import mmap
import os
import struct
import zlib
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from semloc_logs.errors import WorkspaceError
from semloc_logs.numerics.cells import cell_starts
from semloc_logs.tables.atomic_files import replacing_file

MAGIC, VERSION = b"SEMLOCIX", 1
WORDS = 2**16
ALIGNMENT = 64
# name, type and columns of the arrays: where the entries of each word start, then one row an entry
STARTS = ("starts", "<u4", 1)
ARRAYS = (
    ("code", "<u8", 1),
    ("place", "<u4", 1),
    ("row", "<u4", 1),
    ("centre", "<f4", 3),
    ("yaw", "<f4", 1),
)
PREFIX = struct.Struct(f"<8s3I{1 + len(ARRAYS)}I")
Columns = dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Held:
    """A session in a segment: name, key of its words, ids of its submaps, number of its words."""

    name: str
    key: str
    submaps: tuple[int, ...]
    entries: int


@dataclass(frozen=True, eq=False)
class Segment:
    """Entries sorted by word.

    ``starts`` (65537,) of the words; for each entry ``code``, ``place`` (number in :attr:`places`),
    ``row`` in the table of its submap, ``centre`` (n, 3), metres in its map frame, and ``yaw``,
    radians, the heading that the map was turned by.
    """

    sessions: tuple[Held, ...]
    starts: NDArray[np.uint32]
    code: NDArray[np.uint64]
    place: NDArray[np.uint32]
    row: NDArray[np.uint32]
    centre: NDArray[np.float32]
    yaw: NDArray[np.float32]
    path: Path | None = None

    def __len__(self) -> int:
        return len(self.code)

    @cached_property
    def places(self) -> list[tuple[str, int]]:
        """Session and submap of each number in ``place``."""
        return [(held.name, submap) for held in self.sessions for submap in held.submaps]

    def numbered(
        self, numbers: Mapping[tuple[str, int], int], served: Container[str]
    ) -> NDArray[np.int64]:
        """The ``numbers`` of session and submap at each of the :attr:`places`.

        -1 for sessions that are not ``served``.
        """
        return np.array([numbers[p] if p[0] in served else -1 for p in self.places], np.int64)

    def block(self, first: int, last: int) -> Columns:
        """Entries of the words ``first`` to ``last`` - 1, with their ``word``."""
        begin = int(self.starts[first])
        end = int(self.starts[last])
        starts = self.starts[first : last + 1].astype(np.int64)
        word = np.repeat(np.arange(first, last), starts[1:] - starts[:-1])
        return {"word": word} | {name: getattr(self, name)[begin:end] for name, _, _ in ARRAYS}


def in_order(columns: Columns) -> Columns:
    """Columns sorted by word, place and row."""
    order = np.lexsort((columns["row"], columns["place"], columns["word"]))
    return {name: values[order] for name, values in columns.items()}


def starts_of(word: NDArray[np.integer]) -> NDArray[np.uint32]:
    """Where the entries of each word start, and the end (65537,)."""
    return cell_starts(word, WORDS).astype(np.uint32)


def segment_in_memory(sessions: tuple[Held, ...], columns: Columns) -> Segment:
    """A segment of unsorted ``columns`` word, code, place, row, centre and yaw that has no file."""
    columns = in_order(columns)
    arrays: dict[str, Any] = {
        name: np.ascontiguousarray(columns[name], kind) for name, kind, _ in ARRAYS
    } | {"starts": starts_of(columns["word"])}
    for values in arrays.values():
        values.flags.writeable = False  # as in files
    return Segment(sessions, **arrays)


# -- files
# ------------------------------------------------------------------------------------------------


def _layout(header: int, entries: int) -> tuple[dict[str, int], int]:
    """Where each array begins after a header of so many bytes, and the length of the file."""
    position = PREFIX.size + header
    offsets = {}
    for name, kind, columns in (STARTS, *ARRAYS):
        position = -(-position // ALIGNMENT) * ALIGNMENT
        offsets[name] = position
        position += np.dtype(kind).itemsize * columns * (WORDS + 1 if name == "starts" else entries)
    return offsets, position


def write_segment(
    path: Path, variant: str, sessions: tuple[Held, ...], blocks: Iterable[Columns]
) -> None:
    """Write sorted ``blocks``, whose words rise from one to the next, as one file, by rename.

    OSError where that is not possible.
    """
    entries = sum(held.entries for held in sessions)
    if entries >= 2**32:
        raise WorkspaceError(f"{path}: a segment holds fewer than 2^32 words, not {entries}.")
    listed = [
        {"name": h.name, "key": h.key, "submaps": h.submaps, "entries": h.entries} for h in sessions
    ]
    header = json.dumps(
        {"variant": variant, "entries": entries, "sessions": listed}, sort_keys=True
    ).encode()
    cursor, length = _layout(len(header), entries)
    sums = dict.fromkeys(cursor, 0)
    count = np.zeros(WORDS, np.int64)
    with replacing_file(path) as temporary, temporary.open("wb") as file:
        os.truncate(temporary, length)

        def put(name: str, kind: str, values: NDArray[Any]) -> None:
            content = np.ascontiguousarray(values, kind).tobytes()
            file.seek(cursor[name])
            file.write(content)
            cursor[name] += len(content)
            sums[name] = zlib.crc32(content, sums[name])

        for block in blocks:
            count += np.bincount(block["word"], minlength=WORDS)
            for name, kind, _ in ARRAYS:
                put(name, kind, block[name])
        if count.sum() != entries:
            raise WorkspaceError(f"{path}: {count.sum()} words were given of {entries}.")
        put("starts", STARTS[1], np.r_[0, np.cumsum(count)])
        file.seek(0)
        file.write(
            PREFIX.pack(
                MAGIC,
                VERSION,
                len(header),
                zlib.crc32(header),
                *(sums[name] for name, _, _ in (STARTS, *ARRAYS)),
            )
            + header
        )


def open_segment(path: Path, variant: str, check: bool = False) -> Segment:
    """Map a segment into memory; ``check`` reads all of it and compares the checksums.

    WorkspaceError when the file is damaged, cut off or of another version, FileNotFoundError when
    it was removed.
    """
    with path.open("rb") as file:
        try:
            sums, content = _header(file, path.stat().st_size)
            held = tuple(
                Held(
                    str(s["name"]), str(s["key"]), tuple(map(int, s["submaps"])), int(s["entries"])
                )
                for s in content["sessions"]
            )
            entries = int(content["entries"])
            offsets, length = _layout(content["length"], entries)
            if (
                length != path.stat().st_size
                or content["variant"] != variant
                or entries != sum(h.entries for h in held)
            ):
                raise ValueError(f"{length} bytes of {content['variant']} words were expected")
            mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            arrays: dict[str, Any] = {}
            for name, kind, columns in (STARTS, *ARRAYS):
                rows = WORDS + 1 if name == "starts" else entries
                arrays[name] = np.frombuffer(mapped, kind, rows * columns, offsets[name]).reshape(
                    (rows, columns)[: 1 + (columns > 1)]
                )
                if check and zlib.crc32(memoryview(arrays[name]).cast("B")) != sums[name]:
                    raise ValueError(f"the checksum of {name} is another")
            starts = arrays["starts"]
            # searching trusts them
            if starts[0] != 0 or starts[-1] != entries or (starts[1:] < starts[:-1]).any():
                raise ValueError("the entries of the words do not follow each other")
        except (ValueError, KeyError, TypeError, struct.error, OverflowError) as problem:
            raise WorkspaceError(
                f"{path} is not an index segment ({problem}): delete it; it is built again from "
                "the words."
            ) from None
    return Segment(held, path=path, **arrays)


def _header(file: BinaryIO, size: int) -> tuple[dict[str, int], dict[str, Any]]:
    """Checksums of the arrays and the header, with its ``length``."""
    magic, version, length, checksum, *sums = PREFIX.unpack(file.read(PREFIX.size))
    if magic != MAGIC or version != VERSION or PREFIX.size + length > size:
        raise ValueError(f"begins with {magic!r}, version {version}")
    header = file.read(length)
    if zlib.crc32(header) != checksum:
        raise ValueError("the checksum of the header is another")
    return dict(zip((name for name, _, _ in (STARTS, *ARRAYS)), sums, strict=True)), json.loads(
        header
    ) | {"length": length}

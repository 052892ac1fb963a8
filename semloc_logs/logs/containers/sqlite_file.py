"""An sqlite file as it was committed last, read without a trace beside it or in it.

sqlite itself writes where it reads: it makes ``-shm`` and ``-wal`` files, and merges or deletes
what a killed recorder left in them. Here the file is opened as immutable, and where its newest
pages lie in a ``-wal`` file, or older ones in the ``-journal`` of a transaction that never ended,
sqlite reads these pages in place of the ones of the file. Memory holds the places of these pages
only.

The formats: https://www.sqlite.org/fileformat2.html.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

import apsw
import numpy as np
from numpy.typing import NDArray

from semloc_logs.errors import LogError
from semloc_logs.logs.remote import is_remote, log_path

_VFS = "semloc-read"
_WAL_HEAD = struct.Struct(">IIIIIIII")  # magic, version, page size, sequence, salts, checksums
_WAL_FRAME = struct.Struct(">IIIIII")  # page, pages after a commit or 0, salts, checksums
_WAL_MAGIC = (0x377F0682, 0x377F0683)  # checksums of little-endian and of big-endian words
_JOURNAL_MAGIC = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"
_JOURNAL_HEAD = struct.Struct(">IIIII")  # records, nonce, pages of the file, sector, page size
_PAGE_SIZES = {1 << k for k in range(9, 17)}
_MASK = (1 << 32) - 1

Words = NDArray[np.uint32]


@dataclass(frozen=True, slots=True)
class Overlay:
    """Pages that take the place of pages of the file: number -> offset in the file ``path``."""

    path: Path
    page_size: int
    pages: dict[int, int]
    page_count: int  # of the whole


def connect(path: Path) -> apsw.Connection:
    """A connection that can only read, and leaves no trace. apsw.Error where sqlite refuses."""
    overlay = overlay_of(path)
    address = f"file:{quote(str(path.absolute()))}?immutable=1"
    flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
    vfs = None if overlay is None and not is_remote(path) else _vfs().name
    database = apsw.Connection(address, flags=flags, vfs=vfs)
    database.execute("PRAGMA trusted_schema = OFF")
    return database


def overlay_of(path: Path) -> Overlay | None:
    """The pages beside ``path`` that belong to it; None where it is complete by itself."""
    return _from_wal(_beside(path, "-wal")) or _from_journal(_beside(path, "-journal"), path)


def side_files(path: Path) -> list[Path]:
    """The files beside ``path`` that may hold parts of its content."""
    sides = (_beside(path, "-wal"), _beside(path, "-journal"))
    return [side for side in sides if _size(side)]


def state(path: Path) -> tuple[object, ...]:
    """Changes when the content of ``path`` does."""
    parts: list[object] = []
    for file in (path, _beside(path, "-wal"), _beside(path, "-journal")):
        try:
            status = file.stat()
            parts += [status.st_size, status.st_mtime_ns]
        except OSError:
            parts.append(None)
    return tuple(parts)


def _beside(path: Path, suffix: str) -> Path:
    real = path.resolve()  # as sqlite does
    return real.with_name(real.name + suffix)


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


# -- write-ahead logs


def _from_wal(wal: Path) -> Overlay | None:
    """The committed pages of a write-ahead log; the newest of each."""
    if not _size(wal):
        return None
    with _opened(wal) as file:
        head = file.read(_WAL_HEAD.size)
        if len(head) < _WAL_HEAD.size:
            return None
        magic, _, page_size, _, salt_1, salt_2, *checksum = _WAL_HEAD.unpack(head)
        if magic not in _WAL_MAGIC or page_size not in _PAGE_SIZES:
            return None
        words = np.dtype("<u4" if magic == _WAL_MAGIC[0] else ">u4")
        state = _checksum(head[:24], words, (0, 0))
        if state != tuple(checksum):
            return None
        committed: dict[int, int] = {}
        pending: dict[int, int] = {}
        page_count = 0
        while len(frame := file.read(_WAL_FRAME.size + page_size)) == _WAL_FRAME.size + page_size:
            page, count, first, second, *checksum = _WAL_FRAME.unpack_from(frame)
            # frames of an earlier use of the file have other salts, and torn ones other checksums
            state = _checksum(frame[:8], words, state)
            state = _checksum(frame[_WAL_FRAME.size :], words, state)
            if (first, second) != (salt_1, salt_2) or state != tuple(checksum) or page == 0:
                break
            pending[page] = file.tell() - page_size
            if count:
                committed.update(pending)
                pending.clear()
                page_count = count
    return Overlay(wal, page_size, committed, page_count) if page_count else None


def _checksum(data: bytes, words: np.dtype[Any], state: tuple[int, int]) -> tuple[int, int]:
    """The running checksum after ``data``: s0 += x0 + s1; s1 += x1 + s0 for each pair of words.

    That is linear in the words and in the state, modulo 2^32.
    """
    pairs = np.frombuffer(data, words).astype(np.uint32)
    weights, power = _weights(len(pairs) // 2)
    s0, s1 = (int((w * pairs).sum(dtype=np.uint32)) for w in weights)
    (a, b), (c, d) = power
    return (a * state[0] + b * state[1] + s0) & _MASK, (c * state[0] + d * state[1] + s1) & _MASK


@cache
def _weights(pairs: int) -> tuple[tuple[Words, Words], tuple[tuple[int, int], tuple[int, int]]]:
    """Factors of the words in both sums, and the matrix that the state is multiplied by."""
    a, b, c, d = 1, 0, 0, 1  # the matrix of the pairs behind
    of_s0 = np.empty(2 * pairs, np.uint32)
    of_s1 = np.empty(2 * pairs, np.uint32)
    for k in reversed(range(pairs)):
        # a word x0 adds (1, 1) to the state, a word x1 adds (0, 1)
        of_s0[2 * k], of_s1[2 * k] = (a + b) & _MASK, (c + d) & _MASK
        of_s0[2 * k + 1], of_s1[2 * k + 1] = b, d
        # one step multiplies the state by ((1, 1), (1, 2))
        a, b = (a + b) & _MASK, (a + 2 * b) & _MASK
        c, d = (c + d) & _MASK, (c + 2 * d) & _MASK
    return (of_s0, of_s1), ((a, b), (c, d))


# -- rollback journals


def _from_journal(journal: Path, path: Path) -> Overlay | None:
    """The pages as they were before the transaction that never ended."""
    if not _size(journal):
        return None
    pages: dict[int, int] = {}
    page_size = page_count = 0
    with _opened(journal) as file:
        position = 0
        end = file.seek(0, 2)
        while position + 512 <= end:
            file.seek(position)
            head = file.read(8 + _JOURNAL_HEAD.size)
            if not head.startswith(_JOURNAL_MAGIC):
                break  # a transaction that ended has zeros here
            records, nonce, count, sector, size = _JOURNAL_HEAD.unpack_from(head, 8)
            if not pages:
                page_size, page_count = size, count
            if size not in _PAGE_SIZES or size != page_size or not 32 <= sector <= 1 << 16:
                return None
            position += sector
            file.seek(position)
            if records == _MASK:
                records = (end - position) // (size + 8)
            for _ in range(records):
                record = file.read(size + 8)
                if len(record) < size + 8:
                    return _rolled_back(journal, page_size, pages, page_count)
                page, checksum = struct.unpack_from(">I", record)[0], record[-4:]
                sample = sum(record[4 + k] for k in range(size - 200, 0, -200))
                if (nonce + sample) & _MASK != int.from_bytes(checksum, "big"):
                    return _rolled_back(journal, page_size, pages, page_count)
                pages.setdefault(page, position + 4)
                position += size + 8
            position = -(-position // sector) * sector
    return _rolled_back(journal, page_size, pages, page_count)


def _rolled_back(
    journal: Path, page_size: int, pages: dict[int, int], page_count: int
) -> Overlay | None:
    return Overlay(journal, page_size, pages, page_count) if pages and page_count else None


def _opened(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except OSError as error:
        raise LogError(
            f"{path} holds a part of the log beside it and cannot be opened: {error.strerror}."
        ) from error


# -- sqlite's view of the file


@cache
def _vfs() -> _ReadingVfs:
    return _ReadingVfs(_VFS)


class _ReadingVfs(apsw.VFS):
    """Files that can only be read, with the pages beside them in their places."""

    def __init__(self, name: str) -> None:
        self.name = name
        super().__init__(name, "")

    def xOpen(self, name: str | apsw.URIFilename | None, flags: list[int]) -> Any:
        """A database; temporary files are the ones of the system."""
        if not isinstance(name, apsw.URIFilename):
            return super().xOpen(name, flags)
        path = log_path(name.filename())
        overlay = overlay_of(path)
        if overlay is None and not is_remote(path):  # gone meanwhile
            raise apsw.CantOpenError(f"{path} changed while it was opened")
        flags[1] = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_MAIN_DB
        return OverlaidFile(path, overlay)

    def xFullPathname(self, name: str) -> str:
        """Addresses as they are."""
        return name if is_remote(log_path(name)) else super().xFullPathname(name)

    def xAccess(self, pathname: str, flags: int) -> bool:
        """No file beside the database is of interest to sqlite."""
        return False


class OverlaidFile(apsw.VFSFile):
    """The file at ``path`` with the pages of ``overlay``, if there is one, in their places."""

    def __init__(self, path: Path, overlay: Overlay | None) -> None:
        self._overlay = overlay
        self._files = [path.open("rb")]
        if overlay is not None:
            self._files.append(overlay.path.open("rb"))

    def xRead(self, amount: int, offset: int) -> bytes:
        if self._overlay is None:
            return self._read(0, amount, offset)
        page, inside = divmod(offset, self._overlay.page_size)
        start = self._overlay.pages.get(page + 1)
        if start is None:
            return self._read(0, amount, offset)
        return self._read(1, amount, start + inside)

    def _read(self, file: int, amount: int, offset: int) -> bytes:
        self._files[file].seek(offset)
        return self._files[file].read(amount)

    def xFileSize(self) -> int:
        if self._overlay is None:
            return self._files[0].seek(0, 2)
        return self._overlay.page_count * self._overlay.page_size

    def xClose(self) -> None:
        while self._files:
            self._files.pop().close()

    def xFileControl(self, op: int, ptr: int) -> bool:
        return False

    def xDeviceCharacteristics(self) -> int:
        return int(apsw.SQLITE_IOCAP_IMMUTABLE)

    def xSectorSize(self) -> int:
        return 0

    def xLock(self, level: int) -> None:
        pass

    def xUnlock(self, level: int) -> None:
        pass

    def xCheckReservedLock(self) -> bool:
        return False

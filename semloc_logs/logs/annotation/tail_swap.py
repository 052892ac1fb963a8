"""Writing the end of a file anew so that an interruption at any point can be undone.

The bytes that will be overwritten are first saved in ``LOG.semloc-tail`` beside the log and synced;
only then the log is touched; the saved tail goes away when the log is synced. :func:`recover` sees
the saved tail of an interrupted run and puts it back, or finds that the new end is complete.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from semloc_logs.errors import LogError

try:
    import fcntl
except ImportError:  # a system without advisory locks
    fcntl = None  # type: ignore[assignment]

SIDE_SUFFIX = ".semloc-tail"
_MAGIC = b"semloc-tail 1\n"
# offset, old size, new size, sha256 of: file before the offset, new end, old end
_FIELDS = struct.Struct("<QQQ32s32s32s")
_GUARD = 1 << 16  # bytes at the start and before the offset that identify the file


@dataclass(frozen=True, slots=True)
class _Saved:
    """What the side file holds."""

    offset: int
    new_size: int
    guard: bytes
    new_digest: bytes
    old_end: bytes


@contextlib.contextmanager
def locked(path: Path, *, shared: bool = False) -> Iterator[int]:
    """A descriptor of ``path`` under an advisory lock: for reading and writing, or, ``shared`` with
    others, for reading.

    Raises ``LogError`` when the file cannot be opened so, or when another process holds the lock.
    """
    try:
        fd = os.open(path, os.O_RDONLY if shared else os.O_RDWR)
    except OSError as error:
        advice = "give a readable log" if shared else "write a copy with `-o OUT.mcap` instead"
        raise LogError(f"{path} cannot be opened ({error.strerror}); {advice}.") from error
    try:
        if fcntl is not None:
            try:
                fcntl.flock(fd, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
            except OSError as error:
                raise LogError(
                    f"{path} is being written by another process; wait until it is done."
                ) from error
        yield fd
    finally:
        os.close(fd)


def replace_end(path: Path, fd: int, offset: int, new_end: bytes) -> None:
    """Let the locked file ``fd`` at ``path`` end with ``new_end`` from ``offset`` on, or leave it
    as it was.

    Raises ``LogError`` when it cannot be written; the file then is what it was before, now or after
    :func:`recover`.
    """
    old_end = _read(fd, offset, os.fstat(fd).st_size - offset)
    if old_end == new_end:
        return
    saved = _Saved(
        offset, offset + len(new_end), _guard(fd, offset), hashlib.sha256(new_end).digest(), old_end
    )
    side = _side(path)
    try:
        _save(side, saved)
    except OSError as error:
        for leftover in (_temporary(side), side):
            with contextlib.suppress(OSError):
                os.unlink(leftover)
        raise LogError(
            f"{path} is unchanged: its end could not be saved to {side} ({error.strerror}); make room or use `-o`."
        ) from error
    try:
        _write(fd, new_end, offset)
        os.ftruncate(fd, saved.new_size)
        os.fsync(fd)
    except BaseException as error:
        try:
            _restore(fd, saved)
            _remove(side)
        except OSError as second:
            raise LogError(
                f"{path} could not be restored ({second.strerror}); make room, and the next command repairs it."
            ) from second
        if isinstance(error, OSError):
            raise LogError(
                f"{path} is unchanged: results could not be written ({error.strerror}); make room and try again."
            ) from error
        raise
    _remove(side)


def recover(path: Path) -> bool:
    """Repair a log whose end was being written when the process died; True when there was something
    to repair.

    Costs one look into the folder when there is nothing to do. Raises ``LogError`` when another
    process is writing right now, or when the saved tail does not belong to the log.
    """
    side = _side(path)
    if not path.is_file() or not (side.exists() or _temporary(side).exists()):
        return False
    with locked(path) as fd:
        return recover_locked(path, fd)


def recover_locked(path: Path, fd: int) -> bool:
    """:func:`recover` for a file that is already locked."""
    side = _side(path)
    repaired = False
    try:
        if side.exists():
            saved = _load(side)
            size = os.fstat(fd).st_size
            sizes = (saved.offset + len(saved.old_end), saved.new_size)
            if not saved.offset <= size <= max(sizes) or _guard(fd, saved.offset) != saved.guard:
                raise LogError(
                    f"{side} is not the saved end of this state of {path}; if the log is good, delete that file and go on."
                )
            # a finished end is kept: only the removal of the side file was missing
            if (
                size != saved.new_size
                or hashlib.sha256(_read(fd, saved.offset, size - saved.offset)).digest()
                != saved.new_digest
            ):
                _restore(fd, saved)
            _remove(side)
            repaired = True
        if _temporary(side).exists():  # died while saving: the log was not touched yet
            os.unlink(_temporary(side))
    except OSError as error:
        raise LogError(
            f"{path} cannot be repaired from {side} ({error.strerror}); make room or make it writable."
        ) from error
    return repaired


def copy_start(source: int, target: int, length: int) -> None:
    """Copy the first ``length`` bytes of a descriptor to another without looking at them."""
    at = 0
    if hasattr(os, "copy_file_range"):
        with contextlib.suppress(OSError):  # other file systems, old kernels: go on by hand
            while at < length and (
                n := os.copy_file_range(source, target, min(length - at, 1 << 30), at, at)
            ):
                at += n
    while at < length:
        block = os.pread(source, min(length - at, 1 << 20), at)
        if not block:
            raise LogError(
                f"The log became shorter while it was copied (at offset {at}); let its recording end first."
            )
        _write(target, block, at)
        at += len(block)


def sync_folder(folder: Path) -> None:
    """Make renames and removals in a folder durable."""
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def _side(path: Path) -> Path:
    real = path.resolve()
    return real.with_name(real.name + SIDE_SUFFIX)


def _temporary(side: Path) -> Path:
    return side.with_name(side.name + ".tmp")


def _guard(fd: int, offset: int) -> bytes:
    start = max(0, offset - _GUARD)
    return hashlib.sha256(
        _read(fd, 0, min(_GUARD, offset)) + _read(fd, start, offset - start)
    ).digest()


def _save(side: Path, saved: _Saved) -> None:
    digest = hashlib.sha256(saved.old_end).digest()
    old_size = saved.offset + len(saved.old_end)
    data = (
        _MAGIC
        + _FIELDS.pack(
            saved.offset, old_size, saved.new_size, saved.guard, saved.new_digest, digest
        )
        + saved.old_end
    )
    fd = os.open(_temporary(side), os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    try:
        _write(fd, data, 0)
        os.fsync(fd)
    finally:
        os.close(fd)
    os.replace(_temporary(side), side)
    sync_folder(side.parent)


def _load(side: Path) -> _Saved:
    data = side.read_bytes()
    head = len(_MAGIC) + _FIELDS.size
    if len(data) >= head and data.startswith(_MAGIC):
        offset, old_size, new_size, guard, new_digest, digest = _FIELDS.unpack(
            data[len(_MAGIC) : head]
        )
        old_end = data[head:]
        if offset + len(old_end) == old_size and hashlib.sha256(old_end).digest() == digest:
            return _Saved(offset, new_size, guard, new_digest, old_end)
    raise LogError(
        f"{side} is damaged, so the log beside it cannot be repaired from it; recover the log with `mcap recover`."
    )


def _restore(fd: int, saved: _Saved) -> None:
    _write(fd, saved.old_end, saved.offset)
    os.ftruncate(fd, saved.offset + len(saved.old_end))
    os.fsync(fd)


def _remove(side: Path) -> None:
    os.unlink(side)
    sync_folder(side.parent)


def _read(fd: int, offset: int, length: int) -> bytes:
    parts = []
    while length > 0 and (block := os.pread(fd, min(length, 1 << 24), offset)):
        parts.append(block)
        offset += len(block)
        length -= len(block)
    return b"".join(parts)


def _write(fd: int, data: bytes, offset: int) -> None:
    view = memoryview(data)
    while view:
        n = os.pwrite(fd, view[: 1 << 24], offset)
        view = view[n:]
        offset = offset + n

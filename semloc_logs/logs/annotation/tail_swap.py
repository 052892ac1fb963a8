"""Writing the end of a file anew so that an interruption at any point can be undone.

The bytes that will be overwritten are first saved in ``LOG.semloc-tail`` beside the log and synced;
only then the log is touched; the saved tail goes away when the log is synced. :func:`recover` sees
the saved tail of an interrupted run and puts it back, or finds that the new tail is complete.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from semloc_logs.errors import LogError
from semloc_logs.logs.annotation.mcap_append import AppendPlan
from semloc_logs.logs.remote import is_remote
from semloc_logs.tables.atomic_files import remove_file, replacing_file, stale_temporaries

try:
    import fcntl
except ImportError:  # a system without advisory locks
    fcntl = None  # type: ignore[assignment]

SIDE_SUFFIX = ".semloc-tail"
_MAGIC = b"semloc-tail 1\n"
# offset, old size, new size, sha256 of: file before the offset, new tail, old tail
_FIELDS = struct.Struct("<QQQ32s32s32s")
_GUARD = 1 << 16  # bytes at the start and before the offset that identify the file
_BLOCK = 1 << 24  # bytes read or written at once


@dataclass(frozen=True, slots=True)
class _Saved:
    """What the side file holds."""

    offset: int
    new_size: int
    guard: bytes
    new_digest: bytes
    old_tail: bytes

    @property
    def old_size(self) -> int:
        return self.offset + len(self.old_tail)


@contextlib.contextmanager
def locked(path: Path, *, shared: bool = False) -> Iterator[int]:
    """A descriptor of ``path`` under an advisory lock.

    For reading and writing, or, ``shared`` with others, for reading. Raises ``LogError`` when the
    file cannot be opened so, or when another process holds the lock.
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


def swap_tail(path: Path, fd: int, plan: AppendPlan) -> None:
    """Apply ``plan`` to the locked file ``fd`` at ``path``, or leave the file as it was.

    Raises ``LogError`` when it cannot be written; the file then is what it was before, now or after
    :func:`recover`.
    """
    if plan.old_tail == plan.new_tail:
        return
    digest = hashlib.sha256(plan.new_tail).digest()
    new_size = plan.start + len(plan.new_tail)
    saved = _Saved(plan.start, new_size, _guard(fd, plan.start), digest, plan.old_tail)
    side = _side(path)
    try:
        _save(side, saved)
    except OSError as error:
        with contextlib.suppress(OSError):
            os.unlink(side)
        raise LogError(
            f"{path} is unchanged: its end could not be saved to {side} ({error.strerror}); "
            "make room or use `-o`."
        ) from error
    try:
        _write_tail(fd, plan.start, plan.new_tail)
    except BaseException as error:
        _undo(path, fd, saved)
        if isinstance(error, OSError):
            raise LogError(
                f"{path} is unchanged: results could not be written ({error.strerror}); "
                "make room and try again."
            ) from error
        raise
    remove_file(side)


def recover(path: Path) -> bool:
    """Repair a log whose tail was being written when the process died.

    True when there was something to repair. Costs one look into the folder when there is nothing to
    do. Raises ``LogError`` when another process is writing right now, or when the saved tail does
    not belong to the log.
    """
    if is_remote(path):
        return False
    side = _side(path)
    if not path.is_file() or not (side.exists() or stale_temporaries(side)):
        return False
    with locked(path) as fd:
        return recover_locked(path, fd)


def recover_locked(path: Path, fd: int) -> bool:
    """:func:`recover` for a file that is already locked."""
    side = _side(path)
    repaired = False
    try:
        if side.exists():
            _repair(path, fd, side)
            repaired = True
        for temporary in stale_temporaries(side):  # died while saving: the log was not touched yet
            remove_file(temporary)
    except OSError as error:
        raise LogError(
            f"{path} cannot be repaired from {side} ({error.strerror}); "
            "make room or make it writable."
        ) from error
    return repaired


def copy_start(source: int, target: int, length: int) -> None:
    """Copy the first ``length`` bytes of a descriptor to another without looking at them."""
    position = 0
    if hasattr(os, "copy_file_range"):
        with contextlib.suppress(OSError):  # other file systems, old kernels: go on by hand
            while position < length:
                count = min(length - position, 1 << 30)
                copied = os.copy_file_range(source, target, count, position, position)
                if not copied:
                    break
                position += copied
    while position < length:
        block = os.pread(source, min(length - position, 1 << 20), position)
        if not block:
            raise LogError(
                f"The log became shorter while it was copied (at offset {position}); "
                "let its recording end first."
            )
        _write(target, block, position)
        position += len(block)


def _side(path: Path) -> Path:
    real = path.resolve()
    return real.with_name(real.name + SIDE_SUFFIX)


def _guard(fd: int, offset: int) -> bytes:
    start = max(0, offset - _GUARD)
    head = _read(fd, 0, min(_GUARD, offset))
    return hashlib.sha256(head + _read(fd, start, offset - start)).digest()


def _save(side: Path, saved: _Saved) -> None:
    digest = hashlib.sha256(saved.old_tail).digest()
    sizes = (saved.offset, saved.old_size, saved.new_size)
    fields = _FIELDS.pack(*sizes, saved.guard, saved.new_digest, digest)
    with replacing_file(side, mode=0o600) as temporary:
        # private from the start: it holds what the log holds
        temporary.write_bytes(_MAGIC + fields + saved.old_tail)


def _load(side: Path, fd: int) -> _Saved:
    data = _own_bytes(side, fd)
    head = len(_MAGIC) + _FIELDS.size
    if len(data) >= head and data.startswith(_MAGIC):
        offset, old_size, new_size, guard, new_digest, digest = _FIELDS.unpack(
            data[len(_MAGIC) : head]
        )
        saved = _Saved(offset, new_size, guard, new_digest, data[head:])
        if saved.old_size == old_size and hashlib.sha256(saved.old_tail).digest() == digest:
            return saved
    raise LogError(
        f"{side} is damaged, so the log beside it cannot be repaired from it; "
        "recover the log with `mcap recover`."
    )


def _own_bytes(side: Path, fd: int) -> bytes:
    """The content of ``side``; LogError unless it is a file of the log's owner or of this user.

    Anyone may write beside a log in a shared folder, and the content is written into the log.
    """
    try:
        file = os.open(side, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        raise LogError(f"{side} is a symbolic link, so it was not used; delete it.") from None
    with os.fdopen(file, "rb") as opened:
        owner = os.fstat(file).st_uid
        if owner not in (os.fstat(fd).st_uid, os.geteuid()):
            raise LogError(f"{side} is a file of another user, so it was not used; delete it.")
        return opened.read()


def _repair(path: Path, fd: int, side: Path) -> None:
    """Keep a finished new tail, else put the saved one back; then drop the saved one."""
    saved = _load(side, fd)
    size = os.fstat(fd).st_size
    fits = saved.offset <= size <= max(saved.old_size, saved.new_size)
    if not fits or _guard(fd, saved.offset) != saved.guard:
        raise LogError(
            f"{side} is not the saved end of this state of {path}; "
            "if the log is good, delete that file and go on."
        )
    tail = _read(fd, saved.offset, size - saved.offset)
    if size == saved.new_size and hashlib.sha256(tail).digest() == saved.new_digest:
        os.fsync(fd)  # what a killed process wrote may still be in memory only
    else:
        _write_tail(fd, saved.offset, saved.old_tail)
    remove_file(side)


def _undo(path: Path, fd: int, saved: _Saved) -> None:
    """Put the saved tail back after a failed write."""
    try:
        _write_tail(fd, saved.offset, saved.old_tail)
        remove_file(_side(path))
    except OSError as error:
        raise LogError(
            f"{path} could not be restored ({error.strerror}); "
            "make room, and the next command repairs it."
        ) from error


def _write_tail(fd: int, offset: int, tail: bytes) -> None:
    """Let a file end with ``tail`` from ``offset`` on, durably."""
    _write(fd, tail, offset)
    os.ftruncate(fd, offset + len(tail))
    os.fsync(fd)


def _read(fd: int, offset: int, length: int) -> bytes:
    parts = []
    while length > 0 and (block := os.pread(fd, min(length, _BLOCK), offset)):
        parts.append(block)
        offset += len(block)
        length -= len(block)
    return b"".join(parts)


def _write(fd: int, data: bytes, offset: int) -> None:
    view = memoryview(data)
    while view:
        written = os.pwrite(fd, view[:_BLOCK], offset)
        view = view[written:]
        offset += written

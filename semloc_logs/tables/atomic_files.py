"""Files and folders that appear whole or not at all, whatever interrupts their writer.

The content is written under a temporary name beside the target and synced; a rename then puts it in
place; the folder is synced last. A crash at any point leaves the old state or the new one. When the
block has ended well, the new state survives a power failure.
"""

from __future__ import annotations

import glob
import hashlib
import os
import shutil
import socket
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_UMASK = os.umask(0o022)
os.umask(_UMASK)
PUBLIC = 0o666 & ~_UMASK  # permissions of a file that any program would make
_OLD = ".old.tmp"  # ends the name of a folder that is being replaced
_HOST = hashlib.sha256(socket.gethostname().encode()).hexdigest()[:6]
_PROCESS = uuid.uuid4().hex[:6]  # tells this process from an earlier one of the same number
PUBLIC_FOLDER = 0o777 & ~_UMASK
_NOFOLLOW = getattr(os, "O_NOFOLLOW", 0)  # a system without it has no such links in shared folders


def sync_folder(folder: Path) -> None:
    """Make creations, renames and removals within ``folder`` durable."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def make_folder(folder: Path) -> None:
    """Create ``folder`` and its missing parents, durably."""
    missing = []
    while not folder.is_dir():
        missing.append(folder)
        folder = folder.parent
    for created in reversed(missing):
        created.mkdir(exist_ok=True)
        sync_folder(created.parent)


def stale_temporaries(path: Path) -> list[Path]:
    """Temporary files or folders for ``path`` that killed writers left behind.

    Those of a process that is alive are not.
    """
    temporaries = sorted(path.parent.glob(f".{glob.escape(path.name)}.*.tmp"))
    return [p for p in temporaries if not _is_in_use(p.name.removeprefix(f".{path.name}."))]


def is_alive(process: int) -> bool:
    """Whether a process of this host runs."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # of another user
        return True
    return process > 0


def _is_in_use(ending: str) -> bool:
    """Whether the writer of a temporary is alive, by the end of its name.

    Processes of other hosts count as gone.
    """
    host, process, of_process, *_ = [*ending.split(".")[0].split("-"), "", "", ""]
    if host != _HOST or not process.isdigit():
        return False
    if int(process) == os.getpid():
        return of_process == _PROCESS
    return is_alive(int(process))


def remove_file(path: Path) -> None:
    """Remove a file durably."""
    os.unlink(path)
    sync_folder(path.parent)


@contextmanager
def replacing_file(path: Path, suffix: str = ".tmp", *, mode: int = PUBLIC) -> Iterator[Path]:
    """A temporary path beside ``path``, ending in ``suffix``, that replaces ``path``.

    It is renamed onto ``path``, with the permissions ``mode``, when the block ends well, else
    removed.
    """
    make_folder(path.parent)
    # made here and new, so that a writer which opens it by name meets no link of someone else
    handle, name = tempfile.mkstemp(suffix, f".{path.name}.{_owner()}-", path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        written = os.open(temporary, os.O_RDWR | _NOFOLLOW)
        try:
            os.fchmod(written, mode)  # the file is private until now
            os.fsync(written)
        finally:
            os.close(written)
        os.replace(temporary, path)
        sync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """A temporary folder beside ``path`` that takes its place when the block ends well.

    Two renames do it, so a reader in between, or after a kill in between, finds no folder; never
    half of one. The next writer puts the old one back.
    """
    make_folder(path.parent)
    recover_folder(path)
    temporary = _temporary(path, ".tmp")
    temporary.mkdir(0o700)  # fails where something, such as a link, has the name
    try:
        yield temporary
        temporary.chmod(PUBLIC_FOLDER)
        _sync_tree(temporary)
        if path.exists():
            old = _temporary(path, _OLD)
            os.replace(path, old)
            try:
                os.replace(temporary, path)
            except BaseException:
                os.replace(old, path)
                raise
            # the renames are synced first: else a crash could leave a half-removed folder under
            # the old name
            sync_folder(path.parent)
            shutil.rmtree(old, ignore_errors=True)
        else:
            os.replace(temporary, path)
        sync_folder(path.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def recover_folder(path: Path) -> None:
    """Remove what killed writers of a folder left, and put back one that was being replaced."""
    for stale in stale_temporaries(path):
        if stale.name.endswith(_OLD) and not path.exists():
            os.replace(stale, path)
        else:
            shutil.rmtree(stale, ignore_errors=True)


def _temporary(path: Path, suffix: str) -> Path:
    return path.with_name(f".{path.name}.{_owner()}-{uuid.uuid4().hex[:8]}{suffix}")


def _owner() -> str:
    """This process, in the name of a temporary."""
    return f"{_HOST}-{os.getpid()}-{_PROCESS}"


def _sync_tree(root: Path) -> None:
    """Sync every file and folder below ``root``, and ``root``."""
    for folder, _, names in os.walk(root):
        for name in names:
            with open(os.path.join(folder, name), "rb") as written:
                os.fsync(written.fileno())
        sync_folder(Path(folder))

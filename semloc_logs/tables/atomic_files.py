"""Files and folders that appear whole or not at all, whatever interrupts their writer.

The content is written under a temporary name beside the target and synced; a rename then puts it in
place; the folder is synced last. A crash at any point leaves the old state or the new one. When the
block has ended well, the new state survives a power failure.
"""

from __future__ import annotations

import glob
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_UMASK = os.umask(0o022)
os.umask(_UMASK)
PUBLIC = 0o666 & ~_UMASK  # permissions of a file that any program would make
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
    """Temporary files or folders for ``path`` that killed writers left behind."""
    return sorted(path.parent.glob(f".{glob.escape(path.name)}.*.tmp"))


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
    handle, name = tempfile.mkstemp(suffix, f".{path.name}.", path.parent)
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
    half of one.
    """
    make_folder(path.parent)
    for stale in stale_temporaries(path):
        shutil.rmtree(stale, ignore_errors=True)
    temporary = Path(tempfile.mkdtemp(".tmp", f".{path.name}.", path.parent))
    try:
        yield temporary
        temporary.chmod(PUBLIC_FOLDER)
        _sync_tree(temporary)
        if path.exists():
            # the rename fails where there is a link of this name
            old = path.with_name(f".{path.name}.{secrets.token_hex(4)}.old.tmp")
            os.replace(path, old)
            os.replace(temporary, path)
            # the renames are synced first: else a crash could leave a half-removed folder under
            # the old name
            sync_folder(path.parent)
            shutil.rmtree(old, ignore_errors=True)
        else:
            os.replace(temporary, path)
        sync_folder(path.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _sync_tree(root: Path) -> None:
    """Sync every file and folder below ``root``, and ``root``."""
    for folder, _, names in os.walk(root):
        for name in names:
            with open(os.path.join(folder, name), "rb") as written:
                os.fsync(written.fileno())
        sync_folder(Path(folder))

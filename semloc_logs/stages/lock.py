"""One writer of a workspace at a time; readers need no lock.

The lock is the kernel's: it ends with its process, however that ends. Beside it a file tells who
has it. Where files cannot be locked, that file is the lock; one of a process that is gone is taken.
"""

from __future__ import annotations

import functools
import json
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from filelock import FileLock, Timeout

from semloc_logs.errors import WorkspaceError
from semloc_logs.tables.atomic_files import is_alive, make_folder, recover_folder
from semloc_logs.workspace import Workspace

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
PROBE_BYTES = 1 << 20  # written before the work begins: a disk that is full is found then

_held: dict[Path, int] = {}  # how often this process entered


def one_writer(stage: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """A stage that has its workspace for itself.

    Raises WorkspaceError at once where another process writes to it, or nothing can be written.
    """

    @functools.wraps(stage)
    def locked(*args: Arguments.args, **options: Arguments.kwargs) -> Result:
        work = next(a for a in (*args, *options.values()) if isinstance(a, Workspace))
        with writing(work):
            return stage(*args, **options)

    return locked


@contextmanager
def writing(work: Workspace) -> Iterator[None]:
    """The block is the only writer of the workspace; it may be nested."""
    path = work.path.absolute()
    if path in _held:
        _held[path] += 1
        try:
            yield
        finally:
            _held[path] -= 1
        return

    _check_writable(work)
    with _locked(work):
        _held[path] = 1
        try:
            _recover_sessions(work)
            yield
        finally:
            del _held[path]


def _recover_sessions(work: Workspace) -> None:
    """Put back the sessions that a killed writer was replacing."""
    for left in sorted((work.path / "sessions").glob(".*.tmp")):
        name = left.name[1:].removesuffix(".tmp").removesuffix(".old").rpartition(".")[0]
        recover_folder(left.with_name(name))


def _check_writable(work: Workspace) -> None:
    """WorkspaceError where the workspace is read-only or its disk is full."""
    probe = work.path / f".probe.{socket.gethostname()}.{os.getpid()}"
    try:
        make_folder(work.path)
        try:
            with probe.open("wb") as file:
                file.write(bytes(PROBE_BYTES))
                file.flush()
                os.fsync(file.fileno())
        finally:
            probe.unlink(missing_ok=True)
    except OSError as problem:
        raise WorkspaceError(
            f"{work.path} cannot be written to ({problem.strerror or problem}): free some space, or"
            " choose a folder that this user may write to."
        ) from None


@contextmanager
def _locked(work: Workspace) -> Iterator[None]:
    lock = FileLock(work.lock, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise _in_use(work, _writer(work)) from None
    except (OSError, NotImplementedError):  # a file system without locks
        with _by_file(work):
            yield
        return
    try:
        work.writer.write_text(_this_process())
        yield
    finally:
        work.writer.unlink(missing_ok=True)
        lock.release()


@contextmanager
def _by_file(work: Workspace) -> Iterator[None]:
    writer = _writer(work)
    if writer.get("host") == socket.gethostname() and not is_alive(int(writer.get("process", 0))):
        work.writer.unlink(missing_ok=True)
    try:
        with work.writer.open("x") as file:
            file.write(_this_process())
    except FileExistsError:
        raise _in_use(work, _writer(work)) from None
    try:
        yield
    finally:
        work.writer.unlink(missing_ok=True)


def _this_process() -> str:
    now = time.strftime("%Y-%m-%d %H:%M:%S")
    return json.dumps({"host": socket.gethostname(), "process": os.getpid(), "since": now})


def _writer(work: Workspace) -> dict[str, Any]:
    try:
        content = json.loads(work.writer.read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _in_use(work: Workspace, writer: dict[str, Any]) -> WorkspaceError:
    who = "another process"
    if writer:
        who = f"process {writer['process']} on {writer['host']} since {writer['since']}"
    return WorkspaceError(
        f"{work.path} is being written by {who}: wait until it is done; finished work is kept."
    )

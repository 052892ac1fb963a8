"""Writers of a workspace: one at a time, or several that make different sessions or search
different pairs.

A lock is the kernel's: it ends with its process, however that ends. Beside it a file tells who has
it. Where files cannot be locked, that file is the lock; one of a process that is gone is taken.
Readers need no lock.
"""

from __future__ import annotations

import functools
import json
import os
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from filelock import FileLock, Timeout

from semloc_logs.errors import TemporaryError, WorkspaceError
from semloc_logs.tables.atomic_files import is_alive, make_folder, recover_folder
from semloc_logs.workspace import Workspace

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
PROBE_BYTES = 1 << 20  # written before the work begins: a disk that is full is found then
GATE_SECONDS = 20.0  # that tasks which begin at the same time may take to get their locks
WORKSPACE = "workspace"

_held: set[Path] = set()  # workspaces that this process has for itself


def one_writer(stage: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """A stage that has its workspace for itself."""

    @functools.wraps(stage)
    def locked(*args: Arguments.args, **options: Arguments.kwargs) -> Result:
        work = next(a for a in (*args, *options.values()) if isinstance(a, Workspace))
        with writing(work):
            return stage(*args, **options)

    return locked


@contextmanager
def writing(work: Workspace, sessions: Sequence[str] | None = None) -> Iterator[None]:
    """The block is the only writer of the workspace, or of its ``sessions``; it may be nested.

    Raises WorkspaceError at once where another process writes there, or nothing can be written.
    """
    path = work.path.absolute()
    if path in _held:
        yield
        return

    _check_writable(work)
    with ExitStack() as locks:
        # who has the gate lets nobody else begin
        gate = locks.enter_context(ExitStack())
        gate.enter_context(_locked(work, WORKSPACE, 0.0 if sessions is None else GATE_SECONDS))
        if sessions is None:
            _clear(work, [*_session_locks(work), *work.pair_locks()])
            _recover(work, _replaced_sessions(work))
            _held.add(path)
            locks.callback(_held.discard, path)
        else:
            for name in dict.fromkeys(sessions):
                locks.enter_context(_locked(work, _name(work, work.session_lock(name)), 0.0))
                _clear(work, [*work.pair_locks(query=name), *work.pair_locks(target=name)])
            gate.close()
            _recover(work, sessions)
        yield
        # a worker of an engine may have been killed over a task that another one has done since
        _recover(work, _replaced_sessions(work) if sessions is None else sessions)


@contextmanager
def searching(work: Workspace, query: str, target: str) -> Iterator[None]:
    """The block is the only one that searches ``query`` in ``target``; both stay as they are.

    Other pairs can be searched meanwhile. Raises WorkspaceError at once where another process
    searches the pair, makes one of its sessions, or has the workspace for itself.
    """
    if work.path.absolute() in _held:
        yield
        return

    _check_writable(work)
    own = work.pair_lock(query, target)
    with ExitStack() as lock:
        with _locked(work, WORKSPACE, GATE_SECONDS):
            for name in {query, target}:
                if work.session_lock(name).exists():
                    _clear(work, [work.session_lock(name)])
            make_folder(own.parent)
            lock.enter_context(_locked(work, _name(work, own), 0.0))
        yield
        # thousands of pairs leave no files behind
        lock.callback(_remove_lock, work, own)


def _remove_lock(work: Workspace, path: Path) -> None:
    """Whoever takes a lock has the gate, so nobody is about to take this one."""
    try:
        with _locked(work, WORKSPACE, GATE_SECONDS):
            path.unlink(missing_ok=True)
    except WorkspaceError:  # the next writer removes it
        return


def _clear(work: Workspace, paths: Iterable[Path]) -> None:
    """WorkspaceError where somebody has one of the locks; locks of pairs are removed."""
    for path in paths:
        with _locked(work, _name(work, path), 0.0):  # nobody has it
            if path.parent != work.locks:
                path.unlink(missing_ok=True)


def _name(work: Workspace, path: Path) -> str:
    """Of a lock, as it is taken and reported."""
    return str(path.relative_to(work.locks).with_suffix(""))


def _session_locks(work: Workspace) -> list[Path]:
    return sorted(work.locks.glob("session.*.lock"))


def _replaced_sessions(work: Workspace) -> set[str]:
    """Sessions that a killed writer was replacing."""
    left = (work.path / "sessions").glob(".*.tmp")
    names = (path.name[1:].removesuffix(".tmp").removesuffix(".old") for path in left)
    return {name.rpartition(".")[0] for name in names}


def _recover(work: Workspace, sessions: Iterable[str]) -> None:
    for name in sorted(sessions):
        recover_folder(work.session(name).path)


def _check_writable(work: Workspace) -> None:
    """WorkspaceError where the workspace is read-only or its disk is full."""
    probe = work.path / f".probe.{socket.gethostname()}.{os.getpid()}"
    try:
        make_folder(work.locks)
        try:
            with probe.open("wb") as file:
                file.write(bytes(PROBE_BYTES))
                file.flush()
                os.fsync(file.fileno())
        finally:
            probe.unlink(missing_ok=True)
    except OSError as problem:
        raise TemporaryError(
            f"{work.path} cannot be written to ({problem.strerror or problem}): free some space, or"
            " choose a folder that this user may write to."
        ) from None


@contextmanager
def _locked(work: Workspace, name: str, seconds: float) -> Iterator[None]:
    lock = FileLock(work.locks / f"{name}.lock", timeout=seconds)
    writer = work.locks / f"{name}.json"
    try:
        lock.acquire()
    except Timeout:
        raise _in_use(work, name, _content(writer)) from None
    except (OSError, NotImplementedError):  # a file system without locks
        with _locked_by_file(work, name):
            yield
        return
    try:
        writer.write_text(_this_process())
        yield
    finally:
        writer.unlink(missing_ok=True)
        lock.release()


@contextmanager
def _locked_by_file(work: Workspace, name: str) -> Iterator[None]:
    writer = work.locks / f"{name}.json"
    content = _content(writer)
    if content.get("host") == socket.gethostname() and not is_alive(int(content["process"])):
        writer.unlink(missing_ok=True)
    try:
        with writer.open("x") as file:
            file.write(_this_process())
    except FileExistsError:
        raise _in_use(work, name, _content(writer)) from None
    try:
        yield
    finally:
        writer.unlink(missing_ok=True)


def _this_process() -> str:
    now = time.strftime("%Y-%m-%d %H:%M:%S")
    return json.dumps({"host": socket.gethostname(), "process": os.getpid(), "since": now})


def _content(writer: Path) -> dict[str, Any]:
    try:
        content = json.loads(writer.read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _in_use(work: Workspace, name: str, writer: dict[str, Any]) -> TemporaryError:
    what = str(work.path)
    if name.startswith("session."):
        what = f"Session '{name.removeprefix('session.')}' of {work.path}"
    elif name != WORKSPACE:
        query, target = Path(name).parent.name, Path(name).name
        what = f"alignments/{query}/{target} of {work.path}"
    who = "another process"
    if writer:
        who = f"process {writer['process']} on {writer['host']} since {writer['since']}"
    return TemporaryError(
        f"{what} is being written by {who}: wait until it is done; finished work is kept."
    )

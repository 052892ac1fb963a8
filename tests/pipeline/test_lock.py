"""One writer of a workspace: a second one is refused with a sentence, and a killed one is no
hindrance.
"""

from __future__ import annotations

import errno
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from filelock import FileLock

from semloc_logs.errors import WorkspaceError
from semloc_logs.stages import lock
from semloc_logs.stages.lock import writing
from semloc_logs.workspace import Workspace

WRITER = """
import sys, time
from pathlib import Path
from semloc_logs.stages.lock import writing
from semloc_logs.workspace import Workspace
with writing(Workspace(Path(sys.argv[1])), sys.argv[2:] or None):
    print("ready", flush=True)
    time.sleep(300)
"""


def writer(work: Workspace) -> Path:
    return work.locks / "workspace.json"


@contextmanager
def other_writer(work: Workspace, *sessions: str) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(work.path), *sessions], stdout=subprocess.PIPE
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        yield process
    finally:
        process.kill()
        process.wait()


def test_a_second_writer_is_told_who_the_first_one_is(tmp_path: Path) -> None:
    work = Workspace(tmp_path / "work")
    with other_writer(work) as process:
        sentence = f"being written by process {process.pid} on {socket.gethostname()} since"
        with pytest.raises(WorkspaceError, match=sentence), writing(work):
            pass
        process.send_signal(signal.SIGKILL)
        process.wait()
        with writing(work):
            assert json.loads(writer(work).read_text())["process"] == os.getpid()
    assert not writer(work).exists()


def test_different_sessions_are_made_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the jobs of a cluster do; nobody else writes meanwhile."""
    monkeypatch.setattr(lock, "GATE_SECONDS", 0.2)
    work = Workspace(tmp_path / "work")
    with other_writer(work, "monday", "tuesday"):
        with writing(work, ["wednesday"]):
            pass
        tuesday = writing(work, ["tuesday"])
        with pytest.raises(WorkspaceError, match="Session 'tuesday' of"), tuesday:
            pass
        with pytest.raises(WorkspaceError, match="Session 'monday' of"), writing(work):
            pass
    with writing(work):
        pass
    with other_writer(work):
        wednesday = writing(work, ["wednesday"])
        with pytest.raises(WorkspaceError, match="work is being written by process"), wednesday:
            pass


def test_a_writer_may_enter_again(tmp_path: Path) -> None:
    work = Workspace(tmp_path / "work")
    with writing(work):
        with writing(work), writing(work, ["monday"]):
            pass
        assert writer(work).exists()
    with writing(work):
        pass


def test_where_files_cannot_be_locked_the_name_is_the_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_locks(*_: object, **__: object) -> None:
        raise NotImplementedError("FileSystem does not appear to support flock")

    monkeypatch.setattr(FileLock, "acquire", no_locks)
    work = Workspace(tmp_path / "work")
    with writing(work):
        assert writer(work).exists()
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    holder = {"host": socket.gethostname(), "process": gone.pid, "since": "yesterday"}
    writer(work).write_text(json.dumps(holder))
    with writing(work):
        assert json.loads(writer(work).read_text())["process"] == os.getpid()
    writer(work).write_text(json.dumps(holder | {"host": "another"}))
    with pytest.raises(WorkspaceError, match="on another since yesterday"), writing(work):
        pass


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS])
def test_a_full_or_read_only_disk_is_found_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    def fail(_: int) -> None:
        raise OSError(code, os.strerror(code))

    work = Workspace(tmp_path)
    monkeypatch.setattr(os, "fsync", fail)
    sentence = f"cannot be written to .{os.strerror(code)}"
    with pytest.raises(WorkspaceError, match=sentence), writing(work):
        pytest.fail("the work began")
    assert [p.name for p in tmp_path.iterdir() if p.is_file()] == []


def test_the_owner_of_temporary_files_is_in_their_names(tmp_path: Path) -> None:
    """Those of a living process stay, whoever writes the same file."""
    from semloc_logs.tables.atomic_files import replacing_folder, stale_temporaries

    path = tmp_path / "folder"
    with replacing_folder(path) as mine:
        assert stale_temporaries(path) == []
        with replacing_folder(path) as another:
            assert mine.is_dir()
            assert another != mine

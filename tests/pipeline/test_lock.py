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
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from filelock import FileLock

from semloc_logs.errors import TemporaryError, WorkspaceError
from semloc_logs.stages import lock
from semloc_logs.stages.lock import searching, writing
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


def test_who_searches_a_pair_keeps_its_sessions(tmp_path: Path) -> None:
    """Locks of the same process count, too: each is taken anew."""
    work = Workspace(tmp_path / "work")
    with searching(work, "tuesday", "monday"):
        with searching(work, "tuesday", "tuesday"):
            pass
        for sessions in (["monday"], ["tuesday"], None):
            refused = pytest.raises(TemporaryError, match="query=tuesday/target=monday")
            with refused, writing(work, sessions):
                pass
        refused = pytest.raises(TemporaryError, match="alignments/query=tuesday/target=monday")
        with refused, searching(work, "tuesday", "monday"):
            pass
        with writing(work, ["wednesday"]):
            pass
        assert work.pair_locks() == [work.pair_lock("tuesday", "monday")]
    assert work.pair_locks() == []
    with writing(work), searching(work, "tuesday", "monday"):
        pass
    assert work.pair_locks() == []


def test_a_session_that_is_made_is_not_searched(tmp_path: Path) -> None:
    work = Workspace(tmp_path / "work")
    with writing(work, ["monday"]):
        for query, target in (("monday", "tuesday"), ("tuesday", "monday")):
            refused = pytest.raises(TemporaryError, match="Session 'monday' of")
            with refused, searching(work, query, target):
                pass
        with searching(work, "wednesday", "tuesday"):
            pass
    with searching(work, "tuesday", "monday"):
        pass


def test_one_that_begins_waits_until_another_has_begun(tmp_path: Path) -> None:
    """The whole workspace is not waited for: who has it may work for hours."""
    work = Workspace(tmp_path / "work")
    work.locks.mkdir(parents=True)
    gate = FileLock(work.locks / "workspace.lock", thread_local=False)
    gate.acquire()
    with pytest.raises(TemporaryError, match="work is being written by"), writing(work):
        pass
    begun = threading.Timer(0.3, gate.release)
    begun.start()
    with writing(work, ["monday"]):
        assert not gate.is_locked
    begun.join()


def test_who_has_a_workspace_removes_the_locks_of_pairs_that_others_left(tmp_path: Path) -> None:
    """The locks of sessions stay: there are as many as sessions."""
    work = Workspace(tmp_path / "work")
    left = [work.session_lock("monday"), work.pair_lock("tuesday", "monday")]
    left[1].parent.mkdir(parents=True)
    for path in left:
        path.touch()
    with writing(work):
        assert set(work.locks.rglob("*.lock")) == {left[0], work.locks / "workspace.lock"}


@pytest.mark.parametrize("sessions", [None, ["monday"]])
def test_a_session_whose_writer_was_killed_is_put_back(
    tmp_path: Path, sessions: Sequence[str] | None
) -> None:
    """Before the work begins, and once more at its end: of another host, the writer is gone."""
    work = Workspace(tmp_path / "work")
    session = work.session("monday").path
    replaced = session.with_name(".monday.elsewhere-1-2-3.old.tmp")
    replaced.mkdir(parents=True)
    with writing(work, sessions):
        assert list(session.parent.iterdir()) == [session]
        session.rename(replaced)
    assert list(session.parent.iterdir()) == [session]


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
    with replacing_folder(path) as temporary:
        assert stale_temporaries(path) == []
        with replacing_folder(path) as another:
            assert temporary.is_dir()
            assert another != temporary

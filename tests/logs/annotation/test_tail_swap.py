"""The saved end of a log: which one is used, who may have written it, and locks."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import pytest

from semloc_logs.errors import LogError
from semloc_logs.logs.annotation import tail_swap
from semloc_logs.logs.annotation.mcap_append import AppendPlan
from semloc_logs.logs.annotation.tail_swap import copy_start, locked, recover, swap_tail
from semloc_logs.tables import atomic_files

OLD = b"the old end"
NEW = b"another end, longer"
START = 200_000
RECORDED = bytes(range(256)) * (START // 256) + bytes(START % 256)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Recorded bytes that are longer than what identifies a file, and an end."""
    path = tmp_path / "log.mcap"
    path.write_bytes(RECORDED + OLD)
    return path


def interrupted(log: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The saved end of a run that was killed when it had written a part of the new one."""

    def killed(fd: int, offset: int, tail: bytes) -> None:
        os.pwrite(fd, tail[:5], offset)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, locked(log) as fd:
        patch.setattr(tail_swap, "_write_tail", killed)
        patch.setattr(tail_swap, "_undo", lambda *_: None)
        with pytest.raises(KeyboardInterrupt):
            swap_tail(log, fd, AppendPlan(START, OLD, NEW))
    assert log.read_bytes() == RECORDED + b"anothld end"
    return log.with_name("log.mcap.semloc-tail")


def test_the_saved_end_comes_back(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    side = interrupted(log, monkeypatch)
    assert recover(log)
    assert log.read_bytes() == RECORDED + OLD
    assert not side.exists()
    assert not recover(log)


def test_a_new_end_that_is_complete_stays(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The run was killed when only the saved end was left to remove."""

    def killed(side: Path) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, locked(log) as fd:
        patch.setattr(tail_swap, "remove_file", killed)
        with pytest.raises(KeyboardInterrupt):
            swap_tail(log, fd, AppendPlan(START, OLD, NEW))
    assert recover(log)
    assert log.read_bytes() == RECORDED + NEW
    assert list(log.parent.iterdir()) == [log]


@pytest.mark.parametrize(
    ("size", "fits"),  # from where the end starts to the longer of both ends
    [(START - 1, False), (START, True), (START + len(NEW), True), (START + len(NEW) + 1, False)],
)
def test_how_long_the_log_of_a_saved_end_may_be(
    log: Path, monkeypatch: pytest.MonkeyPatch, size: int, fits: bool
) -> None:
    side = interrupted(log, monkeypatch)
    os.truncate(log, size)
    if fits:
        assert recover(log)
        assert log.read_bytes() == RECORDED + OLD
    else:
        with pytest.raises(LogError, match="is not the saved end of this state"):
            recover(log)
        assert log.stat().st_size == size
    assert side.exists() == (not fits)


def test_a_log_beside_which_a_run_died_while_saving_needs_no_repair(log: Path) -> None:
    """Its end was not touched yet: only the half of it that was saved goes away."""
    log.with_name(".log.mcap.semloc-tail.elsewhere-1-abc-123.tmp").write_bytes(b"half an end")
    assert not recover(log)
    assert list(log.parent.iterdir()) == [log]
    assert log.read_bytes() == RECORDED + OLD


def test_without_a_saved_end_a_log_is_not_opened_nor_one_without_a_log(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process may hold the log, and a saved end waits until its log is there again."""
    with locked(log):
        assert not recover(log)
    side = interrupted(log, monkeypatch)
    log.unlink()
    assert not recover(log)
    assert side.exists()


def test_an_end_that_stays_is_not_written(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tail_swap, "_save", None)
    monkeypatch.setattr(tail_swap, "_write_tail", None)
    with locked(log) as fd:
        swap_tail(log, fd, AppendPlan(START, OLD, OLD))
    assert log.read_bytes() == RECORDED + OLD


def test_a_link_in_place_of_the_saved_end_is_not_used(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who may write beside a log could point it at any file that the user may read."""
    side = interrupted(log, monkeypatch)
    elsewhere = side.rename(log.parent / "elsewhere")
    side.symlink_to(elsewhere)
    before = log.read_bytes()
    with pytest.raises(LogError, match="is a symbolic link, so it was not used"):
        recover(log)
    assert log.read_bytes() == before


def test_a_saved_end_of_another_user_is_not_used(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither the log's owner nor this user wrote it."""
    side = interrupted(log, monkeypatch)
    before = log.read_bytes()
    real = os.fstat
    own = side.stat()

    def fstat(handle: int) -> os.stat_result:
        status = real(handle)
        if status.st_ino != own.st_ino:
            return status
        return os.stat_result((*status[:4], own.st_uid + 1, *status[5:]))

    monkeypatch.setattr(os, "fstat", fstat)
    with pytest.raises(LogError, match="is a file of another user, so it was not used"):
        recover(log)
    assert log.read_bytes() == before
    monkeypatch.setattr(os, "geteuid", lambda: own.st_uid + 1)
    assert recover(log)
    assert log.read_bytes() == RECORDED + OLD


@pytest.mark.parametrize("place", [0, 1000, START - 1])
def test_a_saved_end_is_of_one_log_only(
    log: Path, monkeypatch: pytest.MonkeyPatch, place: int
) -> None:
    """A byte at the start of the log, or right before its end, is another one."""
    interrupted(log, monkeypatch)
    data = bytearray(log.read_bytes())
    data[place] ^= 1
    log.write_bytes(data)
    with pytest.raises(LogError, match="is not the saved end of this state"):
        recover(log)
    assert log.read_bytes() == data


@pytest.mark.parametrize("place", [0, 14 + 8, 14 + 3 * 8 + 64, -1])
def test_a_damaged_saved_end_is_refused(
    log: Path, monkeypatch: pytest.MonkeyPatch, place: int
) -> None:
    """In its first bytes, the old size, the checksum, the end itself."""
    side = interrupted(log, monkeypatch)
    data = bytearray(side.read_bytes())
    assert struct.unpack("<Q", data[22:30]) == (START + len(OLD),)
    data[place] ^= 1
    side.write_bytes(data)
    before = log.read_bytes()
    with pytest.raises(LogError, match=r"semloc-tail is damaged"):
        recover(log)
    assert log.read_bytes() == before


def test_a_folder_that_cannot_be_synced_keeps_no_saved_end(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The saved end has its name by then, and it is not known to last: the log is not touched."""

    def full(folder: Path) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch, locked(log) as fd:
        patch.setattr(atomic_files, "sync_folder", full)
        with pytest.raises(LogError, match="is unchanged: its end could not be saved"):
            swap_tail(log, fd, AppendPlan(START, OLD, NEW))
    assert log.read_bytes() == RECORDED + OLD
    assert list(log.parent.iterdir()) == [log]


def test_readers_share_a_log_and_a_writer_does_not(log: Path) -> None:
    refused = pytest.raises(LogError, match="is being written by another process")
    with locked(log, shared=True), locked(log, shared=True), refused, locked(log):
        pass
    with locked(log), refused, locked(log, shared=True):
        pass


@pytest.mark.parametrize("has_quick_copy", [True, False])
def test_a_log_that_becomes_shorter_while_it_is_copied(
    log: Path, monkeypatch: pytest.MonkeyPatch, has_quick_copy: bool
) -> None:
    if not has_quick_copy:
        monkeypatch.delattr(os, "copy_file_range", raising=False)
    copy = log.parent / "copy"
    copy.touch()
    with locked(log, shared=True) as source, locked(copy) as target:
        copy_start(source, target, START)
        assert copy.read_bytes() == RECORDED
        with pytest.raises(LogError, match=rf"became shorter .*\(at offset {START + len(OLD)}\)"):
            copy_start(source, target, START + len(OLD) + 1)


@pytest.mark.parametrize("has_quick_copy", [True, False])
def test_no_more_than_the_start_of_a_log_is_copied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_quick_copy: bool
) -> None:
    """A block of 1 MiB and 5 bytes of the next one; the log has 20 more."""
    if not has_quick_copy:
        monkeypatch.delattr(os, "copy_file_range", raising=False)
    data = bytes(range(256)) * (1 << 12) + b"five and many more bytes."
    log = tmp_path / "log.mcap"
    log.write_bytes(data)
    copy = tmp_path / "copy"
    copy.touch()
    with locked(log, shared=True) as source, locked(copy) as target:
        copy_start(source, target, (1 << 20) + 5)
    assert copy.read_bytes() == data[:-20]

"""Files and folders that appear whole or not at all, whatever interrupts their writer."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from semloc_logs.tables.atomic_files import (
    PUBLIC,
    PUBLIC_FOLDER,
    make_folder,
    remove_file,
    replacing_file,
    replacing_folder,
)
from tests.lossy_disk import LossyDisk, Tree, read_tree, write_tree


def leftovers(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir() if p.name.startswith("."))


def test_a_file_is_replaced_at_the_end_of_the_block(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "er" / "file"
    for content in ("old", "new"):
        with replacing_file(path) as temporary:
            temporary.write_text(content)
            assert not path.exists() or path.read_text() == "old"
        assert path.read_text() == content
    assert not leftovers(path.parent)


def test_an_exception_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old")

    def half() -> None:
        with replacing_file(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        half()
    assert path.read_text() == "old"
    assert not leftovers(tmp_path)


def test_a_folder_is_replaced_as_a_whole(tmp_path: Path) -> None:
    path = tmp_path / "folder"
    for n in (3, 2):
        with replacing_folder(path) as temporary:
            (temporary / "sub").mkdir()
            for i in range(n):
                (temporary / "sub" / f"{i}").write_text(f"{n}")
        assert sorted(p.name for p in (path / "sub").iterdir()) == [str(i) for i in range(n)]
    assert not leftovers(tmp_path)


def test_an_exception_leaves_the_old_folder(tmp_path: Path) -> None:
    path = tmp_path / "folder"
    path.mkdir()
    (path / "a").write_text("old")

    def half() -> None:
        with replacing_folder(path) as temporary:
            (temporary / "a").write_text("half")
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        half()
    assert (path / "a").read_text() == "old"
    assert not leftovers(tmp_path)


def test_what_a_killed_run_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a[1]"  # no pattern
    for name in (".a[1].0badcafe.tmp", ".a[1].0badcafe.old.tmp", ".other.0badcafe.tmp", "a[1].tmp"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "x").write_text("x")
    with replacing_folder(path) as temporary:
        (temporary / "x").write_text("new")
    assert leftovers(tmp_path) == [".other.0badcafe.tmp"]
    assert sorted(p.name for p in tmp_path.iterdir() if p.name[0] != ".") == ["a[1]", "a[1].tmp"]


def test_temporary_names_are_new_files_of_this_user(tmp_path: Path) -> None:
    """In a shared folder nobody can have prepared one as a link to somewhere else."""
    names = set()
    for _ in range(20):
        with replacing_file(tmp_path / "file", ".png") as temporary:
            assert temporary.is_file()
            assert not temporary.is_symlink()
            assert temporary.stat().st_mode & 0o777 == 0o600
            assert temporary.suffix == ".png"
            names.add(temporary.name)
        with replacing_folder(tmp_path / "folder") as folder:
            assert folder.stat().st_mode & 0o777 == 0o700
            names.add(folder.name)
    assert len(names) == 40
    assert (tmp_path / "file").stat().st_mode & 0o777 == PUBLIC
    assert (tmp_path / "folder").stat().st_mode & 0o777 == PUBLIC_FOLDER


def test_a_temporary_that_became_a_link_is_not_published(tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.write_text("of someone else")

    def swapped() -> None:
        with replacing_file(tmp_path / "file", mode=0o444) as temporary:
            temporary.unlink()
            temporary.symlink_to(other)

    with pytest.raises(OSError, match="symbolic link"):
        swapped()
    assert not (tmp_path / "file").exists()
    assert other.read_text() == "of someone else"
    assert other.stat().st_mode & 0o200
    assert not leftovers(tmp_path)


WRITER = """
import sys
from pathlib import Path
from semloc_logs.tables.atomic_files import replacing_file, replacing_folder
root = Path(sys.argv[1])
print("ready", flush=True)
n = 0
while True:
    n += 1
    with replacing_file(root / "file") as temporary:
        temporary.write_text(f"{n}\\n" * 2000)
    with replacing_folder(root / "folder") as temporary:
        for i in range(5):
            (temporary / f"{i}").write_text(f"{n}\\n" * 500)
"""


@pytest.mark.parametrize("wait", [0.02, 0.11])
def test_a_kill_leaves_old_or_new_but_never_half(wait: float, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    while not (tmp_path / "folder").exists():
        time.sleep(0.005)
    time.sleep(wait)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    lines = (tmp_path / "file").read_text().splitlines()
    assert len(lines) == 2000
    assert len(set(lines)) == 1
    if (tmp_path / "folder").exists():  # between the two renames there is none
        contents = [p.read_text() for p in sorted((tmp_path / "folder").iterdir())]
        assert len(contents) == 5
        assert len(set(contents)) == 1
        assert contents[0].count("\n") == 500
    with replacing_folder(tmp_path / "folder") as temporary:
        (temporary / "0").write_text("after")
    assert [p.name for p in (tmp_path / "folder").iterdir()] == ["0"]
    assert not [name for name in leftovers(tmp_path) if name.startswith(".folder")]


# -- power failures

OLD: Tree = {"0": b"old" * 400, "sub": {"1": b"old" * 900, "gone": b"old"}}
NEW: Tree = {"0": b"new" * 500, "sub": {"1": b"new" * 800}, "more": {"2": b"new"}}


def new_file(folder: Path) -> None:
    with replacing_file(folder / "target") as temporary:
        temporary.write_bytes(b"new" * 900)


def new_folder(folder: Path) -> None:
    with replacing_folder(folder / "target") as temporary:
        temporary.rmdir()
        write_tree(NEW, temporary)


def old_file_gone(folder: Path) -> None:
    remove_file(folder / "target")


def new_parents(folder: Path) -> None:
    make_folder(folder / "a" / "b")


FILE = {"target": b"old" * 700}
FOLDER = {"target": OLD}
FRESH: Tree = {}
# writer, the content before and after, the number of syncs
WRITERS: dict[str, tuple[Callable[[Path], None], Tree, Tree, int]] = {
    "file": (new_file, FRESH, {"target": b"new" * 900}, 2),
    "file again": (new_file, FILE, {"target": b"new" * 900}, 2),
    "folder": (new_folder, FRESH, {"target": NEW}, 3 + 3 + 1),
    "folder again": (new_folder, FOLDER, {"target": NEW}, 3 + 3 + 2),
    "removal": (old_file_gone, FILE, FRESH, 1),
    "parents": (new_parents, FRESH, {"a": {"b": {}}}, 2),
}


def states_of(name: str, folder: Path, lost_sync: int = -1) -> tuple[list[Tree], list[Tree], int]:
    """States that a crash may leave while a writer runs, those after it, the number of syncs."""
    writer, before, _, _ = WRITERS[name]
    disk = LossyDisk(write_tree(before, folder))
    disk.lost_sync = lost_sync
    states: list[Tree] = []
    disk.visit = lambda: states.extend(s for s in disk.states() if s not in states)
    with disk.watching():
        writer(folder)
    last = list(disk.states())
    return states + last, last, disk.syncs


def torn(name: str, states: list[Tree]) -> list[Tree]:
    """States whose target is neither what it was nor what it is to be.

    Two renames replace a folder, and in between it may be missing.
    """
    _, before, after, _ = WRITERS[name]
    whole = [before.get("target"), after.get("target"), *([None] if "folder" in name else [])]
    return [state for state in states if state.get("target") not in whole]


@pytest.mark.parametrize("name", WRITERS)
def test_power_failure_at_every_step_leaves_old_or_new(tmp_path: Path, name: str) -> None:
    states, last, syncs = states_of(name, tmp_path / "disk")
    assert len(states) > 2
    assert torn(name, states) == []
    assert last == [WRITERS[name][2]]  # durable when the function returns
    assert syncs == WRITERS[name][3]


@pytest.mark.parametrize(("name", "sync"), [(n, k) for n in WRITERS for k in range(WRITERS[n][3])])
def test_every_sync_is_needed(tmp_path: Path, name: str, sync: int) -> None:
    states, last, _ = states_of(name, tmp_path / "disk", lost_sync=sync)
    assert torn(name, states) or last != [WRITERS[name][2]]


# -- full disks


FAILING = [(n, s) for n in ("file", "folder") for s in ("fsync", "replace")] + [("file", "fchmod")]


@pytest.mark.parametrize("again", ["", " again"])
@pytest.mark.parametrize(("kind", "step"), FAILING)
def test_a_step_that_fails_leaves_the_old_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, step: str, again: str
) -> None:
    writer, before, after, _ = WRITERS[kind + again]
    folder = write_tree(before, tmp_path / "disk")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, step, full)
        with pytest.raises(OSError, match="No space left"):
            writer(folder)
    assert read_tree(folder) == before
    writer(folder)
    assert read_tree(folder) == after


def test_permissions(tmp_path: Path) -> None:
    plain = tmp_path / "plain"
    private = tmp_path / "private"
    plain.touch()
    with replacing_file(tmp_path / "a") as temporary:
        temporary.touch(0o600)
    with replacing_file(private, mode=0o600) as temporary:
        temporary.touch()
    assert (tmp_path / "a").stat().st_mode == plain.stat().st_mode
    assert private.stat().st_mode & 0o777 == 0o600

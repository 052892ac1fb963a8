"""Power failures, kills and full disks while a log is annotated: the log stays whole."""

from __future__ import annotations

import contextlib
import itertools
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from semloc_logs.cli.main import program
from semloc_logs.errors import LogError
from semloc_logs.logs.annotation.annotate import (
    ClosureRecord,
    Results,
    annotate_copy,
    annotate_in_place,
    annotate_sidecar,
    recover,
)
from semloc_logs.logs.annotation.tail_swap import locked
from semloc_logs.tables import atomic_files
from tests.lossy_disk import Crash, LossyDisk, Tree, read_tree, write_tree

IN_PLACE_SYNCS = 4  # saved tail, its name, the log, the removal of the saved tail
FILE_SYNCS = 2  # a new file, its name


def results(count: int = 3, setting: str = "new") -> Results:
    """Closures of the session a."""
    covariance = tuple((np.eye(6) * 0.01).ravel())
    given = (1, 2, 3, 0, 0, 0, 1, covariance, 0.8, 0.97, 100, 20, np.eye(4), np.arange(3.0))
    closures = [ClosureRecord("a", f"target{k}", 3 + k, 5, *given) for k in range(count)]
    return Results(closures, "a", {"setting": setting}, log_times={})


def write_log(path: Path, count: int = 12) -> bytes:
    """A log of several small chunks, with an attachment and metadata; returns its bytes."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=100, enable_data_crcs=True)
        writer.start("", "test")
        schema = writer.register_schema("thing", "jsonschema", b"{}")
        channel = writer.register_channel("/one", "json", schema)
        for k in range(count):
            writer.add_message(channel, 100 + k, b'{"v": %d}' % k, 90 + k, k)
        writer.add_attachment(1, 2, "calibration.txt", "text/plain", b"fx 500")
        writer.add_metadata("vehicle", {"plate": "ZH 1"})
        writer.finish()  # type: ignore[no-untyped-call]
    return path.read_bytes()


def topics(path: Path) -> list[str]:
    """Topics of all messages of a log; every checksum is verified, in the file and by its index."""
    with path.open("rb") as file:
        for _ in StreamReader(file, validate_crcs=True).records:
            pass
    with path.open("rb") as file:
        messages = make_reader(file, validate_crcs=True).iter_messages()
        return sorted(channel.topic for _, channel, _ in messages)


@dataclass(frozen=True)
class Case:
    """A log as it is, and as it is to become by ``new`` results."""

    before: bytes
    after: bytes
    new: Results

    def put(self, folder: Path) -> Path:
        """The log as it is, in a new folder."""
        return write_tree({"log.mcap": self.before}, folder) / "log.mcap"


def case(tmp_path: Path, kind: str) -> Case:
    """First results, or results that replace others: the log grows, shrinks or keeps its size."""
    log = tmp_path / "made.mcap"
    write_log(log)
    old, new = {"first": (0, 3), "longer": (1, 3), "shorter": (3, 2), "equal": (2, 2)}[kind]
    if old:
        annotate_in_place(log, results(old, "old"))
    before = log.read_bytes()
    copy = tmp_path / "copy.mcap"
    # compressed sizes depend on the text: of equal results some text has the same size
    for text in ("new", *map(str, range(100, 200))):
        after_results = results(new, text)
        annotate_copy(log, copy, after_results, overwrite=True)
        after = copy.read_bytes()
        if kind != "equal" or len(after) == len(before):
            break
    sizes = {"first": (1, 0), "longer": (1, 0), "shorter": (0, 1), "equal": (0, 0)}[kind]
    assert (len(after) > len(before), len(after) < len(before)) == tuple(map(bool, sizes))
    assert topics(log).count("/semloc/loop_closures") == old
    assert topics(copy).count("/semloc/loop_closures") == new
    return Case(before, after, after_results)


KINDS = ("first", "longer", "shorter", "equal")


def every_state(disk: LossyDisk, action: Callable[[], object]) -> tuple[list[Tree], list[Tree]]:
    """All states that a crash may leave while ``action`` runs, and those after it has ended."""
    states: list[Tree] = []

    def look() -> None:
        states.extend(state for state in disk.states() if state not in states)

    disk.visit = look
    with disk.watching(), contextlib.suppress(Crash):
        action()
    disk.visit = lambda: None
    last = list(disk.states())
    return states + [state for state in last if state not in states], last


def mended(state: Tree, folder: Path) -> Tree | str:
    """What the next look at the log makes of a state; the sentence of the error if it refuses."""
    log = write_tree(state, folder) / "log.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: None)  # only the content of memory counts here
        patch.setattr(atomic_files, "_PROCESS", "later")  # the writer is dead, this is another
        try:
            recover(log)
        except LogError as error:
            return str(error)
    return read_tree(folder)


def faults(states: list[Tree], made: Case, scratch: Path) -> list[Tree | str]:
    """States from which the log does not come back whole, as it was or as it is to be."""
    whole: list[Tree | str] = [{"log.mcap": made.before}, {"log.mcap": made.after}]
    outcomes = [mended(state, scratch / str(k)) for k, state in enumerate(states)]
    return [outcome for outcome in outcomes if outcome not in whole]


@pytest.mark.parametrize("kind", KINDS)
def test_power_failure_at_every_step_in_place(tmp_path: Path, kind: str) -> None:
    made = case(tmp_path, kind)
    log = made.put(tmp_path / "disk")
    disk = LossyDisk(log.parent)
    states, last = every_state(disk, lambda: annotate_in_place(log, made.new))
    assert disk.syncs == IN_PLACE_SYNCS
    torn = [s for s in states if s.get("log.mcap") not in (made.before, made.after)]
    assert len(torn) > 10
    assert faults(states, made, tmp_path / "scratch") == []
    assert last == [{"log.mcap": made.after}]  # durable when the function returns


@pytest.mark.parametrize("sync", range(IN_PLACE_SYNCS))
def test_every_sync_in_place_is_needed(tmp_path: Path, sync: int) -> None:
    """The test above sees each sync that is missing: else it would prove nothing."""
    made = case(tmp_path, "longer")
    log = made.put(tmp_path / "disk")
    disk = LossyDisk(log.parent)
    disk.lost_sync = sync
    states, last = every_state(disk, lambda: annotate_in_place(log, made.new))
    not_durable = last != [{"log.mcap": made.after}]
    assert faults(states, made, tmp_path / "scratch") or not_durable


@pytest.mark.parametrize("kind", KINDS)
def test_the_log_changes_only_after_its_old_end_is_saved(tmp_path: Path, kind: str) -> None:
    """Whenever the log differs from what it was, the saved end lies durably beside it."""
    made = case(tmp_path, kind)
    log = made.put(tmp_path / "disk")
    states, _ = every_state(LossyDisk(log.parent), lambda: annotate_in_place(log, made.new))
    saved = [s["log.mcap.semloc-tail"] for s in states if "log.mcap.semloc-tail" in s]
    assert len(set(saved)) == 1
    for state in states:
        if state["log.mcap"] not in (made.before, made.after):
            assert state["log.mcap.semloc-tail"] == saved[0]


def killed_disks(made: Case, tmp_path: Path) -> Iterator[tuple[LossyDisk, Path]]:
    """Disks on which a process was killed at each step, so that nothing is lost yet."""
    for step in itertools.count():
        log = made.put(tmp_path / f"killed{step}")
        disk = LossyDisk(log.parent)
        disk.die_at = step
        every_state(disk, partial(annotate_in_place, log, made.new))
        ended = disk.steps < step
        disk.die_at = -1
        if ended:
            return
        yield disk, log


def note_repair(done: list[bool], log: Path) -> None:
    done.append(recover(log))


@pytest.mark.parametrize("kind", KINDS)
def test_power_failure_while_a_killed_run_is_repaired(tmp_path: Path, kind: str) -> None:
    """What a killed process wrote is in memory only: the repair must not take it for safe."""
    made = case(tmp_path, kind)
    repairs = 0
    states: list[Tree] = []
    for disk, log in killed_disks(made, tmp_path):
        done: list[bool] = []
        while_repaired, last = every_state(disk, partial(note_repair, done, log))
        states += [state for state in while_repaired if state not in states]
        if done == [True]:  # a repair is durable when the function returns
            assert last in ([{"log.mcap": made.before}], [{"log.mcap": made.after}])
            repairs += 1
    assert repairs > 3
    assert faults(states, made, tmp_path / "scratch") == []


def test_power_failure_while_a_torn_log_is_repaired(tmp_path: Path) -> None:
    made = case(tmp_path, "longer")
    log = made.put(tmp_path / "disk")
    states, _ = every_state(LossyDisk(log.parent), lambda: annotate_in_place(log, made.new))
    torn = [s for s in states if s["log.mcap"] not in (made.before, made.after)]
    for k, state in enumerate(torn[:: len(torn) // 8]):
        log = write_tree(state, tmp_path / f"torn{k}") / "log.mcap"
        again, last = every_state(LossyDisk(log.parent), partial(recover, log))
        assert faults(again, made, tmp_path / f"scratch{k}") == []
        assert last == [{"log.mcap": made.before}]


@pytest.mark.parametrize("command", ["inspect", "fuse"])
def test_the_next_command_repairs_the_log(tmp_path: Path, command: str) -> None:
    made = case(tmp_path, "longer")
    log = made.put(tmp_path / "disk")
    states, _ = every_state(LossyDisk(log.parent), lambda: annotate_in_place(log, made.new))
    torn = [s for s in states if s["log.mcap"] not in (made.before, made.after)][-1]
    log = write_tree(torn, tmp_path / "torn") / "log.mcap"
    given = ["-w", str(tmp_path / "work")] if command == "fuse" else []
    done = CliRunner().invoke(program, [command, str(log), *given])
    assert not isinstance(done.exception, Exception), done.output
    assert read_tree(log.parent) == {"log.mcap": made.before}


# -- new files


WRITERS = {"copy": annotate_copy, "sidecar": annotate_sidecar}


@pytest.mark.parametrize("old", [None, b"older results"])
@pytest.mark.parametrize("mode", WRITERS)
def test_power_failure_at_every_step_of_a_new_file(
    tmp_path: Path, mode: str, old: bytes | None
) -> None:
    log = tmp_path / "log.mcap"
    folder = tmp_path / "disk"
    original = write_log(log)
    write_tree({} if old is None else {"out.mcap": old}, folder)
    output = folder / "out.mcap"
    disk = LossyDisk(folder)
    states, last = every_state(
        disk, lambda: WRITERS[mode](log, output, results(), overwrite=old is not None)
    )
    assert disk.syncs == FILE_SYNCS
    new = output.read_bytes()
    assert topics(output).count("/semloc/loop_closures") == 3
    assert {state.get("out.mcap") for state in states} == {old, new}
    assert last == [{"out.mcap": new}]
    assert log.read_bytes() == original


@pytest.mark.parametrize("sync", range(FILE_SYNCS))
@pytest.mark.parametrize("mode", WRITERS)
def test_every_sync_of_a_new_file_is_needed(tmp_path: Path, mode: str, sync: int) -> None:
    log = tmp_path / "log.mcap"
    folder = tmp_path / "disk"
    write_log(log)
    folder.mkdir()
    disk = LossyDisk(folder)
    disk.lost_sync = sync
    states, last = every_state(disk, lambda: WRITERS[mode](log, folder / "out.mcap", results()))
    new = (folder / "out.mcap").read_bytes()
    broken = {state.get("out.mcap") for state in states} - {None, new}
    assert broken or last != [{"out.mcap": new}]


# -- kill -9


KILLED = """
import os, shutil, signal, sys
from pathlib import Path
import numpy as np
from semloc_logs.logs.annotation.annotate import (
    ClosureRecord, Results, annotate_copy, annotate_in_place, annotate_sidecar,
)

made, folder, mode = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
given = (1, 2, 3, 0, 0, 0, 1, tuple((np.eye(6) * 0.01).ravel()), 0.8, 0.97, 100, 20)
closures = [ClosureRecord("a", f"target{k}", 3 + k, 5, *given) for k in range(3)]
results = Results(closures, "a", {"setting": "new"}, log_times={})

def annotate(log):
    if mode == "in-place":
        annotate_in_place(log, results)
    else:
        write = annotate_copy if mode == "copy" else annotate_sidecar
        write(log, log.with_name("out.mcap"), results)

def child(log, step):
    left = step
    def before(real, *args, **options):
        nonlocal left
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        left -= 1
        return real(*args, **options)
    def written(handle, data, offset):  # in pieces, and a kill between them too
        for start in range(0, len(data), 400):
            before(pwrite, handle, data[start : start + 400], offset + start)
        return len(data)
    pwrite = os.pwrite
    for name in ("fsync", "ftruncate", "replace", "unlink"):
        real = getattr(os, name)
        setattr(os, name, lambda *args, real=real, **options: before(real, *args, **options))
    os.pwrite = written
    annotate(log)
    os._exit(0)

for step in range(1000):
    log = folder / str(step) / "log.mcap"
    log.parent.mkdir()
    shutil.copyfile(made, log)
    process = os.fork()
    if process == 0:
        child(log, step)
    _, status = os.waitpid(process, 0)
    if os.WIFEXITED(status):
        print(step, os.WEXITSTATUS(status))
        break
    assert os.WTERMSIG(status) == signal.SIGKILL
"""


def killed_at_every_step(tmp_path: Path, made: bytes, mode: str) -> list[Path]:
    """Folders with what a killed process left, one for each step; in the last it ended well."""
    source = tmp_path / "source.mcap"
    folder = tmp_path / "killed"
    source.write_bytes(made)
    folder.mkdir()
    command = [sys.executable, "-P", "-c", KILLED, str(source), str(folder), mode]
    done = subprocess.run(command, capture_output=True, text=True, timeout=50)
    assert done.returncode == 0, done.stderr
    steps, status = map(int, done.stdout.split())
    assert status == 0
    return [folder / str(step) for step in range(steps + 1)]


def test_kill_at_every_write_in_place(tmp_path: Path) -> None:
    made = tmp_path / "made.mcap"
    write_log(made)
    annotate_in_place(made, results(1, "old"))
    before = made.read_bytes()
    folders = killed_at_every_step(tmp_path, before, "in-place")
    after = (folders[-1] / "log.mcap").read_bytes()
    torn = 0
    for folder in folders:
        torn += (folder / "log.mcap").read_bytes() not in (before, after)
        recover(folder / "log.mcap")
        assert read_tree(folder) in ({"log.mcap": before}, {"log.mcap": after})
    assert torn > 5
    assert topics(folders[-1] / "log.mcap").count("/semloc/loop_closures") == 3


@pytest.mark.parametrize("mode", WRITERS)
def test_kill_at_every_step_of_a_new_file(tmp_path: Path, mode: str) -> None:
    made = tmp_path / "made.mcap"
    original = write_log(made)
    folders = killed_at_every_step(tmp_path, original, mode)
    new = (folders[-1] / "out.mcap").read_bytes()
    assert topics(folders[-1] / "out.mcap").count("/semloc/loop_closures") == 3
    assert len(folders) > FILE_SYNCS
    for folder in folders:
        contents = {p.name: p.read_bytes() for p in folder.iterdir() if p.name[0] != "."}
        assert contents in ({"log.mcap": original}, {"log.mcap": original, "out.mcap": new})


# -- full disk


@contextlib.contextmanager
def size_limit(limit: int) -> Iterator[None]:
    """No file may become longer than ``limit`` bytes: the write that would do it fails midway."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("kind", KINDS)
def test_a_write_that_fails_at_any_byte_leaves_the_log_as_it_was(tmp_path: Path, kind: str) -> None:
    """At once, or after the next command where not even the old end can be put back."""
    made = case(tmp_path, kind)
    sentences = []
    for limit in range(0, len(made.after) + 41, 41):
        log = made.put(tmp_path / str(limit))
        sentence = in_place_within(limit, log, made.new)
        sentences.append(sentence)
        if "could not be restored" in sentence:
            assert recover(log)
        wanted = made.before if sentence else made.after
        assert read_tree(log.parent) == {"log.mcap": wanted}
    assert "its end could not be saved" in sentences[0]
    assert any("could not be restored" in sentence for sentence in sentences)
    grows = len(made.after) > len(made.before)
    assert any("results could not be written" in sentence for sentence in sentences) == grows
    assert sentences[-1] == ""


def in_place_within(limit: int, log: Path, new: Results) -> str:
    """Annotate with a limit of sizes; the sentence of the error, "" when there is none."""
    with size_limit(limit):
        try:
            annotate_in_place(log, new)
        except LogError as error:
            return str(error)
    return ""


def test_a_log_that_cannot_be_restored_is_repaired_by_the_next_command(tmp_path: Path) -> None:
    """The disk takes not even the old end back: only the saved end is left, and it is enough."""
    made = case(tmp_path, "longer")
    log = made.put(tmp_path / "disk")
    real = os.pwrite
    failing = False

    def pwrite(handle: int, data: bytes, offset: int) -> int:
        nonlocal failing
        if failing or offset > 0:  # in the log; the saved end starts at 0
            if not failing:
                real(handle, data[:300], offset)
            failing = True
            raise OSError(28, "No space left on device")
        return real(handle, data, offset)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "pwrite", pwrite)
        with pytest.raises(LogError, match=r"could not be restored.*next command repairs it"):
            annotate_in_place(log, made.new)
    assert log.read_bytes() not in (made.before, made.after)
    assert recover(log)
    assert read_tree(log.parent) == {"log.mcap": made.before}


@pytest.mark.parametrize("mode", WRITERS)
@pytest.mark.parametrize("old", [None, b"older results"])
def test_a_new_file_that_does_not_fit_is_not_there(
    tmp_path: Path, mode: str, old: bytes | None
) -> None:
    log = tmp_path / "log.mcap"
    folder = tmp_path / "out"
    write_log(log)
    write_tree({} if old is None else {"out.mcap": old}, folder)
    before = read_tree(folder)
    output = folder / "out.mcap"
    WRITERS[mode](log, tmp_path / "whole.mcap", results())
    size = (tmp_path / "whole.mcap").stat().st_size
    for limit in range(0, size, 331):
        with size_limit(limit), pytest.raises(LogError, match="could not be written"):
            WRITERS[mode](log, output, results(), overwrite=True)
        assert read_tree(folder) == before
    with size_limit(size):
        WRITERS[mode](log, output, results(), overwrite=True)
    assert read_tree(folder) == {"out.mcap": (tmp_path / "whole.mcap").read_bytes()}


# -- again


def test_a_rerun_replaces_earlier_results_everywhere(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    output = tmp_path / "out.mcap"
    write_log(log)
    for write in (*WRITERS.values(), None):
        sizes = []
        for count in (3, 1, 2, 2):
            if write is None:
                report = annotate_in_place(log, results(count))
                made = log
            else:
                report = write(log, output, results(count), overwrite=True)
                made = output
            topics_read = topics(made)
            assert report.closures == topics_read.count("/semloc/loop_closures") == count
            assert (
                topics_read.count("/semloc/pose") == topics_read.count("/semloc/markers") == count
            )
            sizes.append(made.stat().st_size)
        assert sizes[1] < sizes[2] == sizes[3] < sizes[0]


def test_nobody_else_may_read_the_saved_tail(tmp_path: Path) -> None:
    """It holds what the log holds, and the log may be private."""
    made = case(tmp_path, "longer")
    log = made.put(tmp_path / "disk")
    log.chmod(0o600)
    disk = LossyDisk(log.parent)
    modes: dict[str, int] = {}

    def look() -> None:
        modes.update({p.name: p.stat().st_mode & 0o777 for p in log.parent.iterdir()})

    disk.visit = look
    with disk.watching():
        annotate_in_place(log, made.new)
    assert len(modes) == 3  # the log, the saved tail, and its temporary name
    assert set(modes.values()) == {0o600}


def test_a_saved_tail_of_another_file_is_not_put_back(tmp_path: Path) -> None:
    made = case(tmp_path, "longer")
    log = made.put(tmp_path / "disk")
    disk = LossyDisk(log.parent)
    disk.die_at = 4  # the log is partly written
    every_state(disk, lambda: annotate_in_place(log, made.new))
    assert (log.parent / "log.mcap.semloc-tail").exists()
    write_log(log, count=13)
    other = log.read_bytes()
    with pytest.raises(LogError, match="delete that file"):
        recover(log)
    assert log.read_bytes() == other


def test_two_writers(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    before = write_log(log)
    with locked(log), pytest.raises(LogError, match="another process"):
        annotate_in_place(log, results())
    assert read_tree(tmp_path) == {"log.mcap": before}

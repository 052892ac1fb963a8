"""Reading leaves no trace: the folder of a log stays as it is, to names, bytes and times; and what
lies in files beside an sqlite log is read.
"""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from semloc_logs.logs.annotation.annotate import (
    Results,
    annotate_copy,
    annotate_sidecar,
    content_fingerprint,
)
from semloc_logs.logs.containers.open import open_log
from semloc_logs.logs.containers.sqlite_file import overlay_of
from semloc_logs.logs.inspection.inspect import inspect_log
from semloc_logs.logs.problems import sentences

TYPE = "std_msgs/msg/String"
ROWS = 60  # messages, the second half of which is not in the file itself
Listing = dict[str, tuple[bytes, int, int]]


def payload(k: int) -> bytes:
    text = b"%03d" % k * 1000  # on several pages
    return b"\0\1\0\0" + (len(text) + 1).to_bytes(4, "little") + text + b"\0"


def listing(folder: Path) -> Listing:
    """Content, time of change and mode of every file, and of the folder."""
    files: Listing = {}
    for path in [folder, *folder.rglob("*")]:
        status = path.stat()
        content = path.read_bytes() if path.is_file() else b""
        files[str(path)] = (content, status.st_mtime_ns, status.st_mode)
    return files


def make(database: sqlite3.Connection) -> None:
    database.execute(
        "create table topics(id integer primary key, name text, type text, "
        "serialization_format text, offered_qos_profiles text)"
    )
    database.execute(
        "create table messages(id integer primary key, topic_id integer, timestamp integer, "
        "data blob)"
    )
    database.execute("insert into topics values(1, '/a', ?, 'cdr', '')", (TYPE,))


def insert(database: sqlite3.Connection, numbers: range) -> None:
    database.execute("begin")
    for k in numbers:
        database.execute(
            "insert into messages(topic_id, timestamp, data) values(1, ?, ?)", (k, payload(k))
        )
    database.execute("commit")


def wal(folder: Path, *, rest: str = "") -> Path:
    """A log of a recorder that was killed; its second half is in the -wal file only.

    ``rest``: "pending", an unfinished transaction follows; "torn", so that its last frame is cut
    off; "stale", an earlier use of the file left frames behind the last one.
    """
    live = folder / "live.db3"
    database = sqlite3.connect(live, isolation_level=None)
    database.execute("pragma journal_mode=wal")
    database.execute("pragma wal_autocheckpoint=0")
    make(database)
    if rest == "stale":
        insert(database, range(1000, 1100))
        database.execute("delete from messages")
        database.execute("pragma wal_checkpoint(restart)")  # the next frame is the first again
        insert(database, range(ROWS // 2))
    else:
        insert(database, range(ROWS // 2))
        database.execute("pragma wal_checkpoint(truncate)")
    if rest != "stale":
        insert(database, range(ROWS // 2, ROWS))
    if rest in ("pending", "torn"):
        database.execute("pragma cache_size=2")
        database.execute("begin")
        database.execute("delete from messages where id % 2")
        database.execute("update messages set data = zeroblob(9000)")
    path = folder / "log" / "drive.db3"
    path.parent.mkdir()
    for end in ("", "-wal"):
        Path(f"{path}{end}").write_bytes(Path(f"{live}{end}").read_bytes())
    if rest == "torn":
        os.truncate(f"{path}-wal", Path(f"{path}-wal").stat().st_size - 1000)
    database.close()
    return path


def expected(rest: str) -> list[tuple[int, bytes]]:
    return [(k, payload(k)) for k in range(ROWS // 2 if rest == "stale" else ROWS)]


@pytest.mark.parametrize("rest", ["", "pending", "torn", "stale"])
def test_messages_in_a_wal_file_are_read_and_nothing_is_written(tmp_path: Path, rest: str) -> None:
    path = wal(tmp_path, rest=rest)
    before = listing(path.parent)
    log = open_log(path)
    assert [(m.log_time_ns, bytes(m.data)) for m in log.messages()] == expected(rest)
    assert [s.count for s in log.streams] == [len(expected(rest))]
    assert sentences(log.problems) == []
    log.close()
    assert inspect_log(path)["end_ns"] == len(expected(rest)) - 1
    assert inspect_log(path.parent)["end_ns"] == len(expected(rest)) - 1
    assert listing(path.parent) == before


def test_a_wal_file_without_content_changes_nothing(tmp_path: Path) -> None:
    path = wal(tmp_path)
    for content in (b"", b"\0" * 5000, Path(f"{path}-wal").read_bytes()[:32]):
        Path(f"{path}-wal").write_bytes(content)
        before = listing(path.parent)
        log = open_log(path)
        assert len(list(log.messages())) == ROWS // 2
        log.close()
        assert listing(path.parent) == before


def test_a_wal_file_is_read_in_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    path = wal(tmp_path)
    for file in path.parent.iterdir():
        file.chmod(0o444)
    path.parent.chmod(0o555)
    before = listing(path.parent)
    assert len(list(open_log(path).messages())) == ROWS
    assert listing(path.parent) == before
    path.parent.chmod(0o755)


def test_only_the_places_of_pages_are_in_memory(tmp_path: Path) -> None:
    path = wal(tmp_path)
    overlay = overlay_of(path)
    assert overlay is not None
    size = Path(f"{path}-wal").stat().st_size
    assert 20 < len(overlay.pages) <= (size - 32) // (24 + overlay.page_size)
    assert overlay.page_count > max(overlay.pages) - 1


def test_an_unfinished_transaction_in_a_journal_is_taken_back(tmp_path: Path) -> None:
    folder = tmp_path / "log"
    folder.mkdir()
    path = folder / "drive.db3"
    database = sqlite3.connect(path, isolation_level=None)
    make(database)
    insert(database, range(ROWS))
    database.close()
    code = f"""
import os, sqlite3
database = sqlite3.connect({str(path)!r}, isolation_level=None)
database.execute("pragma cache_size=2")
database.execute("begin")
database.execute("update messages set data = zeroblob(3000)")
os._exit(0)
"""
    subprocess.run([sys.executable, "-c", code], check=True)
    assert Path(f"{path}-journal").stat().st_size > 512
    before = listing(folder)
    log = open_log(path)
    assert [(m.log_time_ns, bytes(m.data)) for m in log.messages()] == expected("")
    log.close()
    assert listing(folder) == before


def test_a_log_that_is_written_meanwhile_is_named(tmp_path: Path) -> None:
    path = wal(tmp_path)
    log = open_log(path)
    messages = log.messages()
    next(messages)
    with Path(f"{path}-wal").open("ab") as file:
        file.write(b"more")
    list(messages)
    [sentence] = sentences(log.problems)
    assert sentence.startswith("drive.db3 was written to while it was read")


def test_a_copy_with_results_has_the_messages_of_the_wal_file(tmp_path: Path) -> None:
    path = wal(tmp_path)
    before = listing(path.parent)
    report = annotate_copy(path, tmp_path / "out.mcap", Results([], "a", {}, {}))
    copied = [(m.log_time_ns, bytes(m.data)) for m in open_log(report.path).messages()]
    assert copied == expected("")
    assert listing(path.parent) == before


def test_the_content_of_a_log_includes_its_wal_file(tmp_path: Path) -> None:
    path = wal(tmp_path)
    whole = content_fingerprint(path)
    Path(f"{path}-shm").write_bytes(b"an index of the other")
    assert content_fingerprint(path) == whole
    assert content_fingerprint(path.parent) == content_fingerprint(path.parent)
    folder = content_fingerprint(path.parent)
    Path(f"{path}-shm").unlink()
    assert content_fingerprint(path.parent) == folder
    Path(f"{path}-wal").unlink()
    assert content_fingerprint(path) != whole


def container(folder: Path, kind: str) -> Path:
    """A small log of a kind, in a folder of its own."""
    folder.mkdir()
    if kind == "mcap":
        writer = Writer(str(folder / "x.mcap"))
        writer.start("ros2")
        schema = writer.register_schema(TYPE, "ros2msg", b"string data")
        channel = writer.register_channel("/a", "cdr", schema)
        for k in range(9):
            writer.add_message(channel, log_time=k, publish_time=k, data=payload(k))
        writer.finish()  # type: ignore[no-untyped-call]
        return folder / "x.mcap"
    if kind == "bag":
        with Writer1(folder / "x.bag") as bag1:
            connection = bag1.add_connection(
                "/a", TYPE, typestore=get_typestore(Stores.ROS1_NOETIC)
            )
            for k in range(9):
                bag1.write(connection, k, payload(k)[4:])
        return folder / "x.bag"
    storage = StoragePlugin.MCAP if kind == "folder of mcap" else StoragePlugin.SQLITE3
    with Writer2(folder / "x", version=8, storage_plugin=storage) as bag2:
        store = get_typestore(Stores.ROS2_HUMBLE)
        connection2 = bag2.add_connection("/a", TYPE, typestore=store)
        for k in range(9):
            bag2.write(connection2, k, payload(k))
    names = {"db3": "x/x.db3", "metadata": "x/metadata.yaml"}
    return folder / names.get(kind, "x")


@pytest.mark.parametrize(
    "kind", ["mcap", "bag", "folder", "folder of mcap", "db3", "metadata", "wal"]
)
def test_no_reader_leaves_a_trace(tmp_path: Path, kind: str) -> None:
    folder = tmp_path / "logs"
    if kind == "wal":
        folder.mkdir()
    path = wal(folder) if kind == "wal" else container(folder, kind)
    for file in folder.glob("live.db3*"):
        file.unlink()
    before = listing(folder)
    count = ROWS if kind == "wal" else 9
    log = open_log(path)
    assert len(list(log.messages())) == count
    assert len(list(log.frames())) == 0
    log.close()
    inspect_log(path)
    content_fingerprint(path)
    results = Results([], "a", {}, {})
    annotate_copy(path, tmp_path / "copy.mcap", results)
    annotate_sidecar(path, tmp_path / "sidecar.mcap", results)
    assert len(list(open_log(tmp_path / "copy.mcap").messages())) == count
    assert listing(folder) == before

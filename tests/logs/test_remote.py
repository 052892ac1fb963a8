"""Logs on servers: every container, dropped connections, results written back."""

from __future__ import annotations

import pickle
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from semloc_logs.errors import LogError, RemoteError
from semloc_logs.logs import remote
from semloc_logs.logs.annotation.annotate import (
    ClosureRecord,
    Results,
    annotate_copy,
    annotate_in_place,
    annotate_sidecar,
    content_fingerprint,
    recover,
)
from semloc_logs.logs.containers.open import open_log
from semloc_logs.logs.remote import BLOCK, RemotePath, log_path, uploading
from semloc_logs.stages.inputs import session_name
from tests.servers import Bucket, WebServer, s3_server, web_server

STORE = get_typestore(Stores.ROS2_HUMBLE)
TEXT = "std_msgs/msg/String"
COUNT = 60
RECORD = ClosureRecord(
    "drive", "b", 3, 5, 1, 2, 3, 0, 0, 0, 1, tuple(np.eye(6).ravel()), 0.8, 0.97, 100, 20,
    np.eye(4), np.arange(3.0),
)  # fmt: skip
RESULTS = Results([RECORD], "drive", {}, {})


@pytest.fixture
def web() -> Iterator[WebServer]:
    with web_server() as server:
        yield server


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bucket]:
    with s3_server(monkeypatch) as opened_bucket:
        yield opened_bucket


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote, "_PAUSE_S", 0.001)


def mcap(path: Path) -> Path:
    """Chunks of 100 kB that do not compress: more than a block and a half in all."""
    noise = np.random.default_rng(0)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=100_000, compression=CompressionType.NONE)
        writer.start("ros2")
        schema = writer.register_schema(TEXT, "ros2msg", b"string data")
        channel = writer.register_channel("/text", "cdr", schema)
        for k in range(COUNT):
            writer.add_message(channel, k + 1, noise.bytes(30_000), k + 1)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def bag(path: Path) -> Path:
    with Writer1(path) as writer:
        connection = writer.add_connection("/text", TEXT, typestore=STORE)
        for k in range(COUNT):
            message = STORE.types[TEXT](data=f"{k}" * 5000)
            writer.write(connection, k + 1, STORE.serialize_ros1(message, TEXT))
    return path


def folder(path: Path, plugin: StoragePlugin = StoragePlugin.SQLITE3) -> Path:
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/text", TEXT, typestore=STORE)
        for k in range(COUNT):
            message = STORE.types[TEXT](data=f"{k}" * 5000)
            writer.write(connection, k + 1, STORE.serialize_cdr(message, TEXT))
    return path


def content(log: Path | str) -> list[tuple[str, int, bytes]]:
    with closing(open_log(log)) as opened:
        messages = [(m.topic, m.log_time_ns, bytes(m.data)) for m in opened.messages()]
        assert opened.problems == []
    return messages


NAMES: dict[Callable[[Path], Path], str] = {mcap: "x.mcap", bag: "x.bag", folder: "x"}


# -- addresses


@pytest.mark.parametrize(
    ("url", "shown", "name"),
    [
        ("s3://b/night/x.mcap", "s3://b/night/x.mcap", "x"),
        ("S3://b/x.bag", "s3://b/x.bag", "x"),
        ("s3://b/a#1?.mcap", "s3://b/a#1?.mcap", "a#1?"),
        ("gs://b/x.db3", "gs://b/x.db3", "x"),
        ("https://user:word@h:8/x.mcap?token=a/b&c", "https://h:8/x.mcap", "x"),
    ],
)
def test_an_address_is_shown_as_given_without_its_secrets(url: str, shown: str, name: str) -> None:
    path = log_path(url)
    assert isinstance(path, RemotePath)
    assert (str(path), f"{path}", path.stem) == (shown, shown, name)
    assert path.url.partition("://")[2] == url.partition("://")[2], "the server gets all of it"
    for same in (log_path(path), path.absolute(), pickle.loads(pickle.dumps(path))):
        assert isinstance(same, RemotePath)
        assert (same, same.url) == (path, path.url)
    assert str(path.parent / "y.mcap") == f"{shown.rpartition('/')[0]}/y.mcap"
    assert path != log_path(f"{url}2")


@pytest.mark.parametrize("url", ["s3:///x.mcap", "https://", "s3://b//x.mcap", "ftp://h/x.mcap"])
def test_what_is_no_address_of_a_log(url: str) -> None:
    with pytest.raises(RemoteError, match="://"):
        log_path(url)


def test_local_logs_need_no_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recorder: Callable[..., Any]
) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("the network was used")

    log = mcap(tmp_path / "x.mcap")
    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    monkeypatch.setattr(remote, "_system", refuse)
    assert len(content(log)) == COUNT
    annotate_copy(log, tmp_path / "out.mcap", RESULTS)
    assert session_name(log) == "x"
    with pytest.raises(AssertionError, match="network"):
        content("https://127.0.0.1/x.mcap")


def test_without_the_extra_a_sentence_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: object) -> None:
        raise ImportError("no such module")

    monkeypatch.setattr(remote, "_system", missing)
    for url, extra in (("s3://b/x", "s3"), ("gs://b/x", "gs"), ("https://h/x", "http")):
        with pytest.raises(RemoteError, match=rf"pip install 'semloc_logs\[{extra}\]'"):
            open_log(url)


# -- reading


def test_a_log_is_read_in_ranges_and_only_what_is_wanted(tmp_path: Path, web: WebServer) -> None:
    log = mcap(tmp_path / "x.mcap")
    web.files["x.mcap"] = log.read_bytes()
    assert content(f"{web.url}/x.mcap") == content(log)
    ranges = [r for method, _, r in web.requests if method == "GET"]
    assert all(r.startswith("bytes=") for r in ranges)
    size = log.stat().st_size
    assert size > 1.5 * BLOCK
    web.requests.clear()
    with log_path(f"{web.url}/x.mcap").open("rb") as file:
        file.seek(size - 8)
        assert file.read() == log.read_bytes()[-8:]
    (last,) = (r for method, _, r in web.requests if method == "GET")
    assert last == f"bytes={size // BLOCK * BLOCK}-{size - 1}"


def test_every_container_on_an_s3_server(tmp_path: Path, bucket: Bucket) -> None:
    for log in (mcap(tmp_path / "x.mcap"), bag(tmp_path / "y.bag")):
        assert content(bucket.put(log.name, log)) == content(log)
    for plugin in StoragePlugin:
        local = folder(tmp_path / f"bag_{plugin.name}", plugin)
        for file in local.iterdir():
            bucket.put(f"{local.name}/{file.name}", file)
            if file.suffix == ".db3":
                assert content(f"{bucket.url}/{local.name}/{file.name}") == content(file)
        assert content(f"{bucket.url}/{local.name}") == content(local)
        assert content(f"{bucket.url}/{local.name}/metadata.yaml") == content(local)
        assert session_name(log_path(f"{bucket.url}/{local.name}/metadata.yaml")) == local.name


def test_a_database_with_a_write_ahead_log_beside_it(tmp_path: Path, bucket: Bucket) -> None:
    import apsw

    local = next(folder(tmp_path / "bag").glob("*.db3"))
    database = apsw.Connection(str(local))
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("UPDATE messages SET timestamp = timestamp + 1000")
    for file in (local, local.with_name(f"{local.name}-wal")):
        bucket.put(file.name, file)
    changed = content(f"{bucket.url}/{local.name}")
    assert [time_ns for _, time_ns, _ in changed] == [k + 1001 for k in range(COUNT)]
    database.close()


def test_a_folder_of_a_web_server_that_lists_none(tmp_path: Path, web: WebServer) -> None:
    local = folder(tmp_path / "bag")
    for file in local.iterdir():
        web.files[f"bag/{file.name}"] = file.read_bytes()
    address = log_path(f"{web.url}/bag/metadata.yaml")
    assert content(f"{web.url}/bag/metadata.yaml") == content(local)
    assert session_name(address) == "bag"
    fingerprint = content_fingerprint(address)
    assert content_fingerprint(address) == fingerprint
    web.files["bag/bag.db3"] += b"x"
    assert content_fingerprint(address) != fingerprint
    with pytest.raises(LogError, match="does not exist"):
        open_log(f"{web.url}/bag")


def test_an_address_is_sent_as_given_and_a_refusal_is_told(tmp_path: Path, web: WebServer) -> None:
    web.files["a b.mcap"] = web.files["a%20b.mcap"] = mcap(tmp_path / "x.mcap").read_bytes()
    for url in ("a b.mcap?sig=a%2Fb/c", "a%20b.mcap?sig=a%2Fb/c"):
        web.queries.clear()
        assert len(content(f"{web.url}/{url}")) == COUNT
        assert set(web.queries) == {"sig=a%2Fb/c"}
    web.password = "me:secret"
    with pytest.raises(LogError, match=r"x\.mcap cannot be opened: Permission denied\."):
        open_log(f"{web.url}/x.mcap")
    own = web.url.replace("://", "://me:secret@")
    assert len(content(f"{own}/a%20b.mcap")) == COUNT


def test_a_pattern_of_addresses(bucket: Bucket) -> None:
    from semloc_logs.cli.inputs import LogChoice, session_inputs

    for name in ("night/b.mcap", "night/a.mcap", "night/c.txt"):
        bucket.put(name, b"")
    choice = LogChoice((f"{bucket.url}/night/*.mcap",), None)
    logs = {s.name: [str(log) for log in s.logs] for s in session_inputs(choice.each())}
    assert logs == {n: [f"{bucket.url}/night/{n}.mcap"] for n in "ab"}


def test_what_is_missing_or_no_log_is_told_as_of_a_file(web: WebServer, bucket: Bucket) -> None:
    for url in (f"{web.url}/none.mcap", f"{bucket.url}/none.mcap", "s3://nobucket/x.mcap"):
        with pytest.raises(LogError, match=f"{url} does not exist"):
            open_log(url)
    web.files["x.mcap"] = b""
    with pytest.raises(LogError, match=r"x\.mcap is empty"):
        open_log(f"{web.url}/x.mcap")
    web.files["x.mcap"] = b"text" * 100
    with pytest.raises(LogError, match=r"x\.mcap is not a log"):
        open_log(f"{web.url}/x.mcap")


# -- connections that drop


def test_dropped_connections_are_tried_again(tmp_path: Path, web: WebServer) -> None:
    log = mcap(tmp_path / "x.mcap")
    web.files["x.mcap"] = log.read_bytes()
    web.drops = remote.TRIES - 1
    assert content(f"{web.url}/x.mcap") == content(log)
    assert web.drops == 0


@pytest.mark.parametrize("kind", [mcap, bag, folder])
def test_a_connection_lost_for_good_is_no_damage_of_the_log(
    kind: Callable[[Path], Path], tmp_path: Path, web: WebServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = kind(tmp_path / NAMES[kind])
    if log.is_dir():
        log = next(log.glob("*.db3"))
    web.files[log.name] = log.read_bytes()
    monkeypatch.setattr(remote, "BLOCK", 4096)  # so that something is left to read
    with closing(open_log(f"{web.url}/{log.name}")) as opened:
        web.drops = 1_000
        with pytest.raises(RemoteError, match=r"server failed 5 times in a row \(.+\); give"):
            list(opened.messages())
        assert opened.problems == []
    assert 1_000 - web.drops == remote.TRIES, "no further tries"


def test_no_server_at_all(unused_port: int) -> None:
    begun = time.monotonic()
    with pytest.raises(RemoteError, match=r"server failed 5 times in a row \(.*onnect"):
        open_log(f"http://127.0.0.1:{unused_port}/x.mcap")
    assert time.monotonic() - begun < 10


@pytest.fixture
def unused_port() -> int:
    pytest.importorskip("aiohttp", reason="the extra 'http' is missing")
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def test_a_server_without_ranges(tmp_path: Path, web: WebServer) -> None:
    web.files["x.mcap"] = mcap(tmp_path / "x.mcap").read_bytes()
    web.has_ranges = False
    with pytest.raises(RemoteError, match="whole files only"):
        open_log(f"{web.url}/x.mcap")


# -- what a session is made from


def test_the_fingerprint_changes_with_the_content(tmp_path: Path, web: WebServer) -> None:
    data = mcap(tmp_path / "x.mcap").read_bytes()
    path = log_path(f"{web.url}/x.mcap")

    def read() -> int:
        return sum(method == "GET" for method, _, _ in web.requests)

    for has_etags in (True, False):
        web.has_etags = has_etags
        web.requests.clear()
        web.files["x.mcap"] = data
        first = content_fingerprint(path)
        assert (read() == 0) == has_etags, "all is read only where it has to be"
        assert content_fingerprint(path) == first
        web.files["x.mcap"] = data[:1000] + bytes([data[1000] ^ 1]) + data[1001:]
        assert content_fingerprint(path) != first


# -- writing


def topics(data: bytes, tmp_path: Path) -> set[str]:
    copy = tmp_path / "read.mcap"
    copy.write_bytes(data)
    with copy.open("rb") as file:
        return {channel.topic for _, channel, _ in make_reader(file).iter_messages()}


@pytest.mark.parametrize("kind", [mcap, bag, folder])
def test_copies_and_sidecars_go_back_to_the_server(
    kind: Callable[[Path], Path], tmp_path: Path, bucket: Bucket
) -> None:
    log = kind(tmp_path / NAMES[kind])
    for file in [log] if log.is_file() else log.iterdir():
        bucket.put(str(file.relative_to(tmp_path)), file)
    source = log_path(f"{bucket.url}/{log.name}")
    before = sorted(p for p in tmp_path.rglob("*"))
    copy, sidecar = (log_path(f"{bucket.url}/out/{n}.mcap") for n in ("copy", "sidecar"))
    report = annotate_copy(source, copy, RESULTS)
    annotate_sidecar(source, sidecar, RESULTS)
    assert report.closures == 1
    assert sorted(p for p in tmp_path.rglob("*")) == before, "nothing on this disk"
    annotate_copy(log, tmp_path / "local.mcap", RESULTS)
    assert bucket.get("out/copy.mcap") == (tmp_path / "local.mcap").read_bytes()
    own = {"/semloc/loop_closures", "/semloc/pose", "/semloc/pose/b", "/semloc/markers"}
    written = topics(bucket.get("out/sidecar.mcap"), tmp_path)
    assert written
    assert written <= own | {"/tf", "/semloc/map"}
    assert "/text" in topics(bucket.get("out/copy.mcap"), tmp_path)
    with pytest.raises(LogError, match="exists already"):
        annotate_copy(source, copy, RESULTS)
    with pytest.raises(LogError, match="log itself"):
        annotate_copy(copy, copy, RESULTS)
    again = annotate_copy(copy, log_path(f"{bucket.url}/out/again.mcap"), RESULTS)
    assert again.replaced
    annotate_copy(source, copy, RESULTS, overwrite=True)
    assert bucket.unfinished() == []


def test_a_log_on_a_server_stays_as_it_is(tmp_path: Path, bucket: Bucket, web: WebServer) -> None:
    log = mcap(tmp_path / "x.mcap")
    source = log_path(bucket.put("x.mcap", log))
    with pytest.raises(LogError, match="cannot be changed in place"):
        annotate_in_place(source, RESULTS)
    assert not recover(source)
    assert bucket.names() == ["x.mcap"]
    with pytest.raises(RemoteError, match=r"go to a file, or to s3:// or gs://"):
        annotate_copy(log, log_path(f"{web.url}/out.mcap"), RESULTS)


def interrupted(path: RemotePath, block: bytes) -> None:
    with uploading(path) as file:
        for _ in range(20):
            file.write(block)
        raise KeyboardInterrupt


def test_an_upload_appears_whole_or_not_at_all(
    bucket: Bucket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote, "_HELD", 1 << 20)
    monkeypatch.setattr(remote, "_PART", 6 << 20)
    path = log_path(f"{bucket.url}/large.bin")
    assert isinstance(path, RemotePath)
    data = np.random.default_rng(0).bytes(20 << 20)
    with uploading(path) as file:
        for k in range(0, len(data), 1 << 20):
            file.write(data[k : k + (1 << 20)])
        file.seek(0)
        assert file.read(100) == data[:100]
        with pytest.raises(OSError, match="sent already"):
            file.seek(8 << 20) and file.read(100)
        file.seek(len(data) - 100)
        file.write(b"end")
        file.truncate()
    assert bucket.get("large.bin") == data[:-100] + b"end"
    with pytest.raises(KeyboardInterrupt):
        interrupted(path, data[: 1 << 20])
    assert bucket.get("large.bin") == data[:-100] + b"end", "the earlier one is kept"
    assert bucket.unfinished() == []
    missing = log_path("s3://nobucket/x.bin")
    assert isinstance(missing, RemotePath)
    with pytest.raises(RemoteError, match="could not be written"), uploading(missing) as file:
        file.write(data)

"""MCAP files, whole and damaged."""

from __future__ import annotations

import bz2
import json
import struct
import zlib
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from semloc_logs.errors import LogError
from semloc_logs.frames import PoseSample
from semloc_logs.logs.containers.base import decompress, in_log_time_order
from semloc_logs.logs.containers.mcap import McapLog
from semloc_logs.logs.containers.mcap_records import chunk_head, chunk_records, indexed_chunk
from semloc_logs.logs.containers.memory import Memory
from semloc_logs.logs.containers.open import open_log
from semloc_logs.logs.log import Definition, Message, Stream
from semloc_logs.logs.problems import sentences

ENTRIES = [
    ("/a", 10),
    ("/b", 20),
    ("/a", 30),
    ("/a", 25),
    ("/b", 40),
    ("/a", 35),
    ("/b", 50),
    ("/a", 60),
]


def pose(x: float) -> bytes:
    position = {"x": x, "y": 0, "z": 0}
    orientation = {"x": 0, "y": 0, "z": 0, "w": 1}
    stamp = {"sec": 1, "nsec": int(x)}
    return json.dumps(
        {
            "timestamp": stamp,
            "frame_id": "odom",
            "pose": {"position": position, "orientation": orientation},
        }
    ).encode()


def write(
    path: Path,
    entries: Iterable[tuple[str, int]] = ENTRIES,
    compression: CompressionType = CompressionType.ZSTD,
    chunk_size: int = 300,
    chunking: bool = True,
    repeat: bool = True,
    statistics: bool = True,
    index: IndexType = IndexType.ALL,
) -> Path:
    writer = Writer(
        str(path),
        chunk_size=chunk_size,
        compression=compression,
        use_chunking=chunking,
        repeat_channels=repeat,
        repeat_schemas=repeat,
        use_statistics=statistics,
        index_types=index,
    )
    writer.start()
    schema = writer.register_schema("foxglove.PoseInFrame", "jsonschema", b"{}")
    channels: dict[str, int] = {}
    for topic, time in entries:
        if topic not in channels:
            channels[topic] = writer.register_channel(topic, "json", schema)
        writer.add_message(channels[topic], log_time=time, publish_time=time, data=pose(time))
    writer.finish()  # type: ignore[no-untyped-call]
    return path


VARIANTS = {
    "indexed": {},
    "lz4": {"compression": CompressionType.LZ4},
    "plain": {"compression": CompressionType.NONE},
    "one chunk": {"chunk_size": 1 << 20},
    "unchunked": {"chunking": False},
    "no repeats": {"repeat": False},
    "no statistics": {"statistics": False},
    "no index": {"index": IndexType.NONE, "statistics": False, "repeat": False},
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_layout_reads_the_same_in_log_time_order(tmp_path: Path, variant: str) -> None:
    log = open_log(write(tmp_path / "x.mcap", **VARIANTS[variant]))  # type: ignore[arg-type]
    assert [(m.topic, m.log_time_ns) for m in log.messages()] == sorted(ENTRIES, key=lambda e: e[1])
    assert [m.log_time_ns for m in log.messages({"/b"})] == [20, 40, 50]
    assert log.streams == [
        Stream("/a", "foxglove.PoseInFrame", "json", 5),
        Stream("/b", "foxglove.PoseInFrame", "json", 3),
    ]
    assert (log.format, log.encoding, log.start_ns, log.end_ns) == ("mcap", "json", 10, 60)
    frames = list(log.frames(["/a"]))
    assert all(isinstance(f, PoseSample) for f in frames)
    assert [f.header.log_time_ns for f in frames] == [10, 25, 30, 35, 60]
    assert log.problems == []
    log.close()


def test_agrees_with_the_reader_of_the_format(tmp_path: Path) -> None:
    path = write(
        tmp_path / "x.mcap", [("/a" if k % 3 else "/b", (k * 37) % 101) for k in range(200)]
    )
    with path.open("rb") as file:
        theirs = [(c.topic, m.log_time, m.data) for _, c, m in make_reader(file).iter_messages()]
    ours = [(m.topic, m.log_time_ns, bytes(m.data)) for m in open_log(path).messages()]
    assert sorted(ours) == sorted(theirs)
    assert [m[1] for m in ours] == [m[1] for m in theirs]


@pytest.mark.parametrize("share", [0.2, 0.4, 0.6, 0.8, 0.99])
def test_a_truncated_file_gives_what_is_before_the_cut(tmp_path: Path, share: float) -> None:
    entries = [("/a", k) for k in range(100)]
    whole = write(tmp_path / "x.mcap", entries, compression=CompressionType.NONE).read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: int(len(whole) * share)])
    log = open_log(cut)
    times = [m.log_time_ns for m in log.messages()]
    assert times == list(range(len(times)))
    assert len(times) >= 100 * (share - 0.3)
    assert sum(s.count for s in log.streams) == len(times)
    assert len(log.problems) == 1
    assert "cut.mcap" in sentences(log.problems)[0]
    assert f"of {cut.stat().st_size}" in sentences(log.problems)[0]


def test_a_damaged_chunk_is_skipped_and_named(tmp_path: Path) -> None:
    path = write(
        tmp_path / "x.mcap", [("/a", k) for k in range(100)], compression=CompressionType.NONE
    )
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[1]
    data = bytearray(path.read_bytes())
    data[chunk.chunk_start_offset + 100] ^= 1
    path.write_bytes(data)
    log = open_log(path)
    lost = range(chunk.message_start_time, chunk.message_end_time + 1)
    assert [m.log_time_ns for m in log.messages()] == [k for k in range(100) if k not in lost]
    assert sentences(log.problems) == [
        f"x.mcap: the chunk at byte {chunk.chunk_start_offset} was skipped: its checksum does not"
        " match its data."
    ]


def test_a_damaged_index_is_named_and_not_used(tmp_path: Path) -> None:
    path = write(tmp_path / "x.mcap")
    data = bytearray(path.read_bytes())
    data[-60] ^= 1
    path.write_bytes(data)
    log = open_log(path)
    assert len(list(log.messages())) == len(ENTRIES)
    assert "does not match its checksum" in sentences(log.problems)[0]


def test_an_index_that_points_behind_the_file_is_not_used(tmp_path: Path) -> None:
    path = write(tmp_path / "x.mcap")
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    data = bytearray(path.read_bytes())
    start = int.from_bytes(data[-28:-20], "little")
    old = summary.chunk_indexes[0].chunk_start_offset.to_bytes(8, "little")
    offset = data.index(old, start)
    data[offset : offset + 8] = (1 << 60).to_bytes(8, "little")
    # a liar that knows how to count
    data[-12:-8] = zlib.crc32(bytes(data[start:-12])).to_bytes(4, "little")
    path.write_bytes(data)
    log = open_log(path)
    assert len(list(log.messages())) == len(ENTRIES)
    assert "is damaged" in sentences(log.problems)[0]


def test_kept_messages_stay_as_they_are(tmp_path: Path) -> None:
    entries = [(topic, 100 * k + time) for k in range(200) for topic, time in ENTRIES]
    log = McapLog(write(tmp_path / "a.mcap", entries))
    kept = list(log.messages())
    # the memory of a chunk lives as long as a message of it
    copies = [bytes(m.data) for m in log.messages()]
    assert [bytes(m.data) for m in kept] == copies
    assert copies == [pose(m.log_time_ns) for m in kept]
    log.close()


def test_records_of_an_uncompressed_chunk_are_not_copied() -> None:
    records = b"records"
    head = struct.pack("<QQQII", 1, 2, len(records), zlib.crc32(records), 0)
    body = head + struct.pack("<Q", len(records)) + records
    record = struct.pack("<BQ", 6, len(body)) + body
    view = chunk_records(record, chunk_head(record), Memory())
    assert isinstance(view, memoryview)
    assert bytes(view) == records
    assert view.obj is record
    # what follows the records does not stay in memory with them
    longer = struct.pack("<BQ", 6, len(body) + 1000) + body + bytes(1000)
    view = chunk_records(longer, chunk_head(longer), Memory())
    assert isinstance(view, memoryview)
    assert bytes(view) == records
    assert view.obj is not longer


def test_a_log_that_is_cut_off_while_it_is_read(tmp_path: Path) -> None:
    entries = [(topic, 100 * k + time) for k in range(2000) for topic, time in ENTRIES]
    path = write(tmp_path / "a.mcap", entries)
    log = McapLog(path)
    messages = log.messages()
    read = [next(messages)]
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size // 2)
    read += messages
    log.close()
    assert 1 < len(read) < len(entries)
    assert any("bytes could be read at byte" in text for text in sentences(log.problems))


def test_a_chunk_index_that_does_not_fit_is_refused() -> None:
    body = struct.pack("<QQQQI", 1, 2, 300, 400, 20) + struct.pack("<HQHQ", 7, 500, 9, 600)
    rest = struct.pack("<QI", 30, 4) + b"zstd" + struct.pack("<QQ", 100, 200)
    chunk = indexed_chunk(body + rest)
    assert chunk == (300, 400, 1, 2, frozenset({7, 9}))
    for damaged in (body[:30], body[:-1], body.replace(b"\x14\0\0\0", b"\x15\0\0\0") + rest):
        with pytest.raises(LogError, match="a chunk index cannot be parsed"):
            indexed_chunk(damaged)


def test_several_encodings_in_one_file(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    writer = Writer(str(path))
    writer.start("ros2")
    schema = writer.register_schema("foxglove.PoseInFrame", "jsonschema", b"{}")
    writer.add_message(
        writer.register_channel("/json", "json", schema), log_time=1, publish_time=1, data=pose(1)
    )
    schema = writer.register_schema("std_msgs/String", "ros1msg", b"string data")
    writer.add_message(
        writer.register_channel("/ros1", "ros1", schema),
        log_time=2,
        publish_time=2,
        data=b"\0\0\0\0",
    )
    writer.add_message(
        writer.register_channel("/raw", "", 0), log_time=3, publish_time=3, data=b"?"
    )
    schema = writer.register_schema("sensor_msgs/msg/Imu", "ros2msg", b"broken [")
    writer.add_message(
        writer.register_channel("/imu", "cdr", schema), log_time=4, publish_time=4, data=b"\0\1\0\0"
    )
    writer.finish()  # type: ignore[no-untyped-call]
    log = open_log(path)
    assert log.encoding == "ros2"
    assert [(s.topic, s.type, s.encoding) for s in log.streams] == [
        ("/imu", "sensor_msgs/msg/Imu", "cdr"),
        ("/json", "foxglove.PoseInFrame", "json"),
        ("/raw", "", ""),
        ("/ros1", "std_msgs/msg/String", "ros1"),
    ]
    assert [f.header.topic for f in log.frames()] == ["/json"]
    [sentence] = sentences(log.problems)
    assert sentence.startswith("/imu: 1 message skipped; ")


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r", b"not a log", b"\x89MCAP1\r\n"])
def test_what_is_no_mcap_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=r"x\.mcap"):
        McapLog(path)


def test_magic_alone_is_a_log_without_messages(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"\x89MCAP0\r\n")
    log = open_log(path)
    assert list(log.messages()) == []
    assert log.start_ns is None
    assert len(log.problems) == 1


def message(time: int, topic: str) -> Message:
    return Message(topic, "", "", time, b"", Definition("", "", b""))


@given(st.lists(st.lists(st.integers(0, 30), max_size=6), max_size=6), st.integers(0, 3))
def test_parts_merge_like_a_stable_sort(parts: list[list[int]], slack: int) -> None:
    opened: list[int] = []

    def part(k: int) -> Iterator[Message]:
        opened.append(k)
        yield from (message(t, f"{k}/{i}") for i, t in enumerate(sorted(parts[k])))

    starts = [min(p, default=0) - slack for p in parts]
    openers = [(start, partial(part, k)) for k, start in enumerate(starts)]
    merged = list(in_log_time_order(openers))
    expected = sorted(
        (message(t, f"{k}/{i}") for k, p in enumerate(parts) for i, t in enumerate(sorted(p))),
        key=lambda m: m.log_time_ns,
    )
    times = [m.log_time_ns for m in merged]
    assert times == [m.log_time_ns for m in expected]
    assert sorted(m.topic for m in merged) == sorted(m.topic for m in expected)
    assert sorted(opened) == list(range(len(parts)))


def test_parts_are_opened_only_when_due() -> None:
    opened = []

    def part(k: int) -> Iterator[Message]:
        opened.append(k)
        yield from (message(10 * k + i, "") for i in range(10))

    merged = in_log_time_order((10 * k, lambda k=k: iter(part(k))) for k in range(5))  # type: ignore[misc]
    assert all(len(opened) == m.log_time_ns // 10 + 1 for m in merged)


@pytest.mark.parametrize("compression", ["zstd", "lz4", "bz2"])
def test_decompression_believes_no_claim(compression: str) -> None:
    pack = {
        "zstd": zstandard.ZstdCompressor().compress,
        "lz4": lz4.frame.compress,
        "bz2": bz2.compress,
    }[compression]
    memory = Memory(64 << 20)
    for content in (b"", b"abc", bytes(10_000_000)):
        packed = pack(content)
        assert decompress(packed, compression, len(content), memory) == content
        for wrong in (len(content) + 1, len(content) - 1, 1 << 40):
            if wrong >= 0:
                with pytest.raises(LogError):
                    decompress(packed, compression, wrong, memory)
    with pytest.raises(LogError):
        decompress(b"garbage", compression, 7, memory)
    with pytest.raises(LogError):
        decompress(pack(bytes(range(256)) * 4)[:200], compression, 1024, memory)

"""Hostile sizes: small files that claim or hold much. Memory stays within logs.memory."""

from __future__ import annotations

import bz2
import json
import struct
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import lz4.frame
import pytest
import zstandard

from semloc_logs.errors import LogError
from semloc_logs.logs.containers.chunks import LARGE
from semloc_logs.logs.containers.memory import Memory
from semloc_logs.logs.containers.open import open_log
from semloc_logs.logs.problems import sentences

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/status").exists(), reason="the peak of memory is read there"
)
MIB = 1 << 20
MAGIC = b"\x89MCAP0\r\n"
LIMIT = 256 * MIB
# beside the log: the interpreter's share of the system's pages, buffers of decompressors
CONSTANT = 64 * MIB


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


DEFINITIONS = record(
    3, struct.pack("<H", 1) + text("std_msgs/msg/String") + text("ros2msg") + text("string data")
) + record(4, struct.pack("<HH", 1, 1) + text("/a") + text("cdr") + struct.pack("<I", 0))


def message(time: int, data: bytes) -> bytes:
    return record(5, struct.pack("<HIQQ", 1, 0, time, time) + data)


def chunk(times: Sequence[int], data: Callable[[int], bytes], claim: int | None = None) -> bytes:
    """A chunk record with a message for each time."""
    content = DEFINITIONS + b"".join(message(t, data(t)) for t in times)
    packed = zstandard.ZstdCompressor().compress(content)
    size = len(content) if claim is None else claim
    head = struct.pack("<QQQI", min(times), max(times), size, 0) + text("zstd")
    return record(6, head + struct.pack("<Q", len(packed)) + packed)


def mcap(path: Path, chunks: Sequence[bytes], *, is_closed: bool = True) -> Path:
    """A file of whole chunks; the index of a closed one lists them."""
    content = bytearray(MAGIC + record(1, text("ros2") + text("")))
    summary = DEFINITIONS
    for entry in chunks:
        start, end, size, _ = struct.unpack_from("<QQQI", entry, 9)
        places = struct.pack("<QQQQ", start, end, len(content), len(entry))
        offsets = struct.pack("<IHQ", 10, 1, 0)
        sizes = struct.pack("<Q", 0) + text("zstd") + struct.pack("<QQ", len(entry), size)
        summary += record(8, places + offsets + sizes)
        content += entry
    if is_closed:
        content += record(15, struct.pack("<I", 0))
        counts = struct.pack("<QHIIIIQQ", 1, 1, 1, 0, 0, len(chunks), 0, 9)
        summary += record(11, counts + struct.pack("<IHQ", 10, 1, 1))
        start = len(content)
        content += summary + record(2, struct.pack("<QQI", start, 0, 0)) + MAGIC
    path.write_bytes(content)
    return path


READ = """
import json, re, sys
from semloc_logs.logs.containers.open import open_log

def peak():
    # of this program; ru_maxrss counts what its parent had, too
    return 1024 * int(re.search(r"VmHWM:\\s+(\\d+) kB", open("/proc/self/status").read())[1])

before = peak()
log = open_log(sys.argv[1], int(sys.argv[2]))
times = [(m.topic, m.log_time_ns, len(m.data)) for m in log.messages()]
print(json.dumps([times, [p.text for p in log.problems], peak() - before]))
"""


def read(path: Path, limit: int = LIMIT) -> tuple[list[list[object]], list[str], int]:
    """(topic, time, size) of all messages, the problems, bytes by which the peak of memory grew."""
    command = [sys.executable, "-c", READ, str(path), str(limit)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    messages, problems, grown = json.loads(done.stdout)
    return messages, problems, grown


@pytest.mark.parametrize("is_closed", [True, False])
def test_large_chunks_at_equal_times_are_read_one_after_the_other(
    tmp_path: Path, is_closed: bool
) -> None:
    """20 x 48 MiB in 35 kB: each has one message at the same time."""
    entry = chunk([7], lambda _: bytes(48 * MIB))
    path = mcap(tmp_path / "x.mcap", [entry] * 20, is_closed=is_closed)
    assert path.stat().st_size < 50_000
    messages, problems, grown = read(path)
    assert messages == [["/a", 7, 48 * MIB]] * 20
    assert len(problems) == (not is_closed)
    assert grown < LIMIT + CONSTANT


def test_many_overlapping_chunks_are_read_in_order_within_the_limit(tmp_path: Path) -> None:
    """60 chunks of 12 MiB cover the same times: together they are three times the limit."""
    entries = [chunk([k, 100 + k, 200 + k], lambda _: bytes(4 * MIB)) for k in range(60)]
    messages, problems, grown = read(mcap(tmp_path / "x.mcap", entries))
    assert [m[1] for m in messages] == [t + k for t in (0, 100, 200) for k in range(60)]
    assert problems == []
    assert grown < LIMIT + CONSTANT


def test_sections_of_large_chunks_give_messages_with_their_publishers(tmp_path: Path) -> None:
    """A chunk that is read in two batches, of a topic with two channels."""
    second = record(4, struct.pack("<HH", 2, 1) + text("/a") + text("cdr") + struct.pack("<I", 0))
    content = DEFINITIONS + second
    for time in range(29):
        head = struct.pack("<HIQQ", 1 + time % 2, 0, time, time)
        content += record(5, head + bytes(2 * MIB))
    packed = zstandard.ZstdCompressor().compress(content)
    head = struct.pack("<QQQI", 0, 28, len(content), 0) + text("zstd")
    entry = record(6, head + struct.pack("<Q", len(packed)) + packed)
    assert len(content) > LARGE
    log = open_log(mcap(tmp_path / "x.mcap", [entry], is_closed=False), LIMIT)
    expected = [(time, f"channel {1 + time % 2}") for time in range(29)]
    assert [(m.log_time_ns, m.publisher) for m in log.messages()] == expected
    [section] = log.sections()
    assert [(m.log_time_ns, m.publisher) for m in section.messages(["/a"])] == expected
    assert list(section.messages(["/b"])) == []
    log.close()


def test_tiny_messages_do_not_grow_in_memory(tmp_path: Path) -> None:
    """A message of 31 bytes would be 300 as an object, and there are a million."""
    times = list(range(1_000_000))
    entry = chunk(times, lambda _: b"")
    path = mcap(tmp_path / "x.mcap", [entry])
    count = READ.replace("[(m.topic, m.log_time_ns, len(m.data)) for m in log.messages()]", "COUNT")
    count = count.replace("COUNT", "sum(1 for m in log.messages())")
    done = subprocess.run(
        [sys.executable, "-c", count, str(path), str(LIMIT)],
        capture_output=True,
        text=True,
        check=True,
    )
    counted, problems, grown = json.loads(done.stdout)
    assert (counted, problems) == (1_000_000, [])
    assert grown < LIMIT // 2 + CONSTANT


@pytest.mark.parametrize("is_closed", [True, False])
def test_a_chunk_beyond_the_limit_is_named_and_the_others_are_read(
    tmp_path: Path, is_closed: bool
) -> None:
    entries = [chunk([k], lambda _, k=k: bytes(100 * MIB if k == 1 else 9)) for k in range(3)]  # type: ignore[misc]
    path = mcap(tmp_path / "x.mcap", entries, is_closed=is_closed)
    messages, problems, grown = read(path)
    assert [m[1:] for m in messages] == [[0, 9], [2, 9]]
    assert "at byte" in problems[0]
    assert f"at most {LIMIT // 4} are read at once" in problems[0]
    assert "set logs.memory to 4" in problems[0]
    assert grown < CONSTANT
    assert len(read(path, 4 * LIMIT)[0]) == 3


@pytest.mark.parametrize("claim", [1 << 40, 1 << 62, 1 << 63, (1 << 64) - 1])
@pytest.mark.parametrize("is_closed", [True, False])
def test_impossible_claims_are_named(tmp_path: Path, claim: int, is_closed: bool) -> None:
    entries = [chunk([1], lambda _: b"x"), chunk([2], lambda _: b"x", claim)]
    messages, problems, grown = read(mcap(tmp_path / "x.mcap", entries, is_closed=is_closed))
    assert messages == [["/a", 1, 1]]
    assert f"claims {claim} bytes" in problems[0]
    assert grown < CONSTANT


@pytest.mark.parametrize("claim", [1 << 62, (1 << 63) - 1, 1 << 63, (1 << 64) - 1])
@pytest.mark.parametrize("place", [0, 8, 16, 24])
def test_impossible_places_in_the_index_are_named(tmp_path: Path, claim: int, place: int) -> None:
    """Start, end, offset and length of the chunk in the index."""
    path = mcap(tmp_path / "x.mcap", [chunk([5], lambda _: b"x")])
    content = bytearray(path.read_bytes())
    index = content.rindex(b"\x08" + struct.pack("<Q", 8 * 4 + 14 + 8 + 8 + 16)) + 9
    content[index + place : index + place + 8] = struct.pack("<Q", claim)
    path.write_bytes(content)
    log = open_log(path, LIMIT)
    assert [m.log_time_ns for m in log.messages()] == [5]
    assert bool(log.problems) == (place >= 16)


def bag(path: Path, compression: str, content: bytes) -> Path:
    """A ROS 1 bag that was not closed, with one message of ``content`` in a chunk."""

    def fields(**values: bytes) -> bytes:
        parts = [name.encode() + b"=" + value for name, value in values.items()]
        joined = b"".join(struct.pack("<I", len(part)) + part for part in parts)
        return struct.pack("<I", len(joined)) + joined

    def entry(head: bytes, data: bytes) -> bytes:
        return head + struct.pack("<I", len(data)) + data

    number = struct.pack("<I", 0)
    about = fields(topic=b"/a", type=b"std_msgs/String", md5sum=b"*", message_definition=b"")[4:]
    inner = entry(fields(op=b"\x07", conn=number, topic=b"/a"), about)
    inner += entry(fields(op=b"\x02", conn=number, time=struct.pack("<II", 1, 0)), content)
    packed = {"bz2": bz2.compress, "lz4": lz4.frame.compress}[compression](inner)
    size = struct.pack("<I", len(inner))
    head = fields(op=b"\x03", index_pos=bytes(8), conn_count=number, chunk_count=number)
    whole = b"#ROSBAG V2.0\n" + entry(head, b" " * 100)
    whole += entry(fields(op=b"\x05", compression=compression.encode(), size=size), packed)
    path.write_bytes(whole)
    return path


@pytest.mark.parametrize("compression", ["bz2", "lz4"])
def test_chunks_of_ros1_bags_are_bounded(tmp_path: Path, compression: str) -> None:
    path = bag(tmp_path / "x.bag", compression, bytes(100 * MIB))
    messages, problems, grown = read(path)
    assert messages == []
    assert f"at most {LIMIT // 4} are read at once" in problems[0]
    assert grown < CONSTANT
    messages, _, _ = read(path, 4 * LIMIT)
    assert [m[1:] for m in messages] == [[1_000_000_000, 100 * MIB]]


def test_a_file_that_grows_without_measure_is_not_unpacked(tmp_path: Path) -> None:
    """3 GB of zeros in 100 kB, as a file of a ROS 2 bag."""
    packer = zstandard.ZstdCompressor().compressobj()
    piece = bytes(64 * MIB)
    packed = b"".join([*(packer.compress(piece) for _ in range(48)), packer.flush()])
    (tmp_path / "x.db3.zstd").write_bytes(packed)
    with pytest.raises(LogError, match=r"grows from .* bytes, which no log does"):
        open_log(tmp_path, LIMIT)


def test_definitions_are_bounded(tmp_path: Path) -> None:
    """40 schemas of 1 MiB, in 40 chunks of some hundred bytes."""
    entries = []
    for k in range(40):
        schema = record(3, struct.pack("<H", 2 + k) + text("x") + text("") + text(" " * MIB))
        content = schema + DEFINITIONS + message(k, b"x")
        packed = zstandard.ZstdCompressor().compress(content)
        head = struct.pack("<QQQI", k, k, len(content), 0) + text("zstd")
        entries.append(record(6, head + struct.pack("<Q", len(packed)) + packed))
    log = open_log(mcap(tmp_path / "x.mcap", entries, is_closed=False), LIMIT)
    assert any(f"take more than {LIMIT // 16} bytes" in p for p in sentences(log.problems))
    assert len(list(log.messages())) >= 15


def test_memory_counts_what_is_alive() -> None:
    memory = Memory(LIMIT)
    view = memory.counted(bytes(1000))
    part = view[10:20]
    with memory.held(5):
        assert memory.used == 1005
    del view
    assert memory.used == 1000
    del part
    assert memory.used == 0
    assert LARGE < LIMIT

"""ROS 1 and ROS 2 bags, whole and damaged, written by an independent writer."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path
from typing import Any

import pytest
import zstandard
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from semloc_logs.errors import LogError
from semloc_logs.frames import PoseSample
from semloc_logs.logs.containers.open import open_log
from semloc_logs.logs.log import Log, Stream
from semloc_logs.logs.problems import sentences

POSE = "geometry_msgs/msg/PoseStamped"
STORE1 = get_typestore(Stores.ROS1_NOETIC)
STORE2 = get_typestore(Stores.ROS2_HUMBLE)


def pose(store: Any, x: float) -> Any:
    t = store.types
    head = {"seq": 0} if store is STORE1 else {}
    header = t["std_msgs/msg/Header"](
        stamp=t["builtin_interfaces/msg/Time"](sec=1, nanosec=2), frame_id="odom", **head
    )
    position = t["geometry_msgs/msg/Point"](x=x, y=0.0, z=0.0)
    orientation = t["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    return t[POSE](
        header=header, pose=t["geometry_msgs/msg/Pose"](position=position, orientation=orientation)
    )


def bag1(path: Path, times: list[int], compression: Any = None, chunk: int = 400) -> Path:
    writer = Writer1(path)
    writer.chunk_threshold = chunk
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connections = [
            writer.add_connection(topic, POSE, typestore=STORE1) for topic in ("/a", "/b")
        ]
        for k, time in enumerate(times):
            writer.write(connections[k % 2], time, STORE1.serialize_ros1(pose(STORE1, time), POSE))
    return path


def bag2(
    path: Path, times: list[int], plugin: Any = StoragePlugin.SQLITE3, mode: Any = None
) -> Path:
    writer = Writer2(path, version=8, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = [
            writer.add_connection(topic, POSE, typestore=STORE2) for topic in ("/a", "/b")
        ]
        for k, time in enumerate(times):
            writer.write(connections[k % 2], time, STORE2.serialize_cdr(pose(STORE2, time), POSE))
    return path


def check(log: Log, times: list[int], encoding: str) -> None:
    """The whole content of a log of ``times``."""
    assert [m.log_time_ns for m in log.messages()] == sorted(times)
    assert [m.log_time_ns for m in log.messages(["/b"])] == sorted(times[1::2])
    frames = list(log.frames())
    assert all(isinstance(f, PoseSample) for f in frames)
    assert [f.frame_T_child[0, 3] for f in frames if isinstance(f, PoseSample)] == sorted(times)
    assert (log.start_ns, log.end_ns) == (min(times), max(times))
    counts = len(times) - len(times) // 2, len(times) // 2
    assert log.streams == [
        Stream("/a", POSE, encoding, counts[0]),
        Stream("/b", POSE, encoding, counts[1]),
    ]


TIMES = [1000 + 7 * k for k in range(30)]
SHUFFLED = [1000 + (37 * k) % 101 for k in range(60)]  # chunks overlap completely


@pytest.mark.parametrize(
    "compression", [None, Writer1.CompressionFormat.BZ2, Writer1.CompressionFormat.LZ4]
)
@pytest.mark.parametrize("times", [TIMES, SHUFFLED])
def test_ros1(tmp_path: Path, compression: Any, times: list[int]) -> None:
    log = open_log(bag1(tmp_path / "x.bag", times, compression))
    check(log, times, "ros1")
    assert (log.format, log.encoding) == ("rosbag1", "ros1")
    assert log.problems == []


def test_ros1_without_its_index(tmp_path: Path) -> None:
    path = bag1(tmp_path / "x.bag", TIMES)
    data = path.read_bytes()
    start = data.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(data[:start] + bytes(8) + data[start + 8 :])
    log = open_log(path)
    check(log, TIMES, "ros1")
    assert "was not closed" in sentences(log.problems)[0]


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_ros1_truncated(tmp_path: Path, share: float) -> None:
    data = bag1(tmp_path / "x.bag", TIMES).read_bytes()
    path = tmp_path / "cut.bag"
    path.write_bytes(data[: int(len(data) * share)])
    log = open_log(path)
    times = [m.log_time_ns for m in log.messages()]
    assert times == TIMES[: len(times)]
    assert sum(s.count for s in log.streams) == len(times)
    assert any("cut.bag" in p and f"of {path.stat().st_size}" in p for p in sentences(log.problems))


def test_ros1_with_a_damaged_chunk(tmp_path: Path) -> None:
    path = bag1(tmp_path / "x.bag", TIMES, Writer1.CompressionFormat.BZ2)
    data = bytearray(path.read_bytes())
    second = data.index(b"BZh", data.index(b"BZh") + 3)
    data[second : second + 4] = b"????"
    path.write_bytes(data)
    log = open_log(path)
    assert 0 < len(list(log.messages())) < len(TIMES)
    [sentence] = sentences(log.problems)
    assert sentence.startswith("x.bag: the chunk at byte ")


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
@pytest.mark.parametrize("mode", [None, CompressionMode.FILE, CompressionMode.MESSAGE])
def test_ros2(tmp_path: Path, plugin: Any, mode: Any) -> None:
    if plugin is StoragePlugin.MCAP and mode is CompressionMode.MESSAGE:
        pytest.skip("rosbag2 compresses messages in sqlite3 bags only")
    path = bag2(tmp_path / "x", TIMES, plugin, mode)
    log = open_log(path)
    check(log, TIMES, "cdr")
    assert (log.format, log.encoding, log.problems) == ("rosbag2", "ros2", [])
    log.close()
    check(open_log(path / "metadata.yaml"), TIMES, "cdr")
    (path / "metadata.yaml").unlink()
    check(open_log(path), TIMES, "cdr")


def split_bag(tmp_path: Path) -> Path:
    """Three files of one bag, and a metadata.yaml that names only what it should."""
    folder = tmp_path / "split"
    for k in range(3):
        part = bag2(tmp_path / f"part{k}", TIMES[10 * k : 10 * k + 10])
        folder.mkdir(exist_ok=True)
        shutil.copy(part / f"part{k}.db3", folder / f"split_{k}.db3")
    listed = ", ".join(f"elsewhere/split_{k}.db3" for k in range(3))
    information = f"storage_identifier: sqlite3, message_count: 30, relative_file_paths: [{listed}]"
    (folder / "metadata.yaml").write_text(
        f"rosbag2_bagfile_information: {{version: 5, {information}}}\n"
    )
    return folder


def test_split_bags_with_and_without_metadata(tmp_path: Path) -> None:
    folder = split_bag(tmp_path)
    log = open_log(folder)
    check(log, TIMES, "cdr")
    assert log.problems == []
    (folder / "metadata.yaml").unlink()
    log = open_log(folder)
    check(log, TIMES, "cdr")
    assert log.problems == []


def test_missing_and_unlisted_files_are_named(tmp_path: Path) -> None:
    folder = split_bag(tmp_path)
    (folder / "split_1.db3").rename(folder / "other_7.db3")
    log = open_log(folder)
    assert [m.log_time_ns for m in log.messages()] == TIMES[:10] + TIMES[20:]
    assert any("split_1.db3 is missing" in p for p in sentences(log.problems))
    assert any("other_7.db3 was not read" in p for p in sentences(log.problems))
    assert any("claims 30 messages, but the files hold 20" in p for p in sentences(log.problems))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[",
        "a: b",
        "rosbag2_bagfile_information: 3",
        "x: &a [*a]",
        "- " * 3000,
        "\0",
        "a: &a {b: 1}\nc: {<<: [*a, *a]}",
    ],
)
def test_unusable_metadata_does_not_matter(tmp_path: Path, text: str) -> None:
    folder = bag2(tmp_path / "x", TIMES)
    (folder / "metadata.yaml").write_text(text)
    log = open_log(folder)
    check(log, TIMES, "cdr")
    assert len(log.problems) == 1
    assert "metadata.yaml" in sentences(log.problems)[0]


def test_a_damaged_split_leaves_the_others(tmp_path: Path) -> None:
    folder = split_bag(tmp_path)
    (folder / "split_0.db3").write_bytes(b"nothing")
    log = open_log(folder)
    assert [m.log_time_ns for m in log.messages()] == TIMES[10:]
    assert any("split_0.db3" in p for p in sentences(log.problems))


def test_a_damaged_message_is_skipped_alone(tmp_path: Path) -> None:
    folder = bag2(tmp_path / "x", TIMES)
    with sqlite3.connect(folder / "x.db3") as database:
        packed = zstandard.ZstdCompressor().compress(b"x" * 100)[:-4]
        database.execute("UPDATE messages SET data = ? WHERE id = 3", (packed,))
        database.execute("UPDATE messages SET data = ? WHERE id = 4", ("text",))
        database.execute("UPDATE messages SET data = ? WHERE id = 5", (b"\0\1\0\0",))
    log = open_log(folder)
    assert len(list(log.frames())) == len(TIMES) - 3
    assert len(list(log.frames())) == len(TIMES) - 3
    assert sorted(p[:22] for p in sentences(log.problems)) == ["/a: 1 message skipped;"] * 2 + [
        "/b: 1 message skipped;"
    ]


def test_times_of_another_type_are_skipped(tmp_path: Path) -> None:
    folder = bag2(tmp_path / "x", TIMES)
    with sqlite3.connect(folder / "x.db3") as database:
        database.execute("UPDATE messages SET timestamp = 'noon' WHERE id = 30")
    log = open_log(folder)
    assert [m.log_time_ns for m in log.messages()] == TIMES[:-1]
    assert (log.start_ns, log.end_ns) == (TIMES[0], TIMES[-2])


def test_undefined_types_are_named(tmp_path: Path) -> None:
    folder = bag2(tmp_path / "x", TIMES)
    with sqlite3.connect(folder / "x.db3") as database:
        database.execute("UPDATE topics SET type = 'foo_msgs/msg/Bar' WHERE name = '/b'")
        database.execute("DELETE FROM message_definitions")
    log = open_log(folder / "x.db3")
    assert len(list(log.frames())) == 15
    assert sentences(log.problems) == [
        "/b: messages of type foo_msgs/msg/Bar cannot be decoded because the log "
        "does not define the type."
    ]


def test_a_truncated_sqlite_file_is_refused_clearly(tmp_path: Path) -> None:
    path = bag2(tmp_path / "x", TIMES) / "x.db3"
    path.write_bytes(path.read_bytes()[:9000])
    with pytest.raises(LogError, match="is cut off: it has 9000 of"):
        open_log(path)


def test_other_sqlite_files_and_empty_folders_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE something (id INTEGER)")
    with pytest.raises(LogError, match="no tables topics and messages"):
        open_log(path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(LogError, match="holds no"):
        open_log(tmp_path / "empty")

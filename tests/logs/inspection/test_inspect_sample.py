"""Inspection of logs that are too large to be read: by their index, with a sample of the poses."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as BagWriter

from semloc_logs.logs.containers.mcap import McapLog
from semloc_logs.logs.containers.open import open_log
from semloc_logs.logs.inspection import excerpt
from semloc_logs.logs.inspection.inspect import inspect_log
from semloc_logs.numerics.transforms import yaw_transform

S = 1_000_000_000
SECONDS = 200
START = S  # a stamp of 0 is a missing one
XYZ = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])


def cloud(count: int = 100, seed: int = 1) -> np.ndarray[Any, Any]:
    """Points within a cube of 80 m."""
    points = np.random.default_rng(seed).uniform(-40, 40, (count, 3)).astype("<f4")
    return points.view(XYZ)[:, 0]


def drive(log: Any, *, late: bool = False) -> Path:
    """200 s at 1 m/s: a LIDAR at 1 Hz, odometry at 10 Hz; ``late``: a second LIDAR at the end."""
    log.transform("base_link", "lidar", yaw_transform(0.0, (0.0, 0.0, 2.0)), START)
    for k in range(SECONDS):
        log.cloud("/points", START + k * S, "lidar", cloud(), late_ns=0)
    for k in range(SECONDS * 10 + 1):
        log.pose(START + k * S // 10, yaw_transform(0.0, (k / 10, 0.0, 0.0)))
    if late:
        log.cloud("/late/points", START + (SECONDS - 1) * S, "lidar", cloud(seed=2), late_ns=1)
    path: Path = log.write()
    return path


def in_small_chunks(path: Path, *, chunk_size: int = 4096) -> Path:
    """The same MCAP with chunks of so many bytes."""
    out = path.with_name("small_chunks.mcap")
    with path.open("rb") as source, out.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_size)
        writer.start("ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            if channel.id not in channels:
                assert schema is not None
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number
                )
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time
            )
        writer.finish()  # type: ignore[no-untyped-call]
    return out


def as_sqlite(path: Path) -> Path:
    """The same messages in a ``.db3`` file of rosbag2."""
    out = path.with_suffix(".db3")
    with path.open("rb") as source, sqlite3.connect(out) as database:
        database.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT,"
            " serialization_format TEXT, offered_qos_profiles TEXT)"
        )
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
            " data BLOB)"
        )
        database.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
        for schema, channel, message in make_reader(source).iter_messages():
            assert schema is not None
            database.execute(
                "INSERT OR IGNORE INTO topics VALUES (?, ?, ?, 'cdr', '')",
                (channel.id, channel.topic, schema.name),
            )
            database.execute(
                "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)",
                (channel.id, message.log_time, message.data),
            )
    return out


@pytest.fixture
def large(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every log counts as large, and sections are small."""
    monkeypatch.setattr(excerpt, "WHOLE_BYTES", 0)
    monkeypatch.setattr("semloc_logs.logs.containers.sqlite._SECTION_BYTES", 4096)


@pytest.fixture(params=["mcap", "rosbag1", "sqlite"])
def log(request: Any, recorder: Any, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The drive in each container, in many sections."""
    if request.param == "rosbag1":
        monkeypatch.setattr(BagWriter, "chunk_threshold", 4096, raising=False)
        init = BagWriter.__init__

        def with_small_chunks(self: Any, path: Path) -> None:
            init(self, path)
            self.chunk_threshold = 4096

        monkeypatch.setattr(BagWriter, "__init__", with_small_chunks)
        return drive(recorder("ros1"))
    path = in_small_chunks(drive(recorder()))
    return path if request.param == "mcap" else as_sqlite(path)


def test_a_large_log_is_read_by_its_index(large: None, log: Path) -> None:
    quick: Any = inspect_log(log)
    full: Any = inspect_log(log, full=True)
    assert [s["count"] for s in quick["streams"]] == [s["count"] for s in full["streams"]]
    assert (quick["complete"], full["complete"]) == (False, True)
    assert (quick["base_frame"], quick["session_frame"]) == ("base_link", "odom")
    assert quick["sensors"] == full["sensors"]
    assert full["poses"]["count"] == SECONDS * 10 + 1
    assert quick["poses"]["count"] < full["poses"]["count"] // 2
    # a straight drive is as long as the way between its samples
    assert full["poses"]["length_m"] == pytest.approx(SECONDS)
    assert quick["poses"]["length_m"] == pytest.approx(SECONDS, abs=1.0)
    assert quick["poses"]["gaps"] is None
    assert full["poses"]["gaps"] == []
    assert quick["unknown"]
    assert full["unknown"] == []
    assert "at least 200.0 m" in quick["verdict"]
    assert quick["problems"] == full["problems"] == []


def test_sections_hold_each_message_once(large: None, log: Path) -> None:
    opened = open_log(log)
    try:
        whole = [(m.topic, m.log_time_ns) for m in opened.messages()]
        sections = opened.sections()
        parts = [(m.topic, m.log_time_ns) for s in sections for m in s.messages(None)]
        poses = [m.log_time_ns for s in sections for m in s.messages({"/odom"})]
        for section in sections:
            times = [m.log_time_ns for m in section.messages(None)]
            assert section.start_ns <= min(times)
            assert max(times) <= section.end_ns
    finally:
        opened.close()
    assert len(sections) > 2 * excerpt.MOST_SAMPLES
    assert sorted(parts) == sorted(whole)
    assert sorted(poses) == [START + k * S // 10 for k in range(SECONDS * 10 + 1)]


def test_few_chunks_are_read(large: None, recorder: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    path = in_small_chunks(drive(recorder(), late=True))
    read: list[int] = []
    unpack = McapLog._unpack_chunk

    def unpack_and_count(self: McapLog, offset: int, size: int) -> Any:
        read.append(offset)
        return unpack(self, offset, size)

    monkeypatch.setattr(McapLog, "_unpack_chunk", unpack_and_count)
    content: Any = inspect_log(path)
    # the first message of a LIDAR that starts at the very end is found through the index
    assert set(content["sensors"]) == {"/points", "/late/points"}
    assert len(read) == len(set(read)) <= excerpt.MOST_SAMPLES + 2


def test_a_sensor_that_is_not_found_in_time_is_named(
    large: None, recorder: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(excerpt, "_SEARCH_BYTES", 1)
    path = as_sqlite(drive(recorder(), late=True))
    content: Any = inspect_log(path)
    assert any("/late/points" in sentence for sentence in content["unknown"])
    assert "/late/points" not in content["sensors"]
    assert "/late/points" in inspect_log(path, full=True)["sensors"]  # type: ignore[operator]


def test_damage_outside_of_the_sample_is_left_to_full(large: None, recorder: Any) -> None:
    path = in_small_chunks(drive(recorder()))
    opened = open_log(path)
    chunk = opened.sections()[2]
    opened.close()
    data = bytearray(path.read_bytes())
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    offset = next(
        i.chunk_start_offset
        for i in summary.chunk_indexes
        if i.message_start_time == chunk.start_ns
    )
    data[offset + 80 : offset + 120] = bytes(40)
    path.write_bytes(data)
    quick: Any = inspect_log(path)
    full: Any = inspect_log(path, full=True)
    assert quick["skipped"] == []
    assert any("damaged" in sentence for sentence in quick["unknown"])
    assert full["skipped"]


def test_poses_in_tf_are_all_remembered(recorder: Any) -> None:
    log = recorder()
    log.transform("base_link", "lidar", np.eye(4), 0)
    for k in range(SECONDS):
        log.cloud("/points", k * S, "lidar", cloud(), late_ns=0)
    for k in range(SECONDS * 10 + 1):
        log.transform(
            "odom", "base_link", yaw_transform(0.0, (k / 10, 0.0, 0.0)), k * S // 10, "/tf"
        )
    content: Any = inspect_log(log.write())
    assert content["poses"]["count"] == SECONDS * 10 + 1
    assert content["poses"]["length_m"] == pytest.approx(SECONDS)

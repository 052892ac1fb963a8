"""Annotating logs of every container, and what other readers make of the result."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag1
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from semloc_logs.errors import LogError
from semloc_logs.logs.annotation.annotate import (
    AnnotateReport,
    ClosureRecord,
    Results,
    annotate_copy,
    annotate_in_place,
    annotate_sidecar,
    content_fingerprint,
    recover,
)
from semloc_logs.logs.annotation.scene import Cloud, Scene

TEXT = "std_msgs/msg/String"


def closure(query: str = "a", target: str = "b") -> ClosureRecord:
    covariance = tuple((np.eye(6) * 0.01).ravel())
    return ClosureRecord(
        query,
        target,
        3,
        5,
        1,
        2,
        3,
        0,
        0,
        0,
        1,
        covariance,
        0.8,
        0.97,
        100,
        20,
        np.eye(4),
        np.arange(3.0),
    )


def bag1(path: Path) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer1(path) as writer:
        for topic in ("/one", "/two"):
            connection = writer.add_connection(topic, TEXT, typestore=store)
            for k in range(5):
                writer.write(
                    connection,
                    100 + k,
                    store.serialize_ros1(store.types[TEXT](data=f"{topic} {k}"), TEXT),
                )
    return path


def bag2(folder: Path, plugin: StoragePlugin = StoragePlugin.SQLITE3) -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer2(folder, version=8, storage_plugin=plugin) as writer:
        for topic in ("/one", "/two"):
            connection = writer.add_connection(topic, TEXT, typestore=store)
            for k in range(5):
                writer.write(
                    connection,
                    100 + k,
                    store.serialize_cdr(store.types[TEXT](data=f"{topic} {k}"), TEXT),
                )
    return folder


def mcap_messages(path: Path) -> list[tuple[str, int, bytes]]:
    with path.open("rb") as file:
        return sorted(
            (c.topic, m.log_time, bytes(m.data))
            for _, c, m in make_reader(file, validate_crcs=True).iter_messages()
        )


def bag_messages(reader: Any) -> list[tuple[str, int, bytes]]:
    with reader:
        return sorted(
            (c.topic, t, bytes(data)) for c, t, data in reader.messages(reader.connections)
        )


def logs(tmp_path: Path) -> dict[str, tuple[Path, Any]]:
    one = bag1(tmp_path / "one.bag")
    folder = bag2(tmp_path / "two")
    db3 = tmp_path / "three.db3"
    shutil.copyfile(folder / "two.db3", db3)
    bare = tmp_path / "bare"
    bare.mkdir()
    shutil.copyfile(db3, bare / "bare_0.db3")
    mcap = bag2(tmp_path / "four", StoragePlugin.MCAP)
    return {
        "bag": (one, Reader1(one)),
        "folder": (folder, Reader2(folder)),
        "metadata.yaml": (folder / "metadata.yaml", Reader2(folder)),
        "db3": (db3, Reader2(db3)),
        "folder without metadata": (bare, Reader2(db3)),
        "folder of mcap": (mcap, Reader2(mcap)),
    }


@pytest.mark.parametrize(
    "kind", ["bag", "folder", "metadata.yaml", "db3", "folder without metadata", "folder of mcap"]
)
def test_bags_get_a_converted_copy_or_a_sidecar(tmp_path: Path, kind: str) -> None:
    log, reader = logs(tmp_path)[kind]
    before = content_fingerprint(log)
    copy = tmp_path / "copy.mcap"
    side = tmp_path / "side.mcap"
    report = annotate_copy(log, copy, Results([closure()], "a", {}, log_times={3: 102}))
    annotate_sidecar(log, side, Results([closure()], "a", {}, log_times={3: 102}))
    ours = mcap_messages(side)
    assert [m[:2] for m in ours] == [
        ("/semloc/loop_closures", 102),
        ("/semloc/markers", 102),
        ("/semloc/pose", 102),
        ("/semloc/pose/b", 102),
    ]
    assert mcap_messages(copy) == sorted(bag_messages(reader) + ours)
    assert content_fingerprint(log) == before
    profile = "ros1" if kind == "bag" else "ros2"
    for path in (copy, side):
        with path.open("rb") as file:
            assert make_reader(file).get_header().profile == profile == report.encoding
    if profile == "ros2":
        for path, count in ((copy, 14), (side, 4)):
            with AnyReader([path]) as any_reader:
                read = [
                    any_reader.deserialize(raw, c.msgtype) for c, _, raw in any_reader.messages()
                ]
            assert len(read) == count
    with pytest.raises(LogError, match="sidecar"):
        annotate_in_place(log, Results([closure()], "a", {}, log_times={}))
    # the copy is an MCAP log like any other
    again = annotate_in_place(copy, Results([closure()], "a", {}, log_times={3: 102}))
    assert again.replaced


def test_a_bag_gets_a_copy_that_is_a_bag(tmp_path: Path) -> None:
    log = bag1(tmp_path / "one.bag")
    copy = tmp_path / "copy.bag"
    cloud = Cloud(
        "odom", np.ones((2, 3), np.float32), np.ones((2, 3), np.uint8), np.zeros(2, np.uint8)
    )
    results = Results([closure()], "a", {}, log_times={3: 102}, scene=Scene(cloud=cloud))
    report = annotate_copy(log, copy, results)
    assert (report.path, report.encoding, report.closures) == (copy, "ros1", 1)
    side = tmp_path / "side.mcap"
    annotate_sidecar(log, side, results)
    ours = mcap_messages(side)
    assert len(ours) == report.messages == 5
    assert bag_messages(Reader1(copy)) == sorted(bag_messages(Reader1(log)) + ours)

    store = get_typestore(Stores.ROS1_NOETIC)
    with Reader1(copy) as reader:
        for connection in reader.connections:
            if connection.topic == "/semloc/map":
                assert isinstance(connection.ext, ConnectionExtRosbag1)
                assert connection.ext.latching == 1
            if connection.msgtype in store.types:  # the sums by which ROS knows definitions
                expected = store.generate_msgdef(connection.msgtype, ros_version=1)[1]
                assert connection.digest == expected
        times = [time for _, time, _ in reader.messages()]
    assert times == sorted(times)
    with AnyReader([copy]) as any_reader:
        read: list[Any] = [
            any_reader.deserialize(raw, c.msgtype)
            for c, _, raw in any_reader.messages()
            if c.topic == "/semloc/loop_closures"
        ]
    (closure_read,) = read
    assert (closure_read.query_session, closure_read.target_session, closure_read.t_x) == (
        "a",
        "b",
        1.0,
    )

    # a copy of the copy replaces the results
    again = annotate_copy(copy, tmp_path / "again.bag", results)
    assert (again.replaced, again.messages) == (True, 5)
    assert bag_messages(Reader1(tmp_path / "again.bag")) == bag_messages(Reader1(copy))
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "again.bag", "copy.bag", "one.bag", "side.mcap",
    ]  # fmt: skip


def test_other_logs_get_no_bag(tmp_path: Path) -> None:
    log = bag2(tmp_path / "two")
    with pytest.raises(LogError, match=r"only a local copy of a \.bag log"):
        annotate_copy(log, tmp_path / "out.bag", Results([], "a", {}, log_times={}))
    assert not (tmp_path / "out.bag").exists()


def test_qos_of_the_log_is_kept(tmp_path: Path) -> None:
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    never = QosTime(2147483647, 4294967295)
    qos = Qos(
        QosHistory.KEEP_LAST,
        7,
        QosReliability.RELIABLE,
        QosDurability.VOLATILE,
        never,
        never,
        QosLiveliness.AUTOMATIC,
        never,
        False,
    )
    store = get_typestore(Stores.ROS2_HUMBLE)
    folder = tmp_path / "log"
    with Writer2(folder, version=8) as writer:
        connection = writer.add_connection(
            "/one", TEXT, typestore=store, offered_qos_profiles=[qos]
        )
        writer.write(connection, 1, store.serialize_cdr(store.types[TEXT](data="x"), TEXT))
    first = tmp_path / "first.mcap"
    second = tmp_path / "second.mcap"
    annotate_copy(folder, first, Results([closure()], "a", {}, log_times={}))
    annotate_copy(first, second, Results([closure()], "a", {}, log_times={}))
    assert first.read_bytes() == second.read_bytes()
    with Reader2(second) as reader:
        profiles_of = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}  # type: ignore[union-attr]
    ours = ["/semloc/loop_closures", "/semloc/markers", "/semloc/pose", "/semloc/pose/b"]
    assert sorted(profiles_of) == ["/one", *ours]
    assert all(profiles == [qos] for profiles in profiles_of.values())


def test_markers_are_defined_as_in_the_log(tmp_path: Path) -> None:
    """A reader that knows one definition of a type reads the log's own markers and ours."""
    store = get_typestore(Stores.ROS2_FOXY)
    kind = "visualization_msgs/msg/MarkerArray"
    with Writer2(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/theirs", kind, typestore=store)
        writer.write(connection, 1, store.serialize_cdr(store.types[kind](markers=[]), kind))
    log = tmp_path / "bag" / "bag.mcap"
    out = tmp_path / "out.mcap"
    for source in (log, tmp_path / "bag"):
        annotate_copy(source, out, Results([closure()], "a", {}, log_times={}), overwrite=True)
        with AnyReader([out]) as reader:
            definitions = {c.msgdef.data for c in reader.connections if c.msgtype == kind}
            assert len(definitions) == 1
            ((c, _, raw),) = reader.messages(
                [c for c in reader.connections if c.topic == "/semloc/markers"]
            )
            message: Any = reader.deserialize(raw, c.msgtype)
        assert [m.text for m in message.markers] == ["", "b 0.97"]


def test_output_is_not_overwritten_unless_asked(tmp_path: Path) -> None:
    log = bag1(tmp_path / "log.bag")
    out = tmp_path / "out.mcap"
    out.write_bytes(b"precious")
    for annotate in (annotate_copy, annotate_sidecar):
        with pytest.raises(LogError, match="exists already"):
            annotate(log, out, Results([closure()], "a", {}, log_times={}))
        assert out.read_bytes() == b"precious"
        with pytest.raises(LogError, match="is the log itself"):
            annotate(log, log, Results([closure()], "a", {}, log_times={}), overwrite=True)
        assert isinstance(
            annotate(log, out, Results([closure()], "a", {}, log_times={}), overwrite=True),
            AnnotateReport,
        )
        out.write_bytes(b"precious")


def test_missing_and_foreign_files(tmp_path: Path) -> None:
    text = tmp_path / "text.bag"
    out = tmp_path / "out.mcap"
    text.write_bytes(b"#ROSBAG V2.0\nnot really")
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty.db3").write_bytes(b"")
    for log in (
        text,
        tmp_path / "empty",
        tmp_path / "empty.db3",
        tmp_path / "nothing.mcap",
        tmp_path / "nothing.bag",
    ):
        for annotate in (annotate_copy, annotate_sidecar):
            with pytest.raises(LogError):
                annotate(log, out, Results([closure()], "a", {}, log_times={}))
        with pytest.raises(LogError):
            annotate_in_place(log, Results([closure()], "a", {}, log_times={}))
        assert not recover(log)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty", "empty.db3", "text.bag"]


def test_a_bag_cut_off_in_the_middle_leaves_nothing(tmp_path: Path) -> None:
    log = bag1(tmp_path / "log.bag")
    log.write_bytes(log.read_bytes()[:-200])
    with pytest.raises(LogError, match="reindex"):
        annotate_copy(log, tmp_path / "out.mcap", Results([closure()], "a", {}, log_times={}))
    assert [p.name for p in tmp_path.iterdir()] == ["log.bag"]


def test_a_log_that_is_cut_off_still_gets_a_sidecar(tmp_path: Path) -> None:
    log = annotate_copy(
        bag2(tmp_path / "bag"), tmp_path / "log.mcap", Results([], "a", {}, log_times={})
    ).path
    log.write_bytes(log.read_bytes()[:-40])
    report = annotate_sidecar(
        log, tmp_path / "side.mcap", Results([closure()], "a", {}, log_times={})
    )
    assert (report.encoding, report.closures) == ("ros2", 1)
    with AnyReader([tmp_path / "side.mcap"]) as reader:
        assert reader.message_count == 4


@pytest.mark.parametrize(
    ("profile", "encodings", "expected"),
    [
        ("", ["json", "protobuf", "protobuf"], "protobuf"),
        ("", ["json", "json", "protobuf"], "json"),
        ("", ["cdr"], "ros2"),
        ("ros1", ["ros1"], "ros1"),
        ("ros2", [], "ros2"),
        ("", ["cbor", "protobuf"], "protobuf"),
        ("", [], "json"),
    ],
)
def test_the_encoding_is_that_of_the_log(
    tmp_path: Path, profile: str, encodings: list[str], expected: str
) -> None:
    log = tmp_path / "log.mcap"
    with log.open("wb") as file:
        writer = Writer(file)
        writer.start(profile, "test")
        for k, encoding in enumerate(encodings):
            writer.add_message(writer.register_channel(f"/{k}", encoding, 0), 1, b"", 1)
        writer.finish()  # type: ignore[no-untyped-call]
    assert (
        annotate_copy(
            log, tmp_path / "out.mcap", Results([closure()], "a", {}, log_times={})
        ).encoding
        == expected
    )


def test_metadata_record(tmp_path: Path) -> None:
    log = annotate_copy(
        bag2(tmp_path / "bag"), tmp_path / "log.mcap", Results([], "a", {}, log_times={})
    ).path
    size = log.stat().st_size
    report = annotate_in_place(
        log, Results([closure()], "a", {"fusion.voxel_size": "0.1"}, log_times={})
    )
    with log.open("rb") as file:
        (metadata,) = make_reader(file).iter_metadata()
    assert metadata.name == f"semloc/{report.run_id}"
    assert metadata.metadata["setting.fusion.voxel_size"] == "0.1"
    assert metadata.metadata["session"] == "a"
    assert 0 < int(metadata.metadata["start"]) < size
    with AnyReader([log]) as reader:
        connections = [c for c in reader.connections if c.topic == "/semloc/markers"]
        ((c, _, raw),) = reader.messages(connections)
        assert reader.deserialize(raw, c.msgtype).markers[0].scale.x == pytest.approx(1 / 3)  # type: ignore[attr-defined]


def test_fingerprint_sees_content(tmp_path: Path) -> None:
    folder = bag2(tmp_path / "log")
    first = content_fingerprint(folder)
    assert content_fingerprint(folder / "metadata.yaml") == first
    data = bytearray((folder / "log.db3").read_bytes())
    data[-1] ^= 1
    (folder / "log.db3").write_bytes(data)
    assert content_fingerprint(folder) != first


@pytest.mark.parametrize(
    "name",
    [
        "kitti00_000052.mcap",
        "room_a.mcap",
        "room_b",
        "../odd_logs/nav2_turtlebot.mcap",
        "../odd_logs/ros2_utm_drive_a",
    ],
)
def test_real_ros2_logs(shared: Callable[[str], Path], tmp_path: Path, name: str) -> None:
    log = shared(f"logs/{name}")
    from mcap_ros2.decoder import DecoderFactory

    out = tmp_path / "out.mcap"
    annotate_copy(
        log, out, Results([closure(), closure("b", "a")], "a", {}, log_times={}, frame_id="odom")
    )
    with Reader2(log) as original:
        expected = original.message_count
    with AnyReader([out]) as reader:
        assert reader.message_count == expected + 6
        connections = [c for c in reader.connections if c.topic.startswith("/semloc/")]
        assert (
            len([reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(connections)])
            == 6
        )
    with out.open("rb") as file:
        decoded = list(
            make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages(
                topics=["/semloc/loop_closures"]
            )
        )
    assert [d.decoded_message.words for d in decoded] == [20, 20]

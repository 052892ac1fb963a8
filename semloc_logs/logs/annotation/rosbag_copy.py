"""ROS bags that are not MCAP files: facts for a writer of new channels, and copies of them."""

from __future__ import annotations

import contextlib
import os
import stat
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from mcap.writer import CompressionType, Writer
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2.metadata import dump_qos_v8
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from semloc_logs.errors import LogError, SemlocError
from semloc_logs.logs.annotation.channels import (
    LATCHING_KEY,
    QOS_KEY,
    LogFacts,
    NewChannel,
    NewMessage,
    is_old_marker,
)
from semloc_logs.logs.containers import sqlite_file
from semloc_logs.logs.containers.base import unpack_whole
from semloc_logs.logs.containers.memory import DEFAULT, Memory
from semloc_logs.logs.containers.open import open_log
from semloc_logs.logs.messages.type_names import ros2_type
from semloc_logs.logs.remote import is_remote

CALLER = "/semloc"  # of our connections in a ROS 1 bag


class _Sqlite(Sqlite3Reader):
    """With the messages that lie in a file beside it."""

    def __init__(self, path: Any) -> None:
        overlay = sqlite_file.overlay_of(path)
        is_plain = overlay is None and not is_remote(path)
        whole: Any = path if is_plain else _Whole(path, overlay)
        super().__init__(whole)


class _Whole:
    """A file with the pages beside it, as rosbags takes files that are not on this disk."""

    def __init__(self, path: Path, overlay: sqlite_file.Overlay | None) -> None:
        self._path, self._overlay = path, overlay

    def __str__(self) -> str:
        return str(self._path)

    def open(self, mode: str) -> _WholeFile:
        return _WholeFile(sqlite_file.OverlaidFile(self._path, self._overlay))

    def stat(self) -> os.stat_result:
        status = list(self._path.stat())
        if self._overlay is not None:
            status[stat.ST_SIZE] = self._overlay.page_count * self._overlay.page_size
        return os.stat_result(status)


class _WholeFile:
    def __init__(self, file: sqlite_file.OverlaidFile) -> None:
        self._file = file
        self._position = 0

    def seek(self, offset: int) -> None:
        self._position = offset

    def read(self, size: int) -> bytes:
        return self._file.xRead(size, self._position)

    def close(self) -> None:
        self._file.xClose()


class _Folder(DirectoryReader):
    def __init__(self, path: Any) -> None:
        super().__init__(path)
        self.STORAGE_PLUGINS = {**DirectoryReader.STORAGE_PLUGINS, "sqlite3": _Sqlite}


class _Ros2(Reader2):
    def __init__(self, path: Path) -> None:
        self.STORAGE_PLUGINS = {**Reader2.STORAGE_PLUGINS, "dir": _Folder, ".db3": _Sqlite}
        super().__init__(path)


@contextlib.contextmanager
def opened(log: Path, memory: int = DEFAULT) -> Iterator[Sequence[Any]]:
    """Open rosbags readers of a .bag, a .db3, or a ROS 2 bag folder.

    Of a folder without metadata.yaml: readers of the .db3 or .mcap files in it.
    """
    open_log(log, memory).close()  # a log that is too large for memory ends here
    with contextlib.ExitStack() as stack:
        with _told(log):
            readers = [stack.enter_context(r) for r in _readers(log)]
        yield readers


def bag_facts(log: Path, readers: Sequence[Any]) -> LogFacts:
    """Encoding, QoS and time range of an open bag."""
    with _told(log):
        used = [r for r in readers if r.message_count]
        start = min((r.start_time for r in used), default=0)
        end = max((r.end_time - 1 for r in used), default=0)
        ros1 = isinstance(readers[0], Reader1)
        profiles = (
            []
            if ros1
            else [dump_qos_v8(c.ext.offered_qos_profiles) for r in readers for c in r.connections]
        )
    metadata = {} if ros1 else {QOS_KEY: next(filter(None, profiles), "")}
    name = "ros1" if ros1 else "ros2"
    old_markers = not ros1 and any(
        is_old_marker(c.msgtype, c.msgdef.data.encode())
        for r in readers
        for c in r.connections
        if c.msgdef.data
    )
    return LogFacts(
        "ros1" if ros1 else "ros2",
        name,
        metadata,
        start,
        end,
        sum(r.message_count for r in readers),
        old_markers,
    )


def write_copy(
    log: Path, readers: Sequence[Any], file: BinaryIO, library: str, memory: int = DEFAULT
) -> int:
    """Write every message of an open bag as it is to an MCAP file; returns their number.

    At most ``memory`` bytes of the bag are in memory at once. Raises ``LogError`` when fewer
    messages come out than the bag counts.
    """
    ros1 = isinstance(readers[0], Reader1)
    writer = Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start("ros1" if ros1 else "ros2", library)
    schemas: dict[tuple[str, str, str], int] = {}
    written = 0
    by_kind: dict[tuple[str, str, str], int] = {}
    for reader in readers:
        channels: dict[int, int] = {}
        for connection in reader.connections:
            schema = _schema(connection, ros1)
            if schema not in schemas:
                schemas[schema] = writer.register_schema(schema[0], schema[1], schema[2].encode())
            encoding, metadata = _channel(connection, ros1)
            channels[connection.id] = writer.register_channel(
                connection.topic, encoding, schemas[schema], metadata
            )
            if not ros1:
                kind = (connection.topic, ros2_type(connection.msgtype), encoding)
                by_kind.setdefault(kind, channels[connection.id])
        if ros1:
            for connection, time, data in _guarded(log, reader, Memory(memory)):
                writer.add_message(channels[connection.id], max(0, time), bytes(data), max(0, time))
                written += 1
    if not ros1:
        written = _copy_messages(log, memory, by_kind, writer)
    expected = sum(r.message_count for r in readers)
    if written != expected:
        raise LogError(
            f"{log} holds {expected} messages but only {written} could be read; "
            "repair it with `rosbag reindex` or `ros2 bag reindex`."
        )
    writer.finish()  # type: ignore[no-untyped-call]
    return written


def write_bag(
    log: Path,
    readers: Sequence[Any],
    output: Path,
    added: tuple[Sequence[NewChannel], Sequence[NewMessage]],
    memory: int = DEFAULT,
) -> None:
    """Write every message of a ROS 1 bag, and the ``added`` ones, as a ROS 1 bag.

    ``output`` must not exist. Connections of an earlier annotation are left out. Messages are in
    the order of their receive times, the added ones behind recorded ones of the same time.
    """
    reader = readers[0]
    channels, messages = added
    with Writer1(output) as writer:
        connections = {}
        written: dict[tuple[Any, ...], Any] = {}
        for connection in reader.connections:
            if connection.ext.callerid == CALLER:
                continue
            name, _, text = _schema(connection, True)
            key = (connection.topic, name, text, connection.ext.callerid, connection.ext.latching)
            if key not in written:
                written[key] = writer.add_connection(
                    connection.topic,
                    connection.msgtype,
                    msgdef=text,
                    md5sum=connection.digest,
                    callerid=connection.ext.callerid,
                    latching=connection.ext.latching,
                )
            connections[connection.id] = written[key]
        own = [_added_connection(writer, channel) for channel in channels]
        waiting = deque(messages)
        for connection, time, data in _guarded(log, reader, Memory(memory)):
            while waiting and waiting[0].log_time_ns < time:
                message = waiting.popleft()
                writer.write(own[message.channel], message.log_time_ns, message.data)
            if connection.id in connections:
                writer.write(connections[connection.id], max(0, time), bytes(data))
        for message in waiting:
            writer.write(own[message.channel], message.log_time_ns, message.data)


def _added_connection(writer: Writer1, channel: NewChannel) -> Any:
    name = channel.schema_name.replace("/", "/msg/")
    text = channel.schema_data.decode()
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, name))
    return writer.add_connection(
        channel.topic,
        name,
        msgdef=text,
        md5sum=store.generate_msgdef(name, ros_version=1)[1],
        callerid=CALLER,
        latching=1 if LATCHING_KEY in channel.metadata else None,
    )


def _readers(log: Path) -> list[Any]:
    if log.suffix == ".bag":
        return [Reader1(log)]
    folder = log.parent if log.name == "metadata.yaml" else log
    if not folder.is_dir():
        return [_Ros2(log)]
    if (folder / "metadata.yaml").exists():
        return [_Ros2(folder)]
    files = sorted(f for f in folder.iterdir() if f.suffix in (".db3", ".mcap"))
    if not files:
        raise LogError(
            f"{folder} holds no ROS 2 bag: neither metadata.yaml nor .db3 or .mcap files; "
            "give the folder of a bag."
        )
    return [_Ros2(f) for f in files]


def _copy_messages(
    log: Path, memory: int, channels: dict[tuple[str, str, str], int], writer: Writer
) -> int:
    """Writes the messages of a ROS 2 bag, whose topics have one channel each; their number."""
    written = 0
    with contextlib.closing(open_log(log, memory)) as source:
        for message in source.messages():
            channel = channels.get((message.topic, message.type, message.encoding))
            if channel is not None:
                time = max(0, message.log_time_ns)
                writer.add_message(channel, time, bytes(message.data), time)
                written += 1
    return written


def _guarded(log: Path, reader: Any, memory: Memory) -> Iterator[tuple[Any, int, bytes]]:
    """The messages of a ROS 1 reader, with one kind of error; errors of their writer pass by."""

    def bounded(data: bytes) -> bytes:
        return bytes(unpack_whole(data, memory))

    reader.chunks = {
        start: chunk._replace(decompressor=bounded) for start, chunk in reader.chunks.items()
    }
    with _told(log):
        messages = reader.messages(reader.connections) if reader.connections else iter(())
    while True:
        with _told(log):
            item = next(messages, None)
        if item is None:
            return
        yield item


@contextlib.contextmanager
def _told(log: Path) -> Iterator[None]:
    """Whatever the library raises on a damaged bag becomes a LogError.

    The errors are of many types, AssertionError among them.
    """
    try:
        yield
    except SemlocError:
        raise
    except Exception as error:
        raise LogError(
            f"{log} cannot be read as a bag ({type(error).__name__}: {error}); "
            "repair it with `rosbag reindex` or `ros2 bag reindex`."
        ) from error


def _schema(connection: Any, ros1: bool) -> tuple[str, str, str]:
    """Name, encoding and text of a connection's definition.

    A ROS 2 type that is not defined is looked up among the standard ones.
    """
    name = connection.msgtype
    definition = connection.msgdef
    if ros1:
        return name.replace("/msg/", "/"), "ros1msg", definition.data
    if definition.format == MessageDefinitionFormat.IDL:
        return name, "ros2idl", definition.data
    if definition.format == MessageDefinitionFormat.MSG:
        return name, "ros2msg", definition.data
    store = get_typestore(Stores.ROS2_HUMBLE)
    if name in store.fielddefs:
        return name, "ros2msg", store.generate_msgdef(name, ros_version=2)[0]
    return name, "", ""


def _channel(connection: Any, ros1: bool) -> tuple[str, dict[str, str]]:
    if not ros1:
        metadata = {QOS_KEY: dump_qos_v8(connection.ext.offered_qos_profiles)}
        return connection.ext.serialization_format, metadata | (
            {"topic_type_hash": connection.digest} if connection.digest else {}
        )
    metadata = {"md5sum": connection.digest, "topic": connection.topic}
    if connection.ext.callerid is not None:
        metadata["callerid"] = connection.ext.callerid
    if connection.ext.latching is not None:
        metadata["latching"] = str(connection.ext.latching)
    return "ros1", metadata

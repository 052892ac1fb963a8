"""One sqlite3 file of a ROS 2 bag, read without its metadata.yaml.

Its messages may be zstd-compressed one by one.
"""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Collection, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import apsw
import zstandard

from semloc_logs.errors import LogError
from semloc_logs.logs.containers import sqlite_file
from semloc_logs.logs.containers.base import BagFile, BaseLog, Bytes, decompress
from semloc_logs.logs.containers.memory import Memory
from semloc_logs.logs.log import Definition, Message, Section, Stream
from semloc_logs.logs.messages.definitions import is_standard
from semloc_logs.logs.messages.type_names import ros2_type
from semloc_logs.logs.problems import ProblemKind

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # no CDR message starts like this
_SECTION_BYTES = 4 << 20  # about as much as a chunk of other containers holds
_MOST_SECTIONS = 4096
# the text of an error quotes the file, so that it may itself not be UTF-8
_DAMAGE = (apsw.Error, UnicodeDecodeError, OverflowError, MemoryError)
_TABLE = re.compile(r"\s*create\s+table\b", re.IGNORECASE)  # not a view, which computes its rows
_MOST_TOPICS = 1 << 16


class SqliteLog(BaseLog):
    """A ``.db3`` file. LogError unless it holds the tables of rosbag2."""

    def __init__(
        self, path: Path, memory: Memory | None = None, bag_file: BagFile | None = None
    ) -> None:
        super().__init__(path, "rosbag2", memory, bag_file)
        self._damaged = False
        self._topics: dict[int, tuple[str, str, str, Definition]] = {}
        self._state = sqlite_file.state(path)
        try:
            self._database = _connect(path)
            # sqlite refuses longer values before it makes room for them
            longest = min(self._memory.most_of_one, (1 << 31) - 1)
            self._database.limit(apsw.SQLITE_LIMIT_LENGTH, longest)
        except (*_DAMAGE, OSError) as error:
            raise LogError(
                f"{path} cannot be read as a sqlite3 bag: {error}; "
                f"try to recover it with 'sqlite3 FILE .recover'."
            ) from error
        try:
            self._open()
        except (*_DAMAGE, ValueError, TypeError) as error:
            self._database.close()
            raise LogError(f"{path} cannot be read as a sqlite3 bag: {error}.") from error
        self._name_undefined()

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """The messages of ``topics`` (None: of all) in log-time order, up to any damage."""
        return self._load(None, topics)

    def sections(self) -> list[Section]:
        """Equal stretches of time; a single one where the file is damaged."""
        start_ns = self.start_ns
        end_ns = self.end_ns
        if start_ns is None or end_ns is None:
            return []
        nbytes = self._path_size()
        count = 1 if self._damaged else min(max(nbytes // _SECTION_BYTES, 1), _MOST_SECTIONS)
        step_ns = (end_ns - start_ns) // count + 1
        sections = []
        for first_ns in range(start_ns, end_ns + 1, step_ns):
            last_ns = min(first_ns + step_ns - 1, end_ns)
            messages = partial(self._load, None if count == 1 else (first_ns, last_ns))
            sections.append(Section(first_ns, last_ns, nbytes // count, frozenset(), messages))
        return sections

    def _path_size(self) -> int:
        try:
            return self.path.stat().st_size
        except OSError:
            return 0

    def _load(
        self, between: tuple[int, int] | None, topics: Collection[str] | None
    ) -> Iterator[Message]:
        """The messages of ``topics`` with log times ``between`` two, both included."""
        wanted = [i for i, (topic, *_) in self._topics.items() if topics is None or topic in topics]
        if not wanted:
            return
        self._problems.forget_skipped(topics, file=self._name)
        read = 0
        try:
            for topic_id, log_time, data, size in self._rows(wanted, between):
                topic, type_, encoding, definition = self._topics[topic_id]
                read += 1
                if data is None or log_time is None:
                    reason = f"row {read} of {self._name} holds no bytes or no time"
                    if size is not None and size > self._memory.most_of_one:
                        reason = f"row {read} of {self._name} {self._memory.too_much(size)}"
                    self._problems.skip(topic, reason, file=self._name)
                    continue
                if data.startswith(ZSTD_MAGIC):
                    try:
                        data = _decompress(data, self._memory)
                    except LogError as error:
                        reason = f"at {log_time} ns {error}"
                        self._problems.skip(topic, reason, file=self._name)
                        continue
                yield Message(topic, type_, encoding, log_time, data, definition)
        except _DAMAGE as error:
            self._problems.add(
                f"{self._name}: reading ended after {read} messages because the file is damaged "
                f"({error})."
            )
        if sqlite_file.state(self.path) != self._state:
            self._problems.add(
                f"{self._name} was written to while it was read, so messages may be missing or "
                "damaged; read it again when its recording has ended."
            )

    def _rows(
        self, topic_ids: list[int], between: tuple[int, int] | None
    ) -> Iterator[tuple[int, Any, Any, Any]]:
        """(topic id, log time, data, size of the data); the order of recording breaks ties.

        In log-time order. A time that is not a whole number, and data that are not bytes or too
        many, are None.
        """
        marks = ",".join("?" * len(topic_ids))
        fits = f"typeof(data) = 'blob' AND length(data) <= {self._memory.most_of_one}"
        columns = (
            "SELECT topic_id, CASE WHEN typeof(timestamp) = 'integer' THEN timestamp END, "
            f"CASE WHEN {fits} THEN data END, length(data) FROM messages"
        )
        where = f"WHERE topic_id IN ({marks})"
        if not self._damaged:
            if between is not None:
                where += " AND timestamp BETWEEN ? AND ?"
            yield from self._database.execute(
                f"{columns} {where} ORDER BY timestamp, id", (*topic_ids, *(between or ()))
            )
            return
        # an index may be damaged: without it, and only as far as the table can be read
        times: list[tuple[int, int]] = []
        with contextlib.suppress(*_DAMAGE):
            for time, row in self._database.execute(
                f"SELECT timestamp, id FROM messages NOT INDEXED {where}", topic_ids
            ):
                if isinstance(time, int):
                    times.append((time, row))
        for _, row in sorted(times):
            with contextlib.suppress(*_DAMAGE):
                yield from self._database.execute(f"{columns} WHERE id = ?", (row,))

    def close(self) -> None:
        """Releases the file."""
        self._database.close()

    def _open(self) -> None:
        execute = self._database.execute
        rows = execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'")
        tables = {name for name, sql in rows if _TABLE.match(sql or "")}
        if not {"topics", "messages"} <= tables:
            raise ValueError("it has no tables topics and messages")
        definitions = self._definitions() if "message_definitions" in tables else {}
        for id_, topic, type_, format_ in execute(
            f"SELECT id, {_blob('name')}, {_blob('type')}, {_blob('serialization_format')} "
            "FROM topics"
        ):
            if len(self._topics) == _MOST_TOPICS:
                raise ValueError(f"it names more than {_MOST_TOPICS} topics")
            type_ = ros2_type(_decoded(type_))
            self._topics[int(id_)] = (
                _decoded(topic),
                type_,
                _decoded(format_),
                definitions.get(type_, Definition(type_, "", b"")),
            )
        counts: Counter[tuple[str, str, str]] = Counter()
        try:
            for id_, count in execute("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id"):
                if id_ in self._topics:
                    counts[self._topics[id_][:3]] += count
            [(start, end)] = execute("SELECT MIN(timestamp), MAX(timestamp) FROM messages")
            if any(counts.values()) and not (isinstance(start, int) and isinstance(end, int)):
                raise apsw.CorruptError("time stamps are not integers")
            self.start_ns, self.end_ns = start, end
        except _DAMAGE as error:
            self._recount(counts, error)
        self.streams = [
            Stream(*kind, counts[kind]) for kind in sorted({t[:3] for t in self._topics.values()})
        ]
        self.encoding = "ros2"

    def _name_undefined(self) -> None:
        """Names the types that cannot be decoded: not standard, in a bag without definitions."""
        for topic, type_, encoding, definition in self._topics.values():
            counted = any(s.count for s in self.streams if (s.topic, s.type) == (topic, type_))
            if counted and encoding == "cdr" and not definition.text and not is_standard(type_):
                self._problems.add(
                    f"{topic}: messages of type {type_} cannot be decoded because the log does not "
                    f"define the type.",
                    topic=topic,
                    kind=ProblemKind.MESSAGE,
                )

    def _recount(self, counts: Counter[tuple[str, str, str]], error: BaseException) -> None:
        """Counts the messages of a damaged file that can still be read."""
        self._damaged = True
        self._problems.add(
            f"{self._name}: the file is damaged ({error}); the readable part is used."
        )
        counts.clear()
        self.start_ns = self.end_ns = None
        for message in self.messages():
            counts[message.topic, message.type, message.encoding] += 1
            self.start_ns = message.log_time_ns if self.start_ns is None else self.start_ns
            self.end_ns = message.log_time_ns

    def _definitions(self) -> dict[str, Definition]:
        definitions = {}
        kept = 0
        rows = self._database.execute(
            f"SELECT {_blob('topic_type')}, {_blob('encoding')}, "
            f"{_blob('encoded_message_definition')} FROM message_definitions"
        )
        for type_, encoding, text in rows:
            name = ros2_type(_decoded(type_))
            kept += len(text or b"")
            if kept > self._memory.most_of_definitions:
                raise ValueError(f"its definitions {self._memory.too_much(kept)}")
            if text and text.strip():
                definitions[name] = Definition(name, _decoded(encoding), text)
        return definitions


def _blob(column: str) -> str:
    """A column of text as bytes: parts that are not UTF-8 are replaced, not refused."""
    return f"CAST({column} AS BLOB)"


def _decoded(text: bytes | None) -> str:
    return (text or b"").decode(errors="replace")


def _connect(path: Path) -> apsw.Connection:
    """Opens for reading only; the text of an error states the fault."""
    if sqlite_file.overlay_of(path) is None:
        _refuse_cut_off(path)
    database = sqlite_file.connect(path)
    try:
        for _ in database.execute("SELECT name FROM sqlite_master LIMIT 1"):
            pass
    except BaseException:
        database.close()
        raise
    return database


def _refuse_cut_off(path: Path) -> None:
    """LogError for a file that is cut off; sqlite3 itself only calls it malformed."""
    with path.open("rb") as file:
        head = file.read(100)
        size = file.seek(0, 2)
    page = int.from_bytes(head[16:18], "big")
    claimed = int.from_bytes(head[28:32], "big") * (65536 if page == 1 else page)
    # the count is valid if the two agree
    if len(head) < 100 or (claimed > size and head[24:28] == head[92:96]):
        raise LogError(
            f"{path} is cut off: it has {size} of {claimed} bytes; copy or record it again."
        )


def _decompress(data: bytes, memory: Memory) -> Bytes:
    try:
        size = zstandard.frame_content_size(data)
    except zstandard.ZstdError as error:
        raise LogError(f"its zstd data are damaged ({error})") from error
    if size < 0:
        raise LogError("its zstd data do not contain their size")
    return decompress(data, "zstd", size, memory)

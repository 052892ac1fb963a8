"""One sqlite3 file of a ROS 2 bag, read without its metadata.yaml.

Its messages may be zstd-compressed one by one.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import zstandard

from semloc_logs.errors import LogError
from semloc_logs.logs.containers.base import MAX_CHUNK, BaseLog, decompress
from semloc_logs.logs.log import Definition, Message, Section, Stream
from semloc_logs.logs.messages.definitions import is_standard
from semloc_logs.logs.messages.type_names import ros2_type
from semloc_logs.logs.problems import ProblemKind, Problems

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # no CDR message starts like this
_SECTION_BYTES = 4 << 20  # about as much as a chunk of other containers holds
_MOST_SECTIONS = 4096
# the text of an error quotes the file, so that it may itself not be UTF-8
_DAMAGE = (sqlite3.Error, UnicodeDecodeError, OverflowError, MemoryError)


class SqliteLog(BaseLog):
    """A ``.db3`` file. LogError unless it holds the tables of rosbag2."""

    def __init__(self, path: Path, name: str = "", problems: Problems | None = None) -> None:
        super().__init__(path, "rosbag2", problems)
        self._name = name or path.name
        self._damaged = False
        self._topics: dict[int, tuple[str, str, str, Definition]] = {}
        try:
            self._database = _connect(path)
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
            for topic_id, log_time, data in self._rows(wanted, between):
                topic, type_, encoding, definition = self._topics[topic_id]
                read += 1
                if not isinstance(data, bytes) or not isinstance(log_time, int):
                    reason = f"row {read} of {self._name} holds no bytes or no time"
                    self._problems.skip(topic, reason, file=self._name)
                    continue
                if data.startswith(ZSTD_MAGIC):
                    try:
                        data = _decompress(data)
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

    def _rows(
        self, topic_ids: list[int], between: tuple[int, int] | None
    ) -> Iterator[tuple[int, Any, Any]]:
        """(topic id, log time, data) in log-time order; the order of recording breaks ties."""
        marks = ",".join("?" * len(topic_ids))
        columns = "SELECT topic_id, timestamp, data FROM messages"
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
        tables = {
            name for (name,) in execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        }
        if not {"topics", "messages"} <= tables:
            raise ValueError("it has no tables topics and messages")
        definitions = self._definitions() if "message_definitions" in tables else {}
        for id_, topic, type_, format_ in execute(
            "SELECT id, name, type, serialization_format FROM topics"
        ):
            type_ = ros2_type(str(type_))
            self._topics[int(id_)] = (
                str(topic),
                type_,
                str(format_),
                definitions.get(type_, Definition(type_, "", b"")),
            )
        counts: Counter[tuple[str, str, str]] = Counter()
        try:
            for id_, count in execute("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id"):
                if id_ in self._topics:
                    counts[self._topics[id_][:3]] += count
            start, end = execute("SELECT MIN(timestamp), MAX(timestamp) FROM messages").fetchone()
            if any(counts.values()) and not (isinstance(start, int) and isinstance(end, int)):
                raise sqlite3.DatabaseError("time stamps are not integers")
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
        rows = self._database.execute(
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        )
        for type_, encoding, text in rows:
            name = ros2_type(str(type_))
            if isinstance(text, str) and text.strip():
                definitions[name] = Definition(name, str(encoding), text.encode())
        return definitions


def _connect(path: Path) -> sqlite3.Connection:
    """Opens for reading only.

    A bag in a folder that cannot be written needs ``immutable``, one with a journal must not have
    it.
    """
    _refuse_cut_off(path)
    address = f"file:{quote(str(path.absolute()))}"
    for mode in ("mode=ro", "mode=ro&immutable=1"):
        database = sqlite3.connect(f"{address}?{mode}", uri=True, check_same_thread=False)
        try:
            database.text_factory = lambda text: text.decode(errors="replace")
            database.execute("PRAGMA trusted_schema = OFF")
            database.execute("SELECT name FROM sqlite_master LIMIT 1").fetchone()
        except sqlite3.OperationalError:
            database.close()
            if "immutable" in mode:
                raise
        except _DAMAGE:
            database.close()
            raise
        else:
            return database
    raise LogError(f"{path} cannot be opened.")


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


def _decompress(data: bytes) -> bytes:
    try:
        size = zstandard.frame_content_size(data)
    except zstandard.ZstdError as error:
        raise LogError(f"its zstd data are damaged ({error})") from error
    if not 0 <= size <= MAX_CHUNK:
        raise LogError("its zstd data do not contain their size")
    return decompress(data, "zstd", size)

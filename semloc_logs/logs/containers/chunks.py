"""The messages of a chunk in log-time order, within the memory of the log.

A chunk is read at once and kept while its messages are given. A large chunk, and one that overlaps
more chunks than memory may keep, is not kept: some of its messages are copied, and it is read again
for the next ones when their time has come.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from operator import itemgetter
from typing import NamedTuple, Protocol

import numpy as np

from semloc_logs.errors import LogError
from semloc_logs.logs.containers.base import Bytes, MessageOrTime
from semloc_logs.logs.containers.memory import Memory
from semloc_logs.logs.log import Definition, Message

Entry = tuple[int, int, int, int]  # log time, channel, start and end of the message's data
LARGE = 1 << 24  # bytes of a chunk; recorders make smaller ones
_ENTRY_BYTES = 220  # of an entry in a list, with its numbers
_MESSAGE_BYTES = 250  # of a message beside its data
_COMPACT_BYTES = 56  # of an entry in a compact index while it is sorted


class Kind(NamedTuple):
    """What the messages of a channel have in common."""

    topic: str
    type: str
    encoding: str
    definition: Definition
    publisher: str  # "" unless several channels have its topic


class Index(Protocol):
    """Takes the entries of a chunk."""

    def append(self, entry: Entry, /) -> None: ...

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Entry]: ...


class CompactIndex:
    """The entries of a large chunk in a few bytes each; LogError where they are too many."""

    def __init__(self, memory: Memory) -> None:
        self._times, self._channels = array("Q"), array("Q")
        self._starts, self._ends = array("Q"), array("Q")
        self._most = memory.most_of_one // _COMPACT_BYTES

    def append(self, entry: Entry, /) -> None:
        """Adds an entry."""
        if len(self._times) == self._most:
            raise LogError(f"it holds more than {self._most} messages")
        time, channel, start, end = entry
        self._times.append(time)
        self._channels.append(channel)
        self._starts.append(start)
        self._ends.append(end)

    def __len__(self) -> int:
        return len(self._times)

    def __iter__(self) -> Iterator[Entry]:
        return zip(self._times, self._channels, self._starts, self._ends, strict=True)

    def channels(self) -> list[int]:
        """The channels of the entries."""
        return [int(c) for c in np.unique(np.frombuffer(self._channels, np.uint64))]

    def in_order(self, wanted: list[int], first: int) -> Iterator[Entry]:
        """The entries of the ``wanted`` channels by log time, without the ``first`` of them."""
        times = np.frombuffer(self._times, np.uint64)
        channels = np.frombuffer(self._channels, np.uint64)
        rows = np.flatnonzero(np.isin(channels, np.array(wanted, np.uint64)))
        rows = rows[np.argsort(times[rows], kind="stable")][first:]
        for k in map(int, rows):
            yield self._times[k], self._channels[k], self._starts[k], self._ends[k]


def new_index(size: int, memory: Memory) -> Index:
    """An index for a chunk of ``size`` bytes."""
    entries: list[Entry] = []
    return CompactIndex(memory) if size > LARGE else entries


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk as its container reads it.

    ``start_ns``: a lower bound of its times. ``claimed_size()``: its bytes, decompressed;
    ``unpack()``: these. ``walk`` puts the entries in them into an index. ``kind`` of a channel;
    None where its messages are not wanted. LogError and OSError pass by.
    """

    start_ns: int
    claimed_size: Callable[[], int]
    unpack: Callable[[], Bytes]
    walk: Callable[[Bytes, Index], None]
    kind: Callable[[int], Kind | None]


def chunk_messages(chunk: Chunk, memory: Memory) -> Iterator[MessageOrTime]:
    """The wanted messages in log-time order; in between the time of one that is read later."""
    size = chunk.claimed_size()
    memory.check(size)
    if size <= LARGE and memory.used + size <= memory.most_of_overlapping:
        return _kept(chunk, memory)
    return _in_batches(chunk, memory)


def _kept(chunk: Chunk, memory: Memory) -> Iterator[Message]:
    data = chunk.unpack()
    entries: list[Entry] = []
    chunk.walk(data, entries)
    entries.sort(key=itemgetter(0))  # stable, and nearly free for sorted input
    view = memory.counted(data)
    del data
    kinds = {channel: chunk.kind(channel) for channel in sorted({entry[1] for entry in entries})}
    with memory.held(_ENTRY_BYTES * len(entries)):
        for time, channel, start, end in entries:
            if (kind := kinds[channel]) is not None:
                topic, type_, encoding, definition, publisher = kind
                content = view[start:end]
                yield Message(topic, type_, encoding, time, content, definition, publisher)


def _in_batches(chunk: Chunk, memory: Memory) -> Iterator[MessageOrTime]:
    given = 0
    due: int | None = chunk.start_ns
    while due is not None:
        yield due
        messages, due = _batch(chunk, memory, given, due)
        given += len(messages)
        with memory.held(sum(_MESSAGE_BYTES + len(m.data) for m in messages)):
            messages.reverse()
            while messages:
                yield messages.pop()


def _batch(chunk: Chunk, memory: Memory, given: int, due: int) -> tuple[list[Message], int | None]:
    """Messages behind the first ``given``, as many as there is room for, and the next one's time.

    A message without room comes alone, at its time.
    """
    data = chunk.unpack()
    index = CompactIndex(memory)
    chunk.walk(data, index)
    view = memory.counted(data)
    del data
    room = (memory.most_of_overlapping + memory.most_of_copies - memory.used + len(view)) // 2
    messages: list[Message] = []
    alone = False
    kinds = {c: kind for c in index.channels() if (kind := chunk.kind(c)) is not None}
    for time, channel, start, end in index.in_order(list(kinds), given):
        room -= end - start + _MESSAGE_BYTES
        if alone or (room < 0 and (messages or time > due)):
            return messages, time
        alone = room < 0
        topic, type_, encoding, definition, publisher = kinds[channel]
        content = view[start:end] if alone else bytes(view[start:end])
        messages.append(Message(topic, type_, encoding, time, content, definition, publisher))
    return messages, None

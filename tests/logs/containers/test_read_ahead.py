"""Chunks that threads make ready come in order, within memory, and fail when their turn has
come.
"""

from __future__ import annotations

import zstandard

from semloc_logs.errors import LogError
from semloc_logs.logs.containers.base import decompress
from semloc_logs.logs.containers.memory import Memory
from semloc_logs.logs.containers.read_ahead import AHEAD, ReadAhead

MIB = 1 << 20


def test_chunks_are_unpacked_once_and_their_memory_is_given_back() -> None:
    memory = Memory(64 * MIB)
    parts = [f"part {k}" for k in range(20)]
    unpacked: list[str] = []

    def unpack(part: str) -> bytes:
        unpacked.append(part)
        return part.encode()

    with ReadAhead(parts, lambda _: MIB, unpack, memory) as ahead:
        for part in parts[:10]:
            assert ahead.take(part) == part.encode()
            assert memory.used <= AHEAD * MIB
    assert memory.used == 0
    assert sorted(unpacked) == sorted(set(unpacked))
    assert set(unpacked) <= set(parts[: 10 + AHEAD])


def test_large_chunks_are_not_read_ahead() -> None:
    memory = Memory(64 * MIB)  # a quarter for chunks that overlap
    parts = ["a", "b"]
    with ReadAhead(parts, lambda _: 9 * MIB, str.encode, memory) as ahead:
        assert ahead.take(parts[0]) == b"a"
        assert memory.used == 0
        assert ahead.take(parts[1]) == b"b"


def test_a_damaged_chunk_fails_when_its_turn_has_come() -> None:
    def unpack(part: str) -> bytes:
        if part == "bad":
            raise LogError("it is damaged")
        return part.encode()

    parts = ["a", "bad", "c"]
    outcomes = []
    memory = Memory()
    with ReadAhead(parts, lambda _: 1, unpack, memory) as ahead:
        for part in parts:
            try:
                outcomes.append(ahead.take(part))
            except LogError as error:
                outcomes.append(str(error).encode())
    assert outcomes == [b"a", b"it is damaged", b"c"]
    assert memory.used == 0


def test_a_buffer_is_used_again_only_when_nobody_sees_it() -> None:
    memory = Memory(64 * MIB)
    packed = [zstandard.compress(bytes([k]) * MIB) for k in range(3)]
    first = memory.counted(decompress(packed[0], "zstd", MIB, memory))
    piece = first[10:20]
    del first
    second = memory.counted(decompress(packed[1], "zstd", MIB, memory))
    assert (bytes(piece), second[0]) == (bytes(10), 1)
    place = second.obj
    del second, place
    third = memory.counted(decompress(packed[2], "zstd", MIB, memory))
    assert (bytes(piece), third[0], memory.used) == (bytes(10), 2, 2 * MIB)
    del piece, third
    assert memory.used == 0

"""Adding records to MCAP files of every shape, and surviving an interruption at every step of it."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer

from semloc_logs.errors import LogError
from semloc_logs.logs.annotation import tail_swap
from semloc_logs.logs.annotation.annotate import (
    ClosureRecord,
    Results,
    annotate_copy,
    annotate_in_place,
    content_fingerprint,
    recover,
)
from semloc_logs.logs.annotation.mcap_append import read_ending

NO_TIMES: dict[int, int] = {}


def closures() -> list[ClosureRecord]:
    def one(query: str, target: str, query_ns: int, target_ns: int) -> ClosureRecord:
        covariance = tuple((np.eye(6) * 0.01).ravel())
        pose = np.eye(4)
        position = np.arange(3.0)
        return ClosureRecord(
            query,
            target,
            query_ns,
            target_ns,
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
            pose,
            position,
        )

    return [one("a", "b", 3, 5), one("b", "a", 7, 2), one("x", "y", 0, 0)]


def write_log(
    path: Path, count: int = 20, *, payload: int = 50, attachment: bool = True, **options: Any
) -> None:
    """A log with two JSON channels, an attachment and a metadata record."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start("", "test")
        schema = writer.register_schema("thing", "jsonschema", b"{}")
        channels = [
            writer.register_channel(topic, "json", schema, {"k": "v"}) for topic in ("/one", "/two")
        ]
        for k in range(count):
            writer.add_message(
                channels[k % 2], 100 + k, (b'{"v": %d}' % k).ljust(payload), 90 + k, k
            )
        if attachment:
            writer.add_attachment(1, 2, "calibration.txt", "text/plain", b"fx 500")
            writer.add_metadata("vehicle", {"plate": "ZH 1"})
        writer.finish()  # type: ignore[no-untyped-call]


def linear(path: Path) -> list[tuple[Any, ...]]:
    """Messages, attachments and metadata in file order, every checksum verified."""
    out: list[tuple[Any, ...]] = []
    topics: dict[int, str] = {}
    with path.open("rb") as file:
        for record in StreamReader(file, validate_crcs=True).records:
            if isinstance(record, Channel):
                topics.setdefault(record.id, record.topic)
            elif isinstance(record, Message):
                out.append(
                    (
                        "m",
                        topics[record.channel_id],
                        record.log_time,
                        record.publish_time,
                        record.sequence,
                        bytes(record.data),
                    )
                )
            elif isinstance(record, Attachment):
                out.append(
                    (
                        "a",
                        record.name,
                        record.log_time,
                        record.create_time,
                        record.media_type,
                        record.data,
                    )
                )
            elif isinstance(record, Metadata):
                out.append(("d", record.name, *sorted(record.metadata.items())))
    return out


def indexed(path: Path) -> list[tuple[Any, ...]]:
    """The same through the summary."""
    out: list[tuple[Any, ...]] = []
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for _, channel, m in reader.iter_messages():
            out.append(("m", channel.topic, m.log_time, m.publish_time, m.sequence, bytes(m.data)))
        out += [
            ("a", a.name, a.log_time, a.create_time, a.media_type, a.data)
            for a in reader.iter_attachments()
        ]
        out += [("d", d.name, *sorted(d.metadata.items())) for d in reader.iter_metadata()]
    return out


def is_ours(record: tuple[Any, ...]) -> bool:
    return str(record[1]).startswith(("/semloc/", "semloc/"))


def check_annotated(original: Path, annotated: Path) -> None:
    """Everything of the original is there in its order, our six records are the last, and the
    summary lists all of it.
    """
    before = linear(original)
    after = linear(annotated)
    assert [r for r in after if not is_ours(r)] == before
    assert len(after) == len(before) + 6  # two closures, one pose, two markers, one metadata record
    assert all(is_ours(r) for r in after[-6:])
    assert sorted(indexed(annotated)) == sorted(after)
    with annotated.open("rb") as file:
        statistics = make_reader(file).get_summary().statistics  # type: ignore[union-attr]
    assert statistics is not None
    assert (
        statistics.message_count
        == sum(statistics.channel_message_counts.values())
        == sum(r[0] == "m" for r in after)
    )
    assert (statistics.attachment_count, statistics.metadata_count) == tuple(
        sum(r[0] == k for r in after) for k in "ad"
    )


SHAPES: dict[str, dict[str, Any]] = {
    "zstd": {},
    "lz4": {"compression": CompressionType.LZ4},
    "uncompressed": {"compression": CompressionType.NONE},
    "unchunked": {"use_chunking": False},
    "many chunks": {"chunk_size": 100},
    "data checksum": {"enable_data_crcs": True},
    "no checksums": {"enable_crcs": False},
    "no statistics": {"use_statistics": False},
    "no summary offsets": {"use_summary_offsets": False},
    "no indexes": {"index_types": IndexType.NONE},
    "no chunk index": {"index_types": IndexType.MESSAGE | IndexType.ATTACHMENT},
    "no message index": {"index_types": IndexType.CHUNK},
    "no schemas and channels": {"repeat_channels": False, "repeat_schemas": False},
    "no summary": {
        "index_types": IndexType.NONE,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_statistics": False,
        "use_summary_offsets": False,
    },
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("count", [0, 20])
def test_every_shape_copy_in_place_and_again(tmp_path: Path, shape: str, count: int) -> None:
    log, copy, place = (tmp_path / n for n in ("log.mcap", "copy.mcap", "place.mcap"))
    write_log(log, count, **SHAPES[shape])
    shutil.copyfile(log, place)
    report = annotate_copy(log, copy, Results(closures(), "a", {"k": "v"}, log_times=NO_TIMES))
    check_annotated(log, copy)
    assert (report.closures, report.messages, report.replaced) == (2, 5, False)
    assert copy.stat().st_size - read_ending(log.open("rb"), log).offset == report.bytes_written
    fingerprint = content_fingerprint(place)
    annotate_in_place(place, Results(closures(), "a", {"k": "v"}, log_times=NO_TIMES))
    assert place.read_bytes() == copy.read_bytes()
    annotate_in_place(place, Results(closures()[:1], "a", {"k": "other"}, log_times=NO_TIMES))
    assert sum(is_ours(r) for r in linear(place)) == 4
    assert annotate_in_place(
        place, Results(closures(), "a", {"k": "v"}, log_times=NO_TIMES)
    ).replaced
    assert place.read_bytes() == copy.read_bytes()
    assert content_fingerprint(place) == content_fingerprint(log) == fingerprint
    annotate_copy(
        place, tmp_path / "second.mcap", Results(closures(), "a", {"k": "v"}, log_times=NO_TIMES)
    )
    assert (tmp_path / "second.mcap").read_bytes() == copy.read_bytes()


def test_conformance_files(shared: Callable[[str], Path], tmp_path: Path) -> None:
    for log in sorted(shared("odd_logs/mcap_conformance").glob("*.mcap"))[::5]:
        copy = tmp_path / "copy.mcap"
        place = tmp_path / "place.mcap"
        annotate_copy(log, copy, Results(closures(), "a", {}, log_times=NO_TIMES), overwrite=True)
        check_annotated(log, copy)
        shutil.copyfile(log, place)
        for _ in range(2):
            annotate_in_place(place, Results(closures(), "a", {}, log_times=NO_TIMES))
            assert place.read_bytes() == copy.read_bytes(), log.name


def test_results_larger_than_a_chunk_are_split(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    copy = tmp_path / "copy.mcap"
    write_log(log)
    many = [
        ClosureRecord(
            "a",
            f"target{k}",
            k,
            k,
            0,
            0,
            0,
            0,
            0,
            0,
            1,
            tuple(np.eye(6).ravel()),
            0.5,
            0.9,
            1,
            1,
            None,
            np.zeros(3),
        )
        for k in range(1500)
    ]
    annotate_copy(log, copy, Results(many, "a", {}, log_times={k: 10**9 + k for k in range(1500)}))
    with copy.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) == 3  # one of the log, and two of ours with about 2.0 MB
    assert sorted(indexed(copy)) == sorted(linear(copy))
    times = [r[2] for r in linear(copy) if r[0] == "m" and is_ours(r)]
    assert times == sorted(times)


def test_no_closures_replace_earlier_ones(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    write_log(log)
    before = linear(log)
    annotate_in_place(log, Results(closures(), "a", {}, log_times=NO_TIMES))
    annotate_in_place(log, Results([], "a", {}, log_times=NO_TIMES))
    after = linear(log)
    assert after[:-1] == before
    assert after[-1][:1] == ("d",)


def test_records_behind_ours_are_not_lost(tmp_path: Path) -> None:
    """Another tool that adds an attachment behind our results: neither is it cut off nor are
    results written twice.
    """
    log = tmp_path / "log.mcap"
    write_log(log)
    annotate_in_place(log, Results(closures(), "a", {}, log_times=NO_TIMES))
    data = log.read_bytes()
    summary_start = struct.unpack("<Q", data[-28:-20])[0]
    added = b"\x09" + struct.pack("<QQQI1sIQI", 8 + 8 + 5 + 4 + 8 + 4, 0, 0, 1, b"x", 0, 0, 0)
    end = b"\x0f" + struct.pack("<QI", 4, 0)
    footer = b"\x02" + struct.pack("<QQQI", 20, 0, 0, 0)
    log.write_bytes(data[: summary_start - 13] + added + end + footer + data[-8:])
    changed = log.read_bytes()
    with pytest.raises(LogError, match="cannot be replaced"):
        annotate_in_place(log, Results(closures(), "a", {}, log_times=NO_TIMES))
    assert log.read_bytes() == changed


@pytest.mark.parametrize("keep", [0, 5, 20, 300, -1, -9, -50])
def test_cut_off_logs_are_refused_and_nothing_is_written(tmp_path: Path, keep: int) -> None:
    log = tmp_path / "log.mcap"
    write_log(log)
    log.write_bytes(log.read_bytes()[:keep])
    before = log.read_bytes()
    with pytest.raises(LogError, match=r"mcap recover|not an MCAP"):
        annotate_copy(log, tmp_path / "out.mcap", Results(closures(), "a", {}, log_times=NO_TIMES))
    with pytest.raises(LogError):
        annotate_in_place(log, Results(closures(), "a", {}, log_times=NO_TIMES))
    assert [p.name for p in tmp_path.iterdir()] == ["log.mcap"]
    assert log.read_bytes() == before
    assert content_fingerprint(log)


def test_a_damaged_chunk_is_refused_when_it_has_to_be_read(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    write_log(log, use_statistics=False, compression=CompressionType.NONE)
    data = bytearray(log.read_bytes())
    data[data.index(b'"v": 7')] ^= 1
    log.write_bytes(data)
    with pytest.raises(LogError, match="checksum"):
        annotate_copy(log, tmp_path / "out.mcap", Results(closures(), "a", {}, log_times=NO_TIMES))


@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_damaged_bytes_give_a_log_error_or_a_result(data: st.DataObject) -> None:
    file = io.BytesIO()
    writer = Writer(
        file,
        compression=data.draw(st.sampled_from(list(CompressionType))),
        use_statistics=data.draw(st.booleans()),
    )
    writer.start("", "test")
    channel = writer.register_channel(
        "/one", "json", writer.register_schema("thing", "jsonschema", b"{}"), {"a": "b"}
    )
    writer.add_message(channel, 1, b"{}" * 30, 1)
    writer.add_metadata("semloc/x", {"start": "50", "records_sha256": "0"})
    writer.add_attachment(1, 2, "name", "type", b"data")
    writer.finish()  # type: ignore[no-untyped-call]
    raw = bytearray(file.getvalue())
    for _ in range(data.draw(st.integers(1, 3))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.sampled_from([0, 1, 127, 255]))
    with contextlib.suppress(LogError):  # and no other error
        read_ending(io.BytesIO(bytes(raw)), Path("log.mcap"))


class Crash(BaseException):
    """The process died."""


class Dying:
    """The operating system for a process that dies after a number of steps; a write of n bytes is n
    // grain + 1 steps.
    """

    def __init__(self, steps: int, grain: int) -> None:
        self.left, self.grain = steps, grain

    def step(self) -> None:
        if self.left <= 0:
            raise Crash
        self.left -= 1

    def pwrite(self, fd: int, data: memoryview, offset: int) -> int:
        for at in range(0, len(data), self.grain):
            self.step()
            os.pwrite(fd, data[at : at + self.grain], offset + at)
        self.step()
        return len(data)

    def __getattr__(self, name: str) -> Any:
        real = getattr(os, name)
        if name not in ("fsync", "ftruncate", "replace", "unlink"):
            return real

        def call(*args: Any) -> Any:
            self.step()
            return real(*args)

        return call


@pytest.mark.parametrize("fewer", [False, True])
def test_interruption_at_every_step_of_writing_in_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fewer: bool
) -> None:
    """After the next look at the log it is exactly what it was before, or exactly what it was to
    become.
    """
    log = tmp_path / "log.mcap"
    done = tmp_path / "done.mcap"
    write_log(log, chunk_size=100)
    if fewer:  # the file becomes shorter
        annotate_in_place(log, Results(closures(), "a", {"k": "old"}, log_times=NO_TIMES))
    wanted = closures()[: 1 if fewer else 3]
    before = log.read_bytes()
    annotate_copy(log, done, Results(wanted, "a", {}, log_times=NO_TIMES))
    after = done.read_bytes()
    assert (len(after) < len(before)) == fewer
    outcomes = []
    for steps in range(10_000):
        log.write_bytes(before)
        with monkeypatch.context() as patch:
            patch.setattr(tail_swap, "os", Dying(steps, grain=997))
            try:
                annotate_in_place(log, Results(wanted, "a", {}, log_times=NO_TIMES))
                finished = True
            except Crash:
                finished = False
        torn = log.read_bytes() not in (before, after)
        left = [p.name for p in tmp_path.iterdir() if p.name not in ("log.mcap", "done.mcap")]
        assert recover(log) == bool([n for n in left if n.endswith("semloc-tail")])
        assert log.read_bytes() in ((after,) if finished else (before, after))
        assert sorted(p.name for p in tmp_path.iterdir()) == ["done.mcap", "log.mcap"]
        assert not recover(log)
        outcomes.append((torn, log.read_bytes() == after))
        if finished:
            break
    assert any(torn for torn, _ in outcomes)  # some interruptions did leave a torn file
    assert not outcomes[0][1]
    assert outcomes[-1][1]


def test_interruption_of_the_repair_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = tmp_path / "log.mcap"
    write_log(log, chunk_size=100)
    before = log.read_bytes()

    def interrupted(action: Any, steps: int) -> bool:
        with monkeypatch.context() as patch:
            patch.setattr(tail_swap, "os", Dying(steps, grain=997))
            try:
                action()
            except Crash:
                return True
        return False

    assert interrupted(
        lambda: annotate_in_place(log, Results(closures(), "a", {}, log_times=NO_TIMES)), 12
    )
    torn = log.read_bytes()
    side = (tmp_path / "log.mcap.semloc-tail").read_bytes()
    assert torn != before
    for steps in range(100):
        log.write_bytes(torn)
        (tmp_path / "log.mcap.semloc-tail").write_bytes(side)
        died = interrupted(lambda: recover(log), steps)
        recover(log)
        assert log.read_bytes() == before
        if not died:
            return
    pytest.fail("the repair never ended")


def test_full_disk_while_writing_leaves_the_log_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "log.mcap"
    write_log(log)
    before = log.read_bytes()

    class Full(Dying):
        def pwrite(self, fd: int, data: memoryview, offset: int) -> int:
            self.left -= 1
            if self.left == 0:
                os.pwrite(fd, data[:100], offset)
                raise OSError(28, "No space left on device")
            return os.pwrite(fd, data, offset)

        def step(self) -> None:
            pass

    for write in (1, 2):  # the saved tail, then the log
        with monkeypatch.context() as patch:
            patch.setattr(tail_swap, "os", Full(write, 1))
            with pytest.raises(LogError, match=r"unchanged.*No space left"):
                annotate_in_place(log, Results(closures(), "a", {}, log_times=NO_TIMES))
        assert log.read_bytes() == before
        assert [p.name for p in tmp_path.iterdir()] == ["log.mcap"]


def test_a_saved_tail_of_another_file_is_not_put_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "log.mcap"
    write_log(log)
    with monkeypatch.context() as patch:
        patch.setattr(tail_swap, "os", Dying(12, grain=997))
        with pytest.raises(Crash):
            annotate_in_place(log, Results(closures(), "a", {}, log_times=NO_TIMES))
    write_log(log, count=21)
    other = log.read_bytes()
    with pytest.raises(LogError, match="delete that file"):
        recover(log)
    assert log.read_bytes() == other


def test_two_writers(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    write_log(log)
    with tail_swap.locked(log), pytest.raises(LogError, match="another process"):
        annotate_in_place(log, Results(closures(), "a", {}, log_times=NO_TIMES))


def test_chunk_that_claims_to_be_huge(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    write_log(log, attachment=False, use_statistics=False)
    data = bytearray(log.read_bytes())
    start = 8 + 9 + int.from_bytes(data[9:17], "little")
    assert data[start] == 6  # the chunk; its uncompressed size follows two times
    data[start + 25 : start + 33] = (1 << 62).to_bytes(8, "little")
    log.write_bytes(data)
    with pytest.raises(LogError, match="announced"):
        annotate_copy(log, tmp_path / "out.mcap", Results(closures(), "a", {}, log_times=NO_TIMES))

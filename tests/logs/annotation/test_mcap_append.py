"""Adding records to MCAP files of every shape; the recorded messages survive."""

from __future__ import annotations

import contextlib
import io
import shutil
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer

from semloc_logs.errors import LogError
from semloc_logs.logs.annotation import mcap_append
from semloc_logs.logs.annotation.annotate import (
    ClosureRecord,
    Results,
    annotate_copy,
    annotate_in_place,
    content_fingerprint,
)
from semloc_logs.logs.annotation.channels import NewChannel, NewMessage
from semloc_logs.logs.annotation.mcap_append import empty_end, plan_append, read_end
from semloc_logs.logs.containers.mcap_records import raw
from semloc_logs.logs.containers.open import open_log

SHARED = Path(__file__).resolve().parents[4] / "shared"
CONFORMANCE = SHARED / "odd_logs" / "mcap_conformance"
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


def data_section(path: Path) -> tuple[bytes, int]:
    """All bytes before DataEnd (a record of 13 bytes here), and the CRC in it."""
    data = path.read_bytes()
    summary_start = struct.unpack("<Q", data[-28:-20])[0] or len(data) - 37
    assert data[summary_start - 13 : summary_start - 4] == b"\x0f" + struct.pack("<Q", 4)
    return data[: summary_start - 13], int.from_bytes(
        data[summary_start - 4 : summary_start], "little"
    )


def check_data_section(original: Path, annotated: Path) -> None:
    """No recorded byte changes, and a CRC of the data section stays one."""
    before, crc = data_section(original)
    after, new_crc = data_section(annotated)
    assert after[: len(before)] == before
    assert crc in (0, zlib.crc32(before))
    assert new_crc == (zlib.crc32(after) if crc else 0)


def check_indexes(original: Path, annotated: Path) -> None:
    """Each index, schema and channel that the original lists is there, unchanged."""
    with original.open("rb") as file:
        before = make_reader(file).get_summary()
    with annotated.open("rb") as file:
        after = make_reader(file).get_summary()
    assert before is not None
    assert after is not None
    for name in ("chunk_indexes", "attachment_indexes", "metadata_indexes"):
        old = getattr(before, name)
        new = getattr(after, name)
        assert new[: len(old)] == old
    assert {k: after.schemas[k] for k in before.schemas} == before.schemas
    assert {k: after.channels[k] for k in before.channels} == before.channels


def check_annotated(original: Path, annotated: Path) -> None:
    """All of the original is there in its order, our seven records are last, all is listed."""
    before = linear(original)
    after = linear(annotated)
    assert [r for r in after if not is_ours(r)] == before
    assert (
        len(after) == len(before) + 7
    )  # two closures, two poses, two markers, one metadata record
    assert all(is_ours(r) for r in after[-7:])
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
    check_data_section(log, copy)
    if count and shape != "no summary":  # else it is scanned for what it should list
        check_indexes(log, copy)
    assert (report.closures, report.messages, report.replaced) == (2, 6, False)
    assert copy.stat().st_size - read_end(log.open("rb"), log).start == report.bytes_written
    fingerprint = content_fingerprint(place)
    annotate_in_place(place, Results(closures(), "a", {"k": "v"}, log_times=NO_TIMES))
    assert place.read_bytes() == copy.read_bytes()
    annotate_in_place(place, Results(closures()[:1], "a", {"k": "other"}, log_times=NO_TIMES))
    assert sum(is_ours(r) for r in linear(place)) == 5
    assert annotate_in_place(
        place, Results(closures(), "a", {"k": "v"}, log_times=NO_TIMES)
    ).replaced
    assert place.read_bytes() == copy.read_bytes()
    assert content_fingerprint(place) == content_fingerprint(log) == fingerprint
    annotate_copy(
        place, tmp_path / "second.mcap", Results(closures(), "a", {"k": "v"}, log_times=NO_TIMES)
    )
    assert (tmp_path / "second.mcap").read_bytes() == copy.read_bytes()


def test_conformance_files(tmp_path: Path) -> None:
    if not CONFORMANCE.is_dir():
        pytest.skip("no shared/odd_logs/mcap_conformance beside the checkout")
    for log in sorted(CONFORMANCE.glob("*.mcap"))[::5]:
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
    """Another tool added an attachment behind our results: nothing is cut off or doubled."""
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


CHANNEL = NewChannel("/semloc/x", "json", "thing", "jsonschema", b"{}", {})


def test_a_channel_without_messages_is_not_added() -> None:
    start, end = empty_end("", "test")
    added = io.BytesIO(start + plan_append(end, [CHANNEL], [], "semloc/x", {}).new_tail)
    summary = make_reader(added, validate_crcs=True).get_summary()
    assert summary is not None
    assert (summary.channels, summary.schemas, summary.chunk_indexes) == ({}, {}, [])
    assert len(summary.metadata_indexes) == 1


def test_an_empty_log_has_the_times_of_its_results() -> None:
    start, end = empty_end("", "test")
    messages = [NewMessage(0, 5, b"{}"), NewMessage(0, 9, b"{}")]
    added = start + plan_append(end, [CHANNEL], messages, "semloc/x", {}).new_tail
    summary = make_reader(io.BytesIO(added), validate_crcs=True).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_start_time == 5
    assert summary.statistics.message_end_time == 9


def test_messages_are_counted_on_each_channel() -> None:
    start, end = empty_end("", "test")
    channels = [CHANNEL, replace(CHANNEL, topic="/semloc/y")]
    messages = [NewMessage(channel, 5, b"{}") for channel in (0, 0, 1, 0, 1)]
    added = start + plan_append(end, channels, messages, "semloc/x", {}).new_tail
    sequences = [
        (channel.topic, message.sequence)
        for _, channel, message in make_reader(io.BytesIO(added)).iter_messages()
    ]
    assert sorted(sequences) == [
        ("/semloc/x", 0),
        ("/semloc/x", 1),
        ("/semloc/x", 2),
        ("/semloc/y", 0),
        ("/semloc/y", 1),
    ]


def test_every_index_leads_to_its_message(tmp_path: Path) -> None:
    """From a chunk index to the message index of each channel, from there into the chunk."""
    log = tmp_path / "log.mcap"
    write_log(log)
    annotate_in_place(log, Results(closures(), "a", {}, log_times=NO_TIMES))
    data = log.read_bytes()
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary is not None
    ours = summary.chunk_indexes[-1]
    # opcode, length, times, size, CRC, compression "zstd", size of the data
    packed = data[ours.chunk_start_offset + 9 + 28 + 8 + 8 :][: ours.compressed_size]
    chunk = zstandard.decompress(packed, ours.uncompressed_size)
    assert chunk[0] == Opcode.SCHEMA
    begin = ours.chunk_start_offset + 9 + 16
    assert data[begin : begin + 12] == struct.pack("<QI", len(chunk), zlib.crc32(chunk))

    count = 0
    for channel, offset in ours.message_index_offsets.items():
        opcode, _, own_id, size = struct.unpack("<BQHI", data[offset : offset + 15])
        assert (opcode, own_id) == (Opcode.MESSAGE_INDEX, channel)
        for time, place in struct.iter_unpack("<QQ", data[offset + 15 : offset + 15 + size]):
            record = struct.unpack("<BQHIQ", chunk[place : place + 23])
            assert (record[0], record[2], record[4]) == (Opcode.MESSAGE, channel, time)
            count += 1
    assert count == 6  # two closures, two poses, two markers


def test_ids_of_channels_are_used_up_to_the_last() -> None:
    """Ids have 16 bits: behind channel 65534 there is room for one, behind 65535 for none."""
    _, end = empty_end("", "test")
    messages = [NewMessage(0, 5, b"{}")]
    last: dict[int, list[bytes]] = {Opcode.CHANNEL: [raw(Channel(65534, "/old", "json", {}, 0))]}
    new = plan_append(
        replace(end, summary=replace(end.summary, groups=last)), [CHANNEL], messages, "x", {}
    )
    assert raw(Channel(65535, "/semloc/x", "json", {}, 1)) in new.new_tail
    full: dict[int, list[bytes]] = {Opcode.CHANNEL: [raw(Channel(65535, "/old", "json", {}, 0))]}
    with pytest.raises(LogError, match="no free schema or channel ids left"):
        plan_append(
            replace(end, summary=replace(end.summary, groups=full)), [CHANNEL], messages, "x", {}
        )


def test_a_damaged_summary_is_refused(tmp_path: Path) -> None:
    """A letter of a topic in the summary changes: only the checksum tells it."""
    log = tmp_path / "log.mcap"
    write_log(log)
    data = bytearray(log.read_bytes())
    data[data.rindex(b"/two") + 1] ^= 1
    log.write_bytes(data)
    with pytest.raises(LogError, match=rf"damaged summary \(checksum at offset {len(data) - 12}\)"):
        annotate_in_place(log, Results(closures(), "a", {}, log_times=NO_TIMES))
    data[-12:-8] = bytes(4)  # a file without a checksum
    log.write_bytes(data)
    assert [c.topic for c in read_end(io.BytesIO(data), log).channels] == ["/one", "/uwo"]


def test_a_summary_that_repeats_a_channel_is_not_scanned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "log.mcap"
    write_log(log)
    data = log.read_bytes()
    first = data.rindex(b"/one") - 17  # opcode, length, id, schema, length of the topic
    length = 9 + int.from_bytes(data[first + 1 : first + 9], "little")
    assert data[first] == Opcode.CHANNEL
    twice = data[:first] + data[first : first + length] + data[first:]
    summary_start = struct.unpack("<Q", data[-28:-20])[0]
    footer = struct.pack("<BQQQI", Opcode.FOOTER, 20, summary_start, 0, 0)
    monkeypatch.setattr(mcap_append, "scan", None)
    end = read_end(io.BytesIO(twice[:-37] + footer + data[-8:]), log)
    assert sorted(c.topic for c in end.channels) == ["/one", "/one", "/two"]


def test_results_that_were_changed_are_not_ours(tmp_path: Path) -> None:
    """A byte of our chunk is changed: it may hold something else by now, and is kept."""
    log = tmp_path / "log.mcap"
    write_log(log)
    start = len(data_section(log)[0])
    annotate_in_place(log, Results(closures(), "a", {}, log_times=NO_TIMES))
    data = bytearray(log.read_bytes())
    data[start + 80] ^= 1
    with pytest.raises(LogError, match="cannot be replaced"):
        read_end(io.BytesIO(data), log)


def test_a_metadata_record_larger_than_ours_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its length comes from the file: it may be anything."""
    log = tmp_path / "log.mcap"
    write_log(log)
    annotate_in_place(log, Results(closures(), "a", {}, log_times=NO_TIMES))
    assert read_end(log.open("rb"), log).replaces
    monkeypatch.setattr(mcap_append, "MAX_METADATA", 100)
    with pytest.raises(LogError, match="cannot be replaced"):
        read_end(log.open("rb"), log)


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
@settings(max_examples=150)
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
        read_end(io.BytesIO(bytes(raw)), Path("log.mcap"))


# place of a length in a chunk record, what the error states
CLAIMS = {
    "unpacked size": (25, "it claims"),
    "packed size": (9 + 8 + 8 + 8 + 4 + 4 + len("zstd"), "its data claim"),
    "record": (1, "record reaches beyond the data section"),
}


@pytest.mark.parametrize("claim", [1 << 40, 1 << 62, 1 << 63, (1 << 64) - 1])
@pytest.mark.parametrize("name", CLAIMS)
def test_chunk_that_claims_to_be_huge(tmp_path: Path, name: str, claim: int) -> None:
    """The sentence names file and offset; nothing is allocated for the claim."""
    log = tmp_path / "log.mcap"
    write_log(log, attachment=False, use_statistics=False)
    data = bytearray(log.read_bytes())
    start = 8 + 9 + int.from_bytes(data[9:17], "little")
    assert data[start] == 6  # the chunk
    place, reason = CLAIMS[name]
    data[start + place : start + place + 8] = claim.to_bytes(8, "little")
    log.write_bytes(data)
    before = read_files(tmp_path)
    for annotate in (annotate_in_place, annotate_there):
        with pytest.raises(LogError) as caught:
            annotate(log, Results(closures(), "a", {}, log_times=NO_TIMES))
        assert f"{log} is damaged at offset {start} ({reason}" in str(caught.value)
    assert read_files(tmp_path) == before
    with contextlib.closing(open_log(log)) as opened:
        assert list(opened.messages()) == []
        assert len(opened.problems) == 1
        assert f"byte {start}" in opened.problems[0].text


def annotate_there(log: Path, results: Results) -> object:
    return annotate_copy(log, log.with_name("out.mcap"), results)


def read_files(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir()}

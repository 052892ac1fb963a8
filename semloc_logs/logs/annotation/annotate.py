"""Loop closures into a log: as a copy, in place, or beside it; and what a log's content is without
them.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.records import Header

from semloc_logs import __version__
from semloc_logs.errors import LogError
from semloc_logs.logs.annotation.channels import (
    ClosureRecord,
    Encoding,
    LogFacts,
    channel_metadata,
    encode,
    is_old_marker,
    run_id,
)
from semloc_logs.logs.annotation.mcap_append import (
    MAGIC,
    METADATA_PREFIX,
    Ending,
    compose,
    content_end,
    definitions,
    empty_ending,
    hash_range,
    read_ending,
    read_header,
)
from semloc_logs.logs.annotation.rosbag_copy import QOS_KEY, bag_facts, opened, write_copy
from semloc_logs.logs.annotation.tail_swap import (
    SIDE_SUFFIX,
    copy_start,
    locked,
    recover,
    recover_locked,
    replace_end,
    sync_folder,
)

__all__ = [
    "AnnotateReport",
    "ClosureRecord",
    "Results",
    "annotate_copy",
    "annotate_in_place",
    "annotate_sidecar",
    "content_fingerprint",
    "recover",
]

LIBRARY = f"semloc_logs {__version__}"
_ENCODINGS: dict[str, Encoding] = {
    "cdr": "ros2",
    "ros1": "ros1",
    "protobuf": "protobuf",
    "json": "json",
}


@dataclass(frozen=True, slots=True)
class AnnotateReport:
    """What was written: ``closures`` in which the session takes part, ``messages`` of all topics,
    bytes from our first record to the end.

    ``replaced`` tells that earlier results of ours were taken away.
    """

    path: Path
    run_id: str
    encoding: Encoding
    closures: int
    messages: int
    bytes_written: int
    replaced: bool


@dataclass(frozen=True, slots=True)
class Results:
    """What is to be written, whatever the log: the ``closures`` in which ``session`` takes part,
    and the ``settings`` behind them.

    ``log_times`` maps the stamp (ns) of an end in this log to the receive time (ns) of the frame
    there; ``frame_id`` is the frame of the log's pose stream, for the markers; None:
    semloc/SESSION.
    """

    closures: Sequence[ClosureRecord]
    session: str
    settings: Mapping[str, str]
    log_times: Mapping[int, int]
    frame_id: str | None = None

    def end(self, path: Path, ending: Ending, facts: LogFacts) -> tuple[bytes, AnnotateReport]:
        """The bytes of the file from ``ending.offset`` on."""
        run = run_id(self.closures, self.session, self.settings, __version__)
        channels, messages = encode(
            self.closures,
            self.session,
            facts,
            log_times=self.log_times,
            frame_id=f"semloc/{self.session}" if self.frame_id is None else self.frame_id,
            size=_marker_size(self.settings),
            metadata=channel_metadata(run, __version__),
        )
        own = {f"setting.{key}": value for key, value in sorted(self.settings.items())}
        own |= {"version": __version__, "schema_version": "1", "session": self.session}
        data = compose(ending, channels, messages, f"{METADATA_PREFIX}{run}", own)
        count = sum(m.channel == 0 for m in messages)
        return data, AnnotateReport(
            path, run, facts.encoding, count, len(messages), len(data), ending.replaces
        )


def annotate_copy(
    log: Path, output: Path, results: Results, *, overwrite: bool = False
) -> AnnotateReport:
    """Write ``output`` (MCAP): all of ``log``, and the results.

    An MCAP log is copied undecoded; a .bag, a .db3 or a bag folder is converted, message by
    message. Raises ``LogError``, and leaves nothing behind, when the log is damaged or ``output``
    exists and ``overwrite`` is not set.
    """
    _refuse(log, output, overwrite)
    recover(log)
    if not _is_mcap(log):
        with opened(log) as readers, _published(output) as file:
            write_copy(log, readers, file, LIBRARY)
            file.flush()
            ending = read_ending(file, log)
            data, report = results.end(output, ending, bag_facts(log, readers))
            _finish(file, ending.offset, data)
            return report
    with (
        locked(log, shared=True) as source,
        os.fdopen(os.dup(source), "rb") as original,
        _published(output) as file,
    ):
        ending = read_ending(original, log)
        data, report = results.end(
            output, ending, _mcap_facts(log, read_header(original, log), ending)
        )
        copy_start(source, file.fileno(), ending.offset)
        _finish(file, ending.offset, data)
        return report


def annotate_in_place(log: Path, results: Results) -> AnnotateReport:
    """Write the results into ``log`` itself, an MCAP file; only its end is written. Errors as for
    :func:`annotate_copy`.

    An interruption at any point leaves a log that is whole, or that :func:`recover` makes whole.
    """
    if not log.exists():
        raise LogError(f"{log} does not exist; give the path of a log.")
    if not _is_mcap(log):
        raise LogError(
            f"{log} is no MCAP file, so it cannot take our channels; use `-o OUT.mcap` or `--sidecar OUT.mcap`."
        )
    with locked(log) as fd:
        recover_locked(log, fd)
        with os.fdopen(os.dup(fd), "rb") as file:
            ending = read_ending(file, log)
            data, report = results.end(
                log, ending, _mcap_facts(log, read_header(file, log), ending)
            )
        replace_end(log, fd, ending.offset, data)
        return report


def annotate_sidecar(
    log: Path, output: Path, results: Results, *, overwrite: bool = False
) -> AnnotateReport:
    """Write ``output``, an MCAP file of the log's profile and encoding with the results only.
    Errors as for :func:`annotate_copy`.
    """
    _refuse(log, output, overwrite)
    recover(log)
    if _is_mcap(log):
        with log.open("rb") as original:
            header = read_header(original, log)
            try:
                facts = _mcap_facts(log, header, read_ending(original, log))
            except LogError:  # a log that is cut off has its profile at least
                facts = _mcap_facts(log, header, empty_ending("", "")[1])
    else:
        with opened(log) as readers:
            facts = bag_facts(log, readers)
    start, ending = empty_ending(facts.profile, LIBRARY)
    with _published(output) as file:
        data, report = results.end(output, ending, facts)
        file.write(start)
        _finish(file, len(start), data)
        return report


def content_fingerprint(log: Path) -> str:
    """sha256 of the recorded content without our own records: annotating a log in place does not
    change it.

    ``log`` is a file, a bag folder, or the metadata.yaml in it. Reads every byte once.
    """
    folder = log.parent if log.name == "metadata.yaml" else log
    try:
        if not folder.is_dir():
            return _file_fingerprint(log)
        digest = hashlib.sha256()
        for path in sorted(
            p
            for p in folder.rglob("*")
            if p.is_file() and not p.name.startswith(".") and SIDE_SUFFIX not in p.name
        ):
            digest.update(bytes.fromhex(_file_fingerprint(path)))
        return digest.hexdigest()
    except OSError as error:
        raise LogError(
            f"{log} cannot be read ({error.strerror}); give the path of a readable log."
        ) from error


def _file_fingerprint(path: Path) -> str:
    stop = (content_end(path) if _is_mcap(path) else None) or path.stat().st_size
    with path.open("rb") as file:
        return str(hash_range(file, 0, stop).hexdigest())


def _mcap_facts(log: Path, header: Header, ending: Ending) -> LogFacts:
    """What our channels need to know of an MCAP log: the encoding of most of its channels, unless
    its profile says so.
    """
    schemas, channels = definitions(ending, log)
    counted = Counter(c.message_encoding for c in channels if c.message_encoding in _ENCODINGS)
    most = max(sorted(counted), key=lambda e: counted[e], default="json")
    by_profile: dict[str, Encoding] = {"ros1": "ros1", "ros2": "ros2"}
    encoding = by_profile.get(header.profile, _ENCODINGS[most])
    qos = sorted(
        (c.metadata[QOS_KEY] for c in channels if c.metadata.get(QOS_KEY)),
        key=lambda q: q.count("history"),
    )
    statistics = ending.summary.statistics
    profile = {"ros1": "ros1", "ros2": "ros2"}.get(encoding, header.profile)
    metadata = {QOS_KEY: qos[0] if qos else ""} if encoding == "ros2" else {}
    old_markers = encoding == "ros2" and any(is_old_marker(s.name, s.data) for s in schemas)
    start = statistics.message_start_time
    end = statistics.message_end_time
    return LogFacts(encoding, profile, metadata, start, end, statistics.message_count, old_markers)


def _marker_size(settings: Mapping[str, str]) -> float:
    """Markers grow with the voxels: 1 m at 0.30 m."""
    try:
        return max(1e-3, float(settings["fusion.voxel_size"]) / 0.3)
    except (KeyError, ValueError):
        return 1.0


def _is_mcap(log: Path) -> bool:
    try:
        if log.is_dir() or log.name == "metadata.yaml":
            return False
        with log.open("rb") as file:
            return log.suffix == ".mcap" or file.read(len(MAGIC)) == MAGIC
    except OSError as error:
        raise LogError(
            f"{log} cannot be read ({error.strerror}); give the path of a readable log."
        ) from error


def _refuse(log: Path, output: Path, overwrite: bool) -> None:
    if not log.exists():
        raise LogError(f"{log} does not exist; give the path of a log.")
    if output.exists():
        if output.samefile(log):
            raise LogError(f"{output} is the log itself; give another output, or use `--in-place`.")
        if output.is_dir() or not overwrite:
            raise LogError(f"{output} exists already; give another output, or `--overwrite`.")


@contextlib.contextmanager
def _published(output: Path) -> Iterator[BinaryIO]:
    """A file that becomes ``output`` when the block ends well, and vanishes when it does not."""
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        name = output.with_name(f".{output.name}.{os.getpid()}.tmp")
        fd = os.open(name, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
    except OSError as error:
        raise LogError(
            f"{output} cannot be written ({error.strerror}); give another output."
        ) from error
    try:
        with os.fdopen(fd, "w+b") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(name, output)
        sync_folder(output.parent)
    except BaseException as error:
        with contextlib.suppress(OSError):
            os.unlink(name)
        if isinstance(error, OSError):
            raise LogError(
                f"{output} could not be written ({error.strerror}); make room or give another output."
            ) from error
        raise


def _finish(file: BinaryIO, offset: int, data: bytes) -> None:
    """Write the end of a new file."""
    file.seek(offset)
    file.write(data)
    file.truncate()

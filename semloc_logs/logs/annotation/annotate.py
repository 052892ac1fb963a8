"""Loop closures into a log: as a copy, in place, or beside it; and a log's own content."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from semloc_logs import __version__
from semloc_logs.errors import LogError
from semloc_logs.logs.annotation.channels import (
    QOS_KEY,
    Encoder,
    Encoding,
    LogFacts,
    NewChannel,
    NewMessage,
    channel_metadata,
    is_old_marker,
)
from semloc_logs.logs.annotation.closure_messages import LogContext, encode, run_id
from semloc_logs.logs.annotation.closure_record import ClosureRecord
from semloc_logs.logs.annotation.mcap_append import (
    METADATA_PREFIX,
    AppendPlan,
    LogEnd,
    content_end,
    empty_end,
    hash_range,
    plan_append,
    read_end,
    read_header,
)
from semloc_logs.logs.annotation.rosbag_copy import (
    CALLER,
    bag_facts,
    opened,
    write_bag,
    write_copy,
)
from semloc_logs.logs.annotation.scene import NO_SCENE, Scene
from semloc_logs.logs.annotation.tail_swap import (
    SIDE_SUFFIX,
    copy_start,
    locked,
    recover,
    recover_locked,
    swap_tail,
)
from semloc_logs.logs.containers.mcap_records import MAGIC
from semloc_logs.logs.containers.memory import DEFAULT, Memory
from semloc_logs.logs.containers.rosbag2 import Rosbag2Log
from semloc_logs.logs.containers.sqlite_file import side_files
from semloc_logs.logs.remote import RemotePath, is_remote, uploading
from semloc_logs.tables.atomic_files import replacing_file
from semloc_logs.tables.metadata import SCHEMA_VERSION

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

_BLOCK = 1 << 22  # bytes copied at once from or to a server
LIBRARY = f"semloc_logs {__version__}"
_ENCODINGS: dict[str, Encoding] = {
    "cdr": "ros2",
    "ros1": "ros1",
    "protobuf": "protobuf",
    "json": "json",
}


@dataclass(frozen=True, slots=True)
class AnnotateReport:
    """What was written.

    ``closures`` in which the session takes part, ``messages`` of all topics, bytes from our first
    record to the end of the file. ``replaced``: earlier results of ours were taken away.
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
    """What is to be written, whatever the log.

    The ``closures`` in which ``session`` takes part, and the ``settings`` behind them.
    ``log_times`` maps the stamp (ns) of an end in this log to the receive time (ns) of the frame
    there; ``frame_id`` is the frame of the log's pose stream, for the markers; None:
    semloc/SESSION. ``scene`` places these frames, and the ones of other sessions. ``memory``: bytes
    of the log that may be in memory at once.
    """

    closures: Sequence[ClosureRecord]
    session: str
    settings: Mapping[str, str]
    log_times: Mapping[int, int]
    frame_id: str | None = None
    memory: int = DEFAULT
    scene: Scene = NO_SCENE

    def plan(self, output: Path, end: LogEnd, facts: LogFacts) -> tuple[AppendPlan, AnnotateReport]:
        """How a file that ends with ``end`` takes the results."""
        run = self.run_id
        channels, messages = self.encoded(facts)
        own = {f"setting.{key}": value for key, value in sorted(self.settings.items())}
        own |= {
            "version": __version__,
            "schema_version": str(SCHEMA_VERSION),
            "session": self.session,
        }
        plan = plan_append(end, channels, messages, f"{METADATA_PREFIX}{run}", own)
        size = len(plan.new_tail)
        return plan, self.report(output, facts, messages, size, replaced=end.replaces)

    @property
    def run_id(self) -> str:
        """What names this result."""
        return run_id(self.closures, self.session, self.settings, __version__)

    def encoded(self, facts: LogFacts) -> tuple[list[NewChannel], list[NewMessage]]:
        """The channels and messages in the encoding of a log."""
        frame_id = f"semloc/{self.session}" if self.frame_id is None else self.frame_id
        size = _marker_size(self.settings)
        context = LogContext(self.session, facts, self.log_times, frame_id, size, self.scene)
        metadata = channel_metadata(self.run_id, __version__)
        return encode(self.closures, context, encoder_for(facts), metadata)

    def report(
        self,
        output: Path,
        facts: LogFacts,
        messages: Sequence[NewMessage],
        size: int,
        *,
        replaced: bool,
    ) -> AnnotateReport:
        """What was written in ``size`` bytes."""
        return AnnotateReport(
            path=output,
            run_id=self.run_id,
            encoding=facts.encoding,
            closures=sum(m.channel == 0 for m in messages),
            messages=len(messages),
            bytes_written=size,
            replaced=replaced,
        )


def annotate_copy(
    log: Path, output: Path, results: Results, *, overwrite: bool = False
) -> AnnotateReport:
    """Write ``output`` (MCAP): all of ``log``, and the results.

    An MCAP log is copied undecoded; a .bag, a .db3 or a bag folder is converted, message by
    message. Of a .bag, an ``output`` that ends in .bag is a ROS 1 bag, too. Raises ``LogError``,
    and leaves nothing behind, when the log is damaged or ``output`` exists and ``overwrite`` is not
    set. Both may be addresses; RemoteError where a server fails.
    """
    _refuse(log, output, overwrite)
    recover(log)
    if output.suffix == ".bag":
        return _annotate_bag(log, output, results)
    if not _is_mcap(log):
        with opened(log, results.memory) as readers, _published(output) as file:
            write_copy(log, readers, file, LIBRARY, results.memory)
            file.flush()
            end = read_end(file, log, Memory(results.memory))
            plan, report = results.plan(output, end, bag_facts(log, readers))
            _finish(file, plan)
            return report
    with _source(log) as original, _published(output) as file:
        end = read_end(original, log, Memory(results.memory))
        plan, report = results.plan(output, end, _mcap_facts(end))
        if is_remote(log) or is_remote(output):
            _copy_bytes(original, file, plan.start)
        else:
            copy_start(original.fileno(), file.fileno(), plan.start)
        _finish(file, plan)
        return report


def _annotate_bag(log: Path, output: Path, results: Results) -> AnnotateReport:
    if log.suffix != ".bag" or _is_mcap(log) or is_remote(output):
        raise LogError(
            f"{output} would be a ROS 1 bag, which only a local copy of a .bag log can be: give"
            " the name of an MCAP file."
        )
    with opened(log, results.memory) as readers, _folder_for(output) as folder:
        facts = bag_facts(log, readers)
        channels, messages = results.encoded(facts)
        written = folder / output.name
        write_bag(log, readers, written, (channels, messages), results.memory)
        with replacing_file(output) as temporary:
            written.replace(temporary)
        replaced = any(c.ext.callerid == CALLER for c in readers[0].connections)
    size = sum(len(message.data) for message in messages)
    return results.report(output, facts, messages, size, replaced=replaced)


def annotate_in_place(log: Path, results: Results) -> AnnotateReport:
    """Write the results into ``log`` itself, an MCAP file; only its tail is written.

    Its end is read once, a plan is made of it, and the plan is applied. An interruption at any
    point leaves a log that is whole, or that :func:`recover` makes whole. Errors as for
    :func:`annotate_copy`.
    """
    if is_remote(log):
        raise LogError(
            f"{log} is on a server, where files cannot be changed in place; "
            "use `-o OUT.mcap` or `--sidecar OUT.mcap`."
        )
    if not log.exists():
        raise LogError(f"{log} does not exist; give the path of a log.")
    if not _is_mcap(log):
        raise LogError(
            f"{log} is no MCAP file, so it cannot take our channels; "
            "use `-o OUT.mcap` or `--sidecar OUT.mcap`."
        )
    with locked(log) as fd:
        recover_locked(log, fd)
        with os.fdopen(os.dup(fd), "rb") as file:
            end = read_end(file, log, Memory(results.memory))
        plan, report = results.plan(log, end, _mcap_facts(end))
        swap_tail(log, fd, plan)
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
        facts = _facts_for_sidecar(log, Memory(results.memory))
    else:
        with opened(log, results.memory) as readers:
            facts = bag_facts(log, readers)
    start, end = empty_end(facts.profile, LIBRARY)
    with _published(output) as file:
        plan, report = results.plan(output, end, facts)
        file.write(start)
        _finish(file, plan)
        return report


def content_fingerprint(log: Path) -> str:
    """sha256 of the recorded content without our own records.

    Annotating a log in place does not change it. ``log`` is a file, a bag folder, or the
    metadata.yaml in it. Reads every byte once; on a server that has strong ETags it hashes these.
    """
    folder = log.parent if log.name == "metadata.yaml" else log
    try:
        if not folder.is_dir():
            if folder == log:
                return _file_fingerprint(log)
            # of a web server that does not list folders
            with contextlib.closing(Rosbag2Log(folder)) as bag:
                parts = [_file_fingerprint(path) for path in (log, *bag.files)]
            return hashlib.sha256("".join(parts).encode()).hexdigest()
        digest = hashlib.sha256()
        for path in sorted(
            p
            for p in (folder.iterdir() if is_remote(folder) else folder.rglob("*"))
            if p.is_file()
            and not p.name.startswith(".")
            and SIDE_SUFFIX not in p.name
            and not p.name.endswith("-shm")  # the index of a -wal file, with its locks
        ):
            digest.update(bytes.fromhex(_file_fingerprint(path)))
        return digest.hexdigest()
    except OSError as error:
        raise LogError(
            f"{log} cannot be read ({error.strerror}); give the path of a readable log."
        ) from error


def _file_fingerprint(path: Path) -> str:
    if isinstance(path, RemotePath) and (tag := path.etag()) is not None:
        return hashlib.sha256(f"{path.stat().st_size} {tag}".encode()).hexdigest()
    stop = (content_end(path) if _is_mcap(path) else None) or path.stat().st_size
    with path.open("rb") as file:
        digest = hash_range(file, 0, stop)
    for side in side_files(path):
        with side.open("rb") as file:
            digest.update(hash_range(file, 0, side.stat().st_size).digest())
    return str(digest.hexdigest())


def _mcap_facts(end: LogEnd) -> LogFacts:
    """What our channels need to know of an MCAP log.

    The encoding is the one of most channels, unless its profile states it.
    """
    encodings = Counter(c.message_encoding for c in end.channels)
    known = [e for e in sorted(encodings) if e in _ENCODINGS]
    most = max(known, key=lambda e: encodings[e], default="json")
    by_profile: dict[str, Encoding] = {"ros1": "ros1", "ros2": "ros2"}
    encoding = by_profile.get(end.header.profile, _ENCODINGS[most])
    qos = [c.metadata[QOS_KEY] for c in end.channels if c.metadata.get(QOS_KEY)]
    qos.sort(key=lambda profiles: profiles.count("history"))
    is_ros2 = encoding == "ros2"
    statistics = end.summary.statistics
    return LogFacts(
        encoding=encoding,
        profile=encoding if encoding in by_profile else end.header.profile,
        channel_metadata={QOS_KEY: qos[0] if qos else ""} if is_ros2 else {},
        start_ns=statistics.message_start_time,
        end_ns=statistics.message_end_time,
        messages=statistics.message_count,
        old_markers=is_ros2 and any(is_old_marker(s.name, s.data) for s in end.schemas),
    )


def _facts_for_sidecar(log: Path, memory: Memory) -> LogFacts:
    with log.open("rb") as original:
        header = read_header(original, log)
        try:
            return _mcap_facts(read_end(original, log, memory))
        except LogError:  # a log that is cut off has its profile at least
            return _mcap_facts(empty_end(header.profile, LIBRARY)[1])


def encoder_for(facts: LogFacts) -> Encoder:
    """The writer of the log's encoding; the libraries behind it are loaded when they are needed."""
    encoding = facts.encoding
    if encoding == "ros1" or encoding == "ros2":
        from semloc_logs.logs.annotation.channels_ros import RosEncoder

        return RosEncoder(1 if encoding == "ros1" else 2, old_markers=facts.old_markers)
    from semloc_logs.logs.annotation.channels_foxglove import FoxgloveEncoder

    return FoxgloveEncoder(encoding)


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
        if output == log or (not (is_remote(output) or is_remote(log)) and output.samefile(log)):
            raise LogError(f"{output} is the log itself; give another output, or use `--in-place`.")
        if output.is_dir() or not overwrite:
            raise LogError(f"{output} exists already; give another output, or `--overwrite`.")


@contextlib.contextmanager
def _published(output: Path) -> Iterator[BinaryIO]:
    """A file that becomes ``output`` when the block ends well, and vanishes when it does not."""
    if isinstance(output, RemotePath):
        with uploading(output) as upload:
            yield upload
        return
    try:
        with replacing_file(output) as temporary, temporary.open("w+b") as file:
            yield file
    except OSError as error:
        raise LogError(
            f"{output} could not be written ({error.strerror}); make room or give another output."
        ) from error


@contextlib.contextmanager
def _folder_for(output: Path) -> Iterator[Path]:
    """A folder beside ``output`` for a writer that makes its file itself."""
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".scratch.", dir=output.parent) as name:
            yield Path(name)
    except OSError as error:
        raise LogError(
            f"{output} could not be written ({error.strerror}); make room or give another output."
        ) from error


@contextlib.contextmanager
def _source(log: Path) -> Iterator[BinaryIO]:
    """``log`` to read, locked against writers where it is a local file."""
    if is_remote(log):
        with log.open("rb") as file:
            yield file
        return
    with locked(log, shared=True) as fd, os.fdopen(os.dup(fd), "rb") as file:
        yield file


def _copy_bytes(source: BinaryIO, target: BinaryIO, length: int) -> None:
    """Copy the first ``length`` bytes of a file to another."""
    source.seek(0)
    while length > 0:
        block = source.read(min(length, _BLOCK))
        if not block:
            raise LogError("The log became shorter while it was copied; let its recording end.")
        target.write(block)
        length -= len(block)


def _finish(file: BinaryIO, plan: AppendPlan) -> None:
    """Write the tail of a new file."""
    file.seek(plan.start)
    file.write(plan.new_tail)
    file.truncate()

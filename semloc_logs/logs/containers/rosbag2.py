"""ROS 2 bags: directories of sqlite3 or MCAP files, or one such file.

Split or not, compressed or not, with or without metadata.yaml.
"""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Collection, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import yaml
import zstandard

from semloc_logs.errors import LogError
from semloc_logs.logs.containers.base import (
    BagFile,
    BaseLog,
    encoding_of,
    in_log_time_order,
    merged_streams,
)
from semloc_logs.logs.containers.mcap import McapLog
from semloc_logs.logs.containers.memory import Memory
from semloc_logs.logs.containers.sqlite import SqliteLog
from semloc_logs.logs.log import Log, Message, Section
from semloc_logs.logs.remote import is_remote

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_SUFFIXES = (".db3", ".mcap")
SPLIT_GAP_NS = 5 * 10**9  # between the files of one recording: a recorder splits without a pause
_MAX_METADATA = 4 << 20  # as objects it takes a hundred times as much
_FREE = 256 << 20  # bytes of a disk that stay free
_PLAUSIBLE_GROWTH = 200  # of a file that is zstd-compressed as a whole; logs shrink by less


class Rosbag2Log(BaseLog):
    """A ROS 2 bag directory. LogError when it holds no file that can be read."""

    def __init__(self, path: Path, memory: Memory | None = None) -> None:
        super().__init__(path, "rosbag2", memory)
        self.files: list[Path] = []  # as they lie in the directory
        self._files: list[Log] = []
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """The messages of ``topics`` (None: of all) of all files in log-time order."""
        parts = [
            (f.start_ns, partial(self._load, f, topics))
            for f in self._files
            if f.start_ns is not None
        ]
        return in_log_time_order(parts)

    def sections(self) -> list[Section]:
        """The sections of all files, by their first log time."""
        sections = [section for file in self._files for section in file.sections()]
        return sorted(sections, key=lambda section: section.start_ns)

    def close(self) -> None:
        """Releases the files."""
        for file in self._files:
            file.close()
        if self._folder is not None:
            self._folder.cleanup()

    def _open(self) -> None:
        metadata = self._metadata()
        self.files = self._files_of_metadata(metadata) if metadata else self._found()
        self._open_files(self.files)
        if not (self.path / "metadata.yaml").exists():
            self._check_splits()
        self.streams = merged_streams(self._files)
        self.encoding = encoding_of(self.streams) or self._files[0].encoding
        starts = [f.start_ns for f in self._files if f.start_ns is not None]
        self.start_ns = min(starts, default=None)
        self.end_ns = max((f.end_ns for f in self._files if f.end_ns is not None), default=None)
        claimed = metadata.get("message_count")
        count = sum(s.count for s in self.streams)
        if isinstance(claimed, int) and claimed != count:
            self._problems.add(
                f"{self.path / 'metadata.yaml'} claims {claimed} messages, but the files hold "
                f"{count}; the files count."
            )

    def _open_files(self, paths: list[Path]) -> None:
        """Opens the files that can be read; LogError when there are none."""
        failures = []
        for path in paths:
            try:
                self._files.append(self._open_file(path))
            except LogError as error:
                failures.append(str(error))
        if not self._files:
            raise LogError(
                failures[0]
                if failures
                else f"{self.path} holds no .db3, .mcap or compressed file of a ROS 2 bag."
            )
        for failure in failures:
            self._problems.add(failure)

    def _check_splits(self) -> None:
        """LogError where files without a metadata.yaml are not the splits of one recording.

        These follow each other in time and have names that differ in their numbers only.
        """
        timed = [f for f in self._files if f.start_ns is not None and f.end_ns is not None]
        timed.sort(key=lambda f: f.start_ns or 0)
        for before, after in pairwise(timed):
            pause_ns = (after.start_ns or 0) - (before.end_ns or 0)
            names = {re.sub(r"\d+", "", Path(f.path).name) for f in (before, after)}
            if abs(pause_ns) > SPLIT_GAP_NS or len(names) > 1:
                raise LogError(
                    f"{self.path} is not a ROS 2 bag: it has no metadata.yaml, and"
                    f" {Path(before.path).name} and {Path(after.path).name} are not splits of one"
                    f" recording; give its logs one by one, such as"
                    f" {self.path}/*{Path(after.path).suffix}."
                )

    def _metadata(self) -> dict[str, Any]:
        """The information of metadata.yaml; empty when it is missing or unusable."""
        path = self.path / "metadata.yaml"
        try:
            with path.open("rb") as file:
                text = file.read(_MAX_METADATA)
            if b"<<" in text:
                raise ValueError("it merges mappings")  # a few such lines can expand without end
            information = yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))[
                "rosbag2_bagfile_information"
            ]
        except FileNotFoundError:
            return {}
        except (
            OSError,
            yaml.YAMLError,
            ValueError,
            TypeError,
            LookupError,
            RecursionError,
            AttributeError,
        ) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            self._problems.add(
                f"{path} cannot be used ({reason}); all files of the folder were read instead."
            )
            return {}
        if not isinstance(information, dict):
            self._problems.add(f"{path} cannot be used; all files of the folder were read instead.")
            return {}
        return information

    def _files_of_metadata(self, metadata: dict[str, Any]) -> list[Path]:
        """The files that metadata.yaml names and that exist, whatever their folder was."""
        listed = metadata.get("relative_file_paths")
        names = (
            [PurePosixPath(p).name for p in listed if isinstance(p, str)]
            if isinstance(listed, list)
            else []
        )
        try:
            existing = self._found()
        except LogError:  # a web server need not list folders
            if not names or not is_remote(self.path):
                raise
            existing = []
        if not names:
            return existing
        paths = []
        for name in dict.fromkeys(names):
            candidates = [
                c
                for c in (name, f"{name}.zstd", name.removesuffix(".zstd"))
                if (self.path / c).is_file()
            ]
            if candidates:
                paths.append(self.path / candidates[0])
            else:
                self._problems.add(
                    f"{self.path / name} is missing although metadata.yaml names it; "
                    f"the other files were read."
                )
        if not paths:
            return existing
        for path in existing:
            if path not in paths and path.with_suffix("") not in paths:
                self._problems.add(f"{path} was not read because metadata.yaml does not name it.")
        return paths

    def _found(self) -> list[Path]:
        """All files that may belong to the bag; the plain one of a file that is also compressed."""
        try:
            every = sorted(p for p in self.path.iterdir() if p.is_file())
        except OSError as error:
            raise LogError(f"{self.path} cannot be read: {error.strerror}.") from error
        plain = [p for p in every if p.suffix in _SUFFIXES]
        packed = [
            p
            for p in every
            if p.suffix == ".zstd"
            and Path(p.stem).suffix in _SUFFIXES
            and p.with_suffix("") not in plain
        ]
        return sorted([*plain, *packed], key=_natural)

    def _open_file(self, path: Path) -> Log:
        bag_file = BagFile(path.name, self._problems)
        try:
            with path.open("rb") as file:
                head = file.read(16)
        except OSError as error:
            raise LogError(f"{path} cannot be opened: {error.strerror}.") from error
        if head.startswith(ZSTD_MAGIC):
            path = self._unpack(path)
            with path.open("rb") as file:
                head = file.read(16)
        if head.startswith(b"SQLite format 3\0"):
            return SqliteLog(path, self._memory, bag_file)
        return McapLog(path, self._memory, bag_file)

    def _unpack(self, path: Path) -> Path:
        """A decompressed copy in a temporary folder that lives as long as this log."""
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="semloc-")
        target = Path(self._folder.name) / path.stem
        try:
            with path.open("rb") as packed, target.open("wb") as plain:
                reader = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
                written = 0
                size = path.stat().st_size
                while piece := reader.read(1 << 22):
                    written += len(piece)
                    free = shutil.disk_usage(self._folder.name).free
                    if written > max(_PLAUSIBLE_GROWTH * size, self._memory.limit):
                        raise LogError(
                            f"{path} grows from {size} to more than {written} bytes, which no log "
                            "does; if it is right, decompress it first."
                        )
                    if free < _FREE:
                        raise LogError(
                            f"{path} needs more than the {written} bytes that "
                            f"{self._folder.name} can take; decompress it first."
                        )
                    plain.write(piece)
        except (zstandard.ZstdError, OSError) as error:
            if not target.exists() or target.stat().st_size == 0:
                raise LogError(f"{path} cannot be decompressed: {error}.") from error
            self._problems.add(
                f"{path} is damaged ({error}); the part that could be decompressed is used."
            )
        return target

    def _load(self, file: Log, topics: Collection[str] | None) -> Iterator[Message]:
        yield from file.messages(topics)


def _natural(path: Path) -> tuple[int, str]:
    """Splits in recording order: ``bag_2.db3`` before ``bag_10.db3``."""
    number = path.name.split(".")[0].rpartition("_")[2]
    return (int(number) if number.isdecimal() and len(number) < 10 else -1, path.name)

"""The sessions of a command: from LOG arguments, from a manifest, or from standard input."""

from __future__ import annotations

import csv
import functools
import glob
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .options import check_role

if TYPE_CHECKING:
    from semloc_logs.logs.remote import RemotePath
    from semloc_logs.stages.inputs import SessionInput

    from .options import PoseChoice

Function = Callable[..., Any]
STANDARD_INPUT = "-"
COLUMNS = ("name", "logs", "poses", "topics")  # of a manifest
SEPARATOR = ";"  # of several logs, or topics, in a cell of a manifest


@dataclass(frozen=True, slots=True)
class Entry:
    """Logs of one session as given; without a ``name`` it is called after the first one."""

    name: str | None
    logs: tuple[Path, ...]
    topics: Mapping[str, str] = field(default_factory=dict)
    poses: Path | None = None


@dataclass(frozen=True, slots=True)
class LogChoice:
    """The LOG arguments and --manifest."""

    logs: tuple[str, ...]
    manifest: Path | None

    def each(self) -> list[Entry]:
        """Each log as a session, and the sessions of the manifest."""
        return self._checked([*_given(self.logs), *self.listed()])

    def joined(self, name: str | None) -> list[Entry]:
        """All LOG arguments as one session, called ``name`` if it is given, and the manifest's."""
        parts = list(_given(self.logs))
        names = {e.name for e in parts if e.name is not None} | ({name} if name else set())
        if len(names) > 1:
            raise click.UsageError(
                f"The logs are one session and cannot be called {' and '.join(sorted(names))}:"
                " give one name, or use 'semloc run'."
            )
        logs = tuple(log for e in parts for log in e.logs)
        together = [Entry(next(iter(names), None), logs)] if logs else []
        return self._checked([*together, *self.listed()])

    def listed(self) -> Iterator[Entry]:
        """The sessions of the manifest."""
        return iter(()) if self.manifest is None else _listed(self.manifest)

    def _checked(self, entries: list[Entry]) -> list[Entry]:
        if not entries:
            raise click.UsageError("No LOG is given: name some, or a --manifest that does.")
        return entries


def logs_options(function: Function) -> Function:
    """LOG... and --manifest; the command gets ``logs``, a LogChoice."""

    @click.argument("logs", metavar="[NAME=]LOG...", nargs=-1)
    @click.option(
        "--manifest",
        type=click.Path(path_type=Path, allow_dash=True),
        metavar="FILE",
        help="Sessions as CSV with a header, or as JSON lines: name, logs, poses, topics; several"
        " logs are separated by ';'. Paths are relative to the file; '-' is standard input.",
    )
    @functools.wraps(function)
    def with_logs(*args: Any, logs: tuple[str, ...], manifest: Path | None, **rest: Any) -> Any:
        return function(*args, logs=LogChoice(logs, manifest), **rest)

    return with_logs


def session_inputs(
    entries: Iterable[Entry],
    topics: Mapping[str, str] | None = None,
    poses: PoseChoice | None = None,
) -> list[SessionInput]:
    """Each entry is a session; UsageError when two have the same name, or one cannot be a name."""
    from semloc_logs.logs.poses.trajectory_file import TrajectoryFile
    from semloc_logs.stages.inputs import SessionInput, session_name

    by_name: dict[str, Entry] = {}
    for entry in entries:
        name = checked_name(entry.name or session_name(entry.logs[0]))
        if name in by_name:
            raise click.UsageError(
                f"{by_name[name].logs[0]} and {entry.logs[0]} would both be session '{name}':"
                f" give one another name, as in {name}_2={entry.logs[0]}."
            )
        by_name[name] = entry
    files = {} if poses is None else poses.by_session(by_name)
    files |= {n: TrajectoryFile(e.poses) for n, e in by_name.items() if e.poses is not None}
    return [
        SessionInput(name, entry.logs, {**(topics or {}), **entry.topics}, files.get(name))
        for name, entry in by_name.items()
    ]


def checked_name(name: str) -> str:
    """A session's name; UsageError when it cannot be a folder's."""
    from semloc_logs.errors import WorkspaceError
    from semloc_logs.workspace import checked_name as checked

    try:
        return checked(name)
    except WorkspaceError as error:
        raise click.UsageError(str(error)) from None


def _given(logs: Iterable[str]) -> Iterator[Entry]:
    for text in logs:
        if text == STANDARD_INPUT:
            lines = (line.strip() for line in sys.stdin)
            yield from _given(line for line in lines if line and line != STANDARD_INPUT)
            continue
        name, equals, log = text.partition("=")
        if not equals or "/" in name or Path(text).exists():
            name, log = "", text
        paths = _expanded(log)
        if name and len(paths) > 1:
            raise click.UsageError(f"{text} names {len(paths)} logs: a name is of one session.")
        yield from (Entry(name or None, (path,)) for path in paths)


def _expanded(text: str) -> list[Path]:
    """The paths that a pattern such as ``drives/*.mcap`` matches; other paths as they are."""
    from semloc_logs.logs.remote import RemotePath, log_path

    path = log_path(text)
    if isinstance(path, RemotePath):
        return _matches(path) if path.scheme in ("s3", "gs") and glob.has_magic(text) else [path]
    if glob.has_magic(text) and not Path(text).exists():
        paths = sorted(Path(p) for p in glob.glob(text))
        if not paths:
            raise click.UsageError(f"{text} matches no file.")
        return paths
    return [Path(text)]


def _matches(pattern: RemotePath) -> list[Path]:
    """The files on a server that a pattern matches; itself where it is the name of one."""
    matches = pattern.matches()
    if not matches and pattern.exists():
        return [pattern]
    if not matches:
        raise click.UsageError(f"{pattern} matches no file.")
    return list(matches)


def _listed(manifest: Path) -> Iterator[Entry]:
    """The entries of a manifest. UsageError names its line where one cannot be used."""
    is_stream = str(manifest) == STANDARD_INPUT
    try:
        text = sys.stdin.read() if is_stream else manifest.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as problem:
        raise click.UsageError(f"The manifest {manifest} cannot be read: {problem}.") from None
    folder = Path() if is_stream else manifest.parent
    for number, row in _rows(text, manifest):
        unknown = sorted(str(k) for k in row if k not in COLUMNS)
        if unknown:
            raise click.UsageError(
                f"{manifest}, line {number}: unknown column {unknown[0]!r}; there are"
                f" {', '.join(COLUMNS)}."
            )
        logs = tuple(_beside(folder, log) for log in _several(row.get("logs")))
        if not logs:
            raise click.UsageError(f"{manifest}, line {number}: it names no logs.")
        topics = row.get("topics") or {}
        if not isinstance(topics, Mapping):
            pairs = [part.partition("=") for part in _several(topics)]
            if not all(role and equals and topic for role, equals, topic in pairs):
                raise click.UsageError(
                    f"{manifest}, line {number}: topics are of the form ROLE=TOPIC;ROLE=TOPIC."
                )
            topics = {role: topic for role, _, topic in pairs}
        for role in topics:
            check_role(role)
        poses = folder / str(row["poses"]) if row.get("poses") else None
        yield Entry(str(row["name"]) if row.get("name") else None, logs, topics, poses)


def _rows(text: str, manifest: Path) -> Iterator[tuple[int, Mapping[str, Any]]]:
    """Line numbers and rows of JSON lines or of CSV."""
    if not text.lstrip().startswith("{"):
        reader = csv.DictReader(text.splitlines(), skipinitialspace=True)
        for row in reader:
            yield reader.line_num, {str(k).strip(): v for k, v in row.items() if k is not None}
        return
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        content = None
        with suppress(ValueError):
            content = json.loads(line)
        if not isinstance(content, dict):
            raise click.UsageError(f"{manifest}, line {number}: not a JSON object.")
        yield number, content


def _beside(folder: Path, log: str) -> Path:
    """A log as a manifest names it: relative to its folder, or an address."""
    from semloc_logs.logs.remote import is_remote, log_path

    path = log_path(log)
    return path if is_remote(path) else folder / path


def _several(cell: Any) -> list[str]:
    parts = cell if isinstance(cell, list) else str(cell or "").split(SEPARATOR)
    return [str(part).strip() for part in parts if str(part).strip()]

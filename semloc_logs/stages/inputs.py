"""What the stages share: the logs of a session, and fingerprints."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

import semloc_logs
from semloc_logs.errors import WorkspaceError
from semloc_logs.logs.poses.trajectory_file import TrajectoryFile
from semloc_logs.tables.table import read_json


@dataclass(frozen=True, slots=True)
class SessionInput:
    """One session to fuse: its logs, recorded back to back; topics by role where the log leaves the
    choice open; and a file of poses instead of the poses of the logs.
    """

    name: str
    logs: tuple[Path, ...]
    topics: Mapping[str, str] = field(default_factory=dict)
    poses: TrajectoryFile | None = None


class Redo(Enum):
    """Which work of fusing is done again although it was done, or failed, before."""

    NOTHING = "nothing"
    FAILED = "failed"
    EVERYTHING = "everything"

    @staticmethod
    def of(*, overwrite: bool = False, retry_failed: bool = False) -> Redo:
        """By the options of a command; ``overwrite`` includes what failed."""
        if overwrite:
            return Redo.EVERYTHING
        return Redo.FAILED if retry_failed else Redo.NOTHING


def session_name(log: Path) -> str:
    """The name of a log's session: the file's stem or the directory's name."""
    log = log.absolute()
    if log.name == "metadata.yaml":
        log = log.parent
    return log.name if log.is_dir() else log.stem


def fingerprint_of(parts: Iterable[str]) -> str:
    """Hash of the program's version and of ``parts``: what a stage's outputs depend on."""
    text = "\n".join((semloc_logs.__version__, *parts))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def recorded_fingerprint(path: Path) -> str | None:
    """The fingerprint in a JSON file that a stage wrote last; None where it is not done."""
    try:
        return str(read_json(path)["fingerprint"])
    except (WorkspaceError, KeyError):
        return None

"""Versions of what a benchmark keeps: a hash of the files that decide about it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path

import semloc_logs

SUFFIXES = (".py", ".json", ".safetensors")  # code, calibrations, weights and vocabularies
DIGITS = 12  # of a version


def files_version(paths: Iterable[Path]) -> str:
    """A hash of the content of files."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:DIGITS]


def room_files(rooms: Sequence[str]) -> list[Path]:
    """The files of some of our packages, at all depths, in their order."""
    folders = [Path(semloc_logs.__file__).parent / room for room in rooms]
    return [
        path for folder in folders for path in sorted(folder.rglob("*")) if path.suffix in SUFFIXES
    ]


def code_version(rooms: Sequence[str]) -> str:
    """A hash of the files of some of our packages."""
    return files_version(room_files(rooms))


def simulation_version() -> str:
    """A hash of the modules of the simulation."""
    return code_version(("simulation",))

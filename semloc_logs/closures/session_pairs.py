"""Pairs of sessions: which one is searched in which, and its alignments so far.

The later recorded session is the query, the earlier one the target, and each session is searched in
itself. So pairs do not depend on when sessions were added, and a new one leaves the others alone.
"""

from __future__ import annotations

import glob
import shutil
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from semloc_logs.closures.alignment_tables import Part, by_target, joined, read_parts
from semloc_logs.closures.tracks import are_apart, sure_track
from semloc_logs.errors import WorkspaceError
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.tables.atomic_files import remove_file
from semloc_logs.tables.table import read_metadata, write_table
from semloc_logs.workspace import Workspace


@dataclass(frozen=True, slots=True, order=True)
class Pair:
    """A session whose queries are searched, and the one they are searched in."""

    query: str
    target: str


def pairs_of_sessions(maps: Mapping[str, SessionMap]) -> list[Pair]:
    """All pairs of sessions, each once, by the names of query and target.

    A log without poses has no map to be searched in: it is the query of those that have one.
    Sessions that satellites tell apart are left out. A map of points has no revisits of its own.
    """
    order = sorted(maps, key=lambda n: (not maps[n].posed, int(maps[n].stamps_ns[0]), n))
    tracks = {name: sure_track(session) for name, session in maps.items()}
    pairs = [
        Pair(query, target)
        for number, query in enumerate(order)
        for target in order[: number + 1]
        if (
            not maps[query].is_map
            if query == target
            else not are_apart(tracks[query], tracks[target])
        )
    ]
    return sorted(pairs)


def known_pairs(work: Workspace) -> dict[Pair, str]:
    """The pairs whose alignments are there, with the fingerprints of what they were made from."""
    pairs: dict[Pair, str] = {}
    for query, target in work.aligned_pairs():
        pairs |= known_pair(work, Pair(query, target))
    return pairs


def known_pair(work: Workspace, pair: Pair) -> dict[Pair, str]:
    """The same of one pair; empty where its alignments are missing."""
    path = work.alignments(pair.query, pair.target)
    if not path.exists():
        return {}
    try:
        return {pair: str(read_metadata(path).get("fingerprint"))}
    except WorkspaceError:  # damaged
        return {pair: ""}


def forget(work: Workspace, pairs: Iterable[Pair]) -> None:
    """Remove the alignments of pairs."""
    for pair in pairs:
        path = work.alignments(pair.query, pair.target)
        remove_file(path)
        for folder in (path.parent, path.parent.parent):
            if not any(folder.iterdir()):
                folder.rmdir()


@dataclass(frozen=True, slots=True)
class Missing:
    """Queries of a session, in chunks, and the targets that each has still to be searched in.

    New parts go to ``folder``.
    """

    session: str
    folder: Path
    fingerprints: Mapping[str, str]  # of the pairs, by target
    chunks: Sequence[tuple[int, ...]]
    parts: Sequence[Part]

    def targets(self, chunk: tuple[int, ...]) -> dict[str, str]:
        """The targets without a part of this chunk, with their fingerprints."""
        return {t: f for t, f in self.fingerprints.items() if self._part(chunk, t) is None}

    def _part(self, chunk: tuple[int, ...], target: str) -> Part | None:
        for part in self.parts:
            is_same = part.targets.get(target) == self.fingerprints[target]
            if is_same and part.keyframes == chunk:
                return part
        return None

    def of(self, target: str) -> list[Part]:
        """The parts of a target, in the order of the chunks."""
        parts = [self._part(chunk, target) for chunk in self.chunks]
        return [part for part in parts if part is not None]


def missing(
    work: Workspace,
    session: str,
    fingerprints: Mapping[str, str],
    chunks: Sequence[tuple[int, ...]],
    alone: str | None = None,
) -> Missing:
    """What is left to search of a session, by the parts that are there.

    ``alone``: the only target that this process searches, while others search others.
    """
    common = work.search_parts(session)
    own = "*" if alone is None else glob.escape(alone)
    paths = sorted([*common.glob("*.parquet"), *common.glob(f"target={own}/*.parquet")])
    folder = work.search_parts(session, alone)
    return Missing(session, folder, fingerprints, chunks, read_parts(paths))


def finish(work: Workspace, done: Missing, metadata: Mapping[str, Mapping[str, object]]) -> None:
    """Parts of all chunks -> a table for each target, with its metadata; the parts are removed."""
    queries = sum(len(chunk) for chunk in done.chunks)
    tables = {part.path: by_target(part.path) for part in done.parts}
    for target, fingerprint in done.fingerprints.items():
        content = {**metadata[target], "fingerprint": fingerprint, "queries": queries}
        of_parts = (tables[part.path].get(target) for part in done.of(target))
        table = joined(t for t in of_parts if t is not None)
        write_table(work.alignments(done.session, target), table, content, ("query_keyframe",))
    shutil.rmtree(done.folder, ignore_errors=True)
    with suppress(OSError):  # other targets are searched still
        done.folder.parent.rmdir()

"""Which segments hold which sessions: WORK/index/VARIANT, a cache of words/.

Any process may build it, and anyone delete it. The files are the only list of segments: a session
is served by the largest segment that holds it under the present key of its words. Sessions that no
segment holds are built from words/; sessions that are not wanted any more are passed over and left
out of the next merge. After building, segments are merged so that each is at least as large as all
smaller ones together (Bentley and Saxe 1980): there are logarithmically many, and an entry is
copied as often. One process at a time builds; the others wait for it and find it done.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from filelock import FileLock
from numpy.typing import NDArray

from semloc_logs.errors import WorkspaceError
from semloc_logs.tables.table import read_json, read_table
from semloc_logs.voxels.store import blocks_path
from semloc_logs.words.segment import (
    WORDS,
    Columns,
    Held,
    Segment,
    in_order,
    open_segment,
    segment_in_memory,
    write_segment,
)
from semloc_logs.workspace import SessionFolder, Workspace

SUFFIX = ".segment"
BATCH = 4_000_000  # entries that are sorted in memory at once
ATTEMPTS = 5  # at reading segments that another process merges meanwhile


def read_words(folder: SessionFolder, submap: int, variant: str) -> pa.Table:
    """The table of a submap's words of one variant, in the order that ``row`` counts."""
    table = read_table(blocks_path(folder.words, submap))
    return table.filter(pc.equal(table["variant"], variant))


@dataclass(frozen=True, slots=True)
class SessionWords:
    """The words of a session: their ``key`` changes whenever they are written again."""

    folder: SessionFolder
    key: str
    submaps: tuple[int, ...]

    def read(self, variant: str) -> Columns:
        """Unsorted columns of a segment that holds this session alone."""
        parts: list[Columns] = []
        for place, submap in enumerate(self.submaps):
            table = read_words(self.folder, submap, variant)
            n = len(table)
            columns = {
                "word": table["word"].to_numpy().astype(np.int64),
                "code": table["code"].to_numpy(),
            }
            columns |= {"place": np.full(n, place, np.uint32), "row": np.arange(n, dtype=np.uint32)}
            columns["centre"] = np.stack([table[c].to_numpy().astype(np.float32) for c in "xyz"], 1)
            columns["yaw"] = (
                table["yaw"].to_numpy() if "yaw" in table.column_names else np.zeros(n, np.float32)
            )
            parts.append(columns)
        return _joined(parts)


def session_words(folder: SessionFolder, variant: str) -> SessionWords | None:
    """The words of a session, None where it was not described in ``variant``."""
    try:
        content = folder.words_json.read_bytes()
        # the stamp, as words may be written again with the same settings by other weights of the
        # same version
        key = hashlib.sha256(
            content + str(folder.words_json.stat().st_mtime_ns).encode()
        ).hexdigest()[:16]
        if variant not in read_json(folder.words_json)["variants"]:
            return None
        return SessionWords(
            folder, key, tuple(int(s["id"]) for s in read_json(folder.session_json)["submaps"])
        )
    except (OSError, WorkspaceError, KeyError):
        return None


def session_segment(folder: SessionFolder, variant: str) -> Segment | None:
    """The words of one session in memory, None where it was not described in ``variant``."""
    words = session_words(folder, variant)
    return None if words is None else _in_memory([(words, words.read(variant))])


@dataclass(slots=True, eq=False)
class Change:
    """The work of :func:`segments`.

    Sessions ``added``, segments ``merged`` into others, files ``dropped`` as damaged or of no use
    any more; ``unwritten`` is the reason why segments are in memory alone.
    """

    added: int = 0
    merged: int = 0
    dropped: int = 0
    unwritten: str = ""

    def __str__(self) -> str:
        parts = [
            (self.added, "added", "session"),
            (self.merged, "merged", "segment"),
            (self.dropped, "removed", "old file"),
        ]
        done = [f"{n} {what}{'' if n == 1 else 's'} {verb}" for n, verb, what in parts if n]
        return ", ".join(
            done
            + (
                [f"kept in memory as it cannot be written ({self.unwritten})"]
                if self.unwritten
                else []
            )
        )


def segments(
    work: Workspace, variant: str, names: Sequence[str], change: Change | None = None
) -> list[tuple[Segment, frozenset[str]]]:
    """Segments with the sessions ``names`` that each serves; missing ones are built first.

    New segments are merged with the present ones. Sessions that were described in another variant
    only are left out. ``change`` records the work. WorkspaceError when a session was not described.
    """
    change = change or Change()
    folder = work.segments(variant)
    words = {f.name: w for f in work.sessions() if (w := session_words(f, variant)) is not None}
    lacking = [n for n in names if not work.session(n).words_json.exists()]
    if lacking:
        raise WorkspaceError(
            f"Session {lacking[0]} has no words: run 'semloc describe -w {work.path}' first."
        )
    names = [n for n in names if n in words]
    opened, good = _open_all(folder, variant)
    serving = _serving(opened, words)
    if not good or set(names) - set().union(*serving.values()) or _wasteful(serving):
        with _locked(folder):
            serving = _build(folder, variant, words, names, change)
    wanted = frozenset(names)
    return [(s, served & wanted) for s, served in serving.items() if served & wanted]


def update(work: Workspace) -> dict[str, dict[str, Any]]:
    """Bring the index of every variant up to date after checking all of its files.

    For each variant the change ``changed``, a sentence, and its ``segments``: ``file``, ``words``,
    ``bytes``, ``sessions``. Raises WorkspaceError when no session was described.
    """
    described = [f for f in work.sessions() if f.words_json.exists()]
    variants = sorted({str(v) for f in described for v in read_json(f.words_json)["variants"]})
    if not variants:
        raise WorkspaceError(
            f"{work.path} has no described session: run 'semloc describe -w {work.path}' first."
        )
    out: dict[str, dict[str, Any]] = {}
    for variant in variants:
        folder = work.segments(variant)
        change = Change()
        with _locked(folder):
            _remove_damaged(_open_all(folder, variant)[0], variant)
        held = [
            {
                "file": str(s.path.relative_to(work.path)) if s.path else "",
                "words": len(s),
                "bytes": s.path.stat().st_size if s.path else 0,
                "sessions": sorted(served),
            }
            for s, served in segments(work, variant, [f.name for f in described], change)
        ]
        out[variant] = {"changed": str(change), "segments": held}
    return out


Serving = dict[Segment, frozenset[str]]


def _open_all(folder: Path, variant: str) -> tuple[list[Segment], bool]:
    """All whole segments, the largest first, and whether there are no other files of segments."""
    for _ in range(ATTEMPTS):
        out = []
        good = True
        try:
            for path in sorted(folder.glob(f"*{SUFFIX}")):
                try:
                    out.append(open_segment(path, variant))
                except WorkspaceError:
                    good = False
            return sorted(out, key=lambda s: (-len(s), s.path)), good
        except FileNotFoundError:  # merged by another process after it was listed
            continue
    return [], True


def _serving(opened: Sequence[Segment], words: Mapping[str, SessionWords]) -> Serving:
    """The sessions that each segment serves.

    Each session is served by the first segment that holds its present words.
    """
    taken: set[str] = set()
    out: Serving = {}
    for segment in opened:
        served = {
            h.name for h in segment.sessions if h.name in words and words[h.name].key == h.key
        } - taken
        taken |= served
        out[segment] = frozenset(served)
    return out


def _live(segment: Segment, served: frozenset[str]) -> int:
    return sum(h.entries for h in segment.sessions if h.name in served)


def _wasteful(serving: Serving) -> bool:
    """Whether a segment is of no use, or more than half of one is."""
    return any(not served or 2 * _live(s, served) < len(s) for s, served in serving.items())


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """One process at a time, where files can be locked.

    Elsewhere two may build the same files, and the later rename wins.
    """
    lock = FileLock(folder / ".lock")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except (OSError, NotImplementedError):
        yield
        return
    try:
        yield
    finally:
        lock.release()


def _build(
    folder: Path,
    variant: str,
    words: Mapping[str, SessionWords],
    names: Sequence[str],
    change: Change,
) -> Serving:
    """Add the sessions that no segment serves, merge, and remove the files that are replaced.

    The caller has the lock.
    """
    for path in folder.glob(f".*{SUFFIX}.*.tmp"):  # of a process that was killed
        path.unlink(missing_ok=True)
    serving = _serving(_open_all(folder, variant)[0], words)
    lacking = sorted(set(names) - set().union(*serving.values()))
    change.added += len(lacking)
    for segment in _new_segments(variant, [words[n] for n in lacking]):
        serving[_written(folder, variant, segment, change)] = frozenset(
            h.name for h in segment.sessions
        )
    merged: Serving = {}
    for group in _plan(serving):
        if len(group) == 1 and 2 * _live(group[0], serving[group[0]]) >= len(group[0]):
            merged[group[0]] = serving[group[0]]
        elif _remove_damaged(group, variant):
            return _build(folder, variant, words, names, change)
        else:
            merged |= _merged(folder, variant, {s: serving[s] for s in group}, change)
    if not change.unwritten:
        for path in set(folder.glob(f"*{SUFFIX}")) - {s.path for s in merged}:
            change.dropped += 1
            path.unlink(missing_ok=True)
    return merged


def _remove_damaged(group: Sequence[Segment], variant: str) -> bool:
    """What is copied is checked first: opening has looked at the headers alone."""
    damaged = []
    for path in (s.path for s in group if s.path is not None):
        try:
            open_segment(path, variant, check=True)
        except WorkspaceError:
            damaged.append(path)
            path.unlink(missing_ok=True)
    return bool(damaged)


def _new_segments(variant: str, sessions: Sequence[SessionWords]) -> Iterator[Segment]:
    """Segments in memory of some sessions each."""
    batch: list[tuple[SessionWords, Columns]] = []
    for s in sessions:
        batch.append((s, s.read(variant)))
        if sum(len(columns["word"]) for _, columns in batch) >= BATCH:
            yield _in_memory(batch)
            batch = []
    if batch:
        yield _in_memory(batch)


def _in_memory(batch: Sequence[tuple[SessionWords, Columns]]) -> Segment:
    held = []
    parts = []
    places = 0
    for s, columns in batch:
        held.append(Held(s.folder.name, s.key, s.submaps, len(columns["word"])))
        parts.append(columns | {"place": columns["place"] + np.uint32(places)})
        places += len(s.submaps)
    return segment_in_memory(tuple(held), _joined(parts))


def _joined(parts: Sequence[Columns]) -> Columns:
    if not parts:
        empty = np.zeros(0, np.uint32)
        return {
            "word": empty,
            "code": empty,
            "place": empty,
            "row": empty,
            "centre": np.zeros((0, 3), np.float32),
            "yaw": empty,
        }
    return {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}


def _plan(serving: Serving) -> list[list[Segment]]:
    """Segments to be merged, or alone.

    Of the largest first each is as large as all behind it, or merged with them.
    """
    left = sorted(
        (s for s, served in serving.items() if served),
        key=lambda s: (-_live(s, serving[s]), s.sessions[0].name),
    )
    for i, s in enumerate(left):
        behind = sum(_live(o, serving[o]) for o in left[i + 1 :])
        if i + 1 < len(left) and _live(s, serving[s]) < behind:
            return [[s] for s in left[:i]] + [left[i:]]
    return [[s] for s in left]


def _path(folder: Path, sessions: Sequence[Held]) -> Path:
    """The file of a segment that holds ``sessions``, the same whichever process writes it."""
    held = "\n".join(f"{h.name} {h.key} {h.submaps}" for h in sessions)
    return folder / f"{hashlib.sha256(held.encode()).hexdigest()[:16]}{SUFFIX}"


def _written(folder: Path, variant: str, segment: Segment, change: Change) -> Segment:
    """A segment in memory as a file, or itself where none can be written."""
    path = _path(folder, segment.sessions)
    try:
        write_segment(path, variant, segment.sessions, [segment.block(0, WORDS)])
        return open_segment(path, variant)
    except OSError as problem:  # a workspace that cannot be written to, a full disk
        change.unwritten = str(problem)
        return segment


def _merged(folder: Path, variant: str, group: Serving, change: Change) -> Serving:
    """One segment of the sessions that a ``group`` of segments serves.

    The group itself where it cannot be written.
    """
    sessions = tuple(
        sorted(
            (h for s, served in group.items() for h in s.sessions if h.name in served),
            key=lambda h: h.name,
        )
    )
    path = _path(folder, sessions)
    try:
        write_segment(
            path,
            variant,
            sessions,
            merged_blocks(list(group), [_renumbered(s, group[s], sessions) for s in group]),
        )
        change.merged += len(group)
        return {open_segment(path, variant): frozenset(h.name for h in sessions)}
    except OSError as problem:
        change.unwritten = str(problem)
        return group


def _renumbered(
    segment: Segment, served: frozenset[str], sessions: Sequence[Held]
) -> NDArray[np.int64]:
    """The numbers of a segment's places among ``sessions``, -1 for sessions it does not serve."""
    numbers = {
        place: i
        for i, place in enumerate((h.name, submap) for h in sessions for submap in h.submaps)
    }
    return segment.numbered(numbers, served)


def merged_blocks(
    group: Sequence[Segment], places: Sequence[NDArray[np.int64]], most: int = 1_000_000
) -> Iterator[Columns]:
    """Sorted blocks of about ``most`` entries of several segments, whose places are numbered anew.

    -1 leaves out.
    """
    ends = sum((s.starts.astype(np.int64) for s in group), np.zeros(WORDS + 1, np.int64))
    first = 0
    while first < WORDS:
        last = max(first + 1, int(np.searchsorted(ends, ends[first] + most, "right")) - 1)
        parts = []
        for s, number in zip(group, places, strict=True):
            block = s.block(first, last)
            block["place"] = number[block["place"]]
            kept = block["place"] >= 0
            parts.append(
                block if kept.all() else {name: values[kept] for name, values in block.items()}
            )
        yield in_order(_joined(parts))
        first = last

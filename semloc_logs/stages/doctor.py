"""Every file of a workspace checked: whether it can be read, has its columns, rows and origin."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from semloc_logs.closures.session_pairs import known_pairs
from semloc_logs.errors import SemlocError
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import Resolved, Settings
from semloc_logs.stages.close import is_decided
from semloc_logs.stages.describe import check_settings, words_fingerprint
from semloc_logs.stages.inputs import recorded_fingerprint
from semloc_logs.stages.pair_search import pair_fingerprints
from semloc_logs.stages.state import read_kept
from semloc_logs.tables import contracts
from semloc_logs.tables.table import read_json
from semloc_logs.workspace import SessionFolder, Workspace


@dataclass(frozen=True, slots=True)
class Finding:
    """A fault of a file, and what to run to mend it."""

    path: Path
    fault: str
    remedy: str


@dataclass(slots=True)
class Examination:
    """The checks, and their findings."""

    files: int = 0
    rows: int = 0
    findings: tuple[Finding, ...] = ()


def examine(work: Workspace) -> Examination:
    """Check every file of a workspace. WorkspaceError where it holds no sessions."""
    work.chosen(())
    out = Examination()
    findings: list[Finding] = []
    try:
        settings = (read_kept(work) or Settings()).resolved()
    except SemlocError as problem:
        settings = Settings().resolved()
        findings.append(Finding(work.settings, str(problem), f"rm {work.settings}"))
    for folder in work.sessions():
        findings += _session(work, folder, settings, out)
    if not findings:
        findings += _pairs(work, settings, out)
    findings += _left_behind(work)
    out.findings = tuple(findings)
    return out


def _session(
    work: Workspace, folder: SessionFolder, settings: Resolved, out: Examination
) -> Iterator[Finding]:
    again = f"semloc fuse LOG -w {work.path} --session {folder.name} --overwrite"
    try:
        session = SessionMap(folder)
        content = session.json
        logs = " ".join(str(log["path"]) for log in content["logs"])
        again = f"semloc fuse {logs} -w {work.path} --session {folder.name} --overwrite"
        check_settings(session, settings)
    except (SemlocError, KeyError, TypeError) as problem:
        yield Finding(folder.session_json, str(problem), again)
        return
    counts = {"frames": content.get("keyframes"), "voxels": content.get("voxels")}
    fixes = ["fixes"] if folder.fixes.exists() else []  # sessions of earlier versions lack them
    for name in ("trajectory", "frames", "ground", "keyframes", "voxels", "blocks", *fixes):
        yield from _tables(getattr(folder, name), name, counts.get(name), again, out)

    describe = f"semloc describe {folder.name} -w {work.path}"
    if recorded_fingerprint(folder.words_json) != words_fingerprint(session, settings):
        yield Finding(folder.words_json, "the words are missing, or of another map", describe)
        return
    words = read_json(folder.words_json)["words"]
    yield from _tables(folder.words, "words", words, f"{describe} --overwrite", out)


def _pairs(work: Workspace, settings: Resolved, out: Examination) -> Iterator[Finding]:
    close = f"semloc close -w {work.path}"
    expected = pair_fingerprints({f.name: SessionMap(f) for f in work.sessions()}, settings)
    known = known_pairs(work)
    for pair, fingerprint in expected.items():
        path = work.alignments(pair.query, pair.target)
        if pair not in known:
            yield Finding(path, f"{pair.query} was not searched in {pair.target} yet", close)
        elif known[pair] != fingerprint:
            yield Finding(path, "the alignments are damaged, or of other maps or settings", close)
        else:
            yield from _tables(path, "alignments", None, f"rm {path} && {close}", out)
    for pair in known.keys() - expected.keys():
        path = work.alignments(pair.query, pair.target)
        yield Finding(path, "the alignments are of sessions that are gone", close)
    for path, name in ((work.closures, "closures"), (work.rejected, "rejected")):
        if known and (path.exists() or work.closures.exists()):
            yield from _tables(path, name, None, f"{close} --overwrite", out)
    if work.closures.exists() and not is_decided(work, settings):
        yield Finding(work.closures, "it was not decided from the alignments that are there", close)


def _tables(
    path: Path, name: str, rows: int | None, remedy: str, out: Examination
) -> Iterator[Finding]:
    """Faults of a table, or of all tables below a folder, which hold ``rows`` together."""
    paths = sorted(path.rglob("*.parquet")) if path.is_dir() else [path]
    total = 0
    for file in paths:
        fault, count = _fault(file, name)
        out.files += 1
        out.rows += count
        total += count
        if fault:
            yield Finding(file, fault, remedy)
            return
    if rows is not None and total != rows:
        yield Finding(path, f"{total} rows are there of {rows}", remedy)


def _fault(path: Path, name: str) -> tuple[str, int]:
    """The fault of a table, empty if there is none, and its rows. Every byte is read."""
    try:
        file = pq.ParquetFile(path)
        columns: dict[str, Any] = {field.name: field.type for field in file.schema_arrow}
        for field in contracts.schema(name):
            if columns.get(field.name) != field.type:
                return f"column {field.name} is not there as {field.type}", 0
        return "", sum(batch.num_rows for batch in file.iter_batches())
    except FileNotFoundError:
        return "it is missing", 0
    except (OSError, pa.ArrowException) as problem:
        return f"it cannot be read ({str(problem).splitlines()[0]})", 0


def _left_behind(work: Workspace) -> Iterator[Finding]:
    for path in work.failures():
        reason = str(read_json(path).get("reason"))
        yield Finding(path, reason, "semloc run LOG... --retry-failed")
    for path in sorted(work.all_search_parts.glob("*")):
        yield Finding(path, "a search was interrupted", f"semloc close -w {work.path}")

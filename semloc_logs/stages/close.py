"""Alignments of all pairs of sessions -> loop closures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from semloc_logs.closures.acceptance.decide import decide
from semloc_logs.closures.alignment_tables import read_alignments
from semloc_logs.closures.closure import Alignments, Outcomes
from semloc_logs.closures.closure_tables import (
    read_closures,
    unique_closures,
    write_closures,
    write_rejected,
)
from semloc_logs.closures.exclusions import Exclusions
from semloc_logs.closures.query import query_keyframes
from semloc_logs.closures.same_recording import same_recordings
from semloc_logs.closures.session_pairs import Pair, known_pairs
from semloc_logs.engines import Engine
from semloc_logs.errors import WorkspaceError
from semloc_logs.settings import Resolved
from semloc_logs.stages.inputs import fingerprint_of
from semloc_logs.stages.lock import one_writer
from semloc_logs.stages.pair_search import (
    EVERYTHING,
    Maps,
    PairSearch,
    Selection,
    metadata_of,
)
from semloc_logs.stages.report import Report
from semloc_logs.stages.state import keep
from semloc_logs.tables.table import read_metadata
from semloc_logs.workspace import Workspace

SECTIONS = ("fusion", "labels", "descriptor", "query", "closures")


@one_writer
def close(
    work: Workspace,
    settings: Resolved,
    engine: Engine,
    selection: Selection = EVERYTHING,
    *,
    overwrite: bool = False,
) -> Report:
    """Search the pairs of sessions that were not searched yet, and decide over all alignments.

    Writes alignments/, closures.parquet, rejected.parquet and closures.png. Raises WorkspaceError
    where a session or its words are missing.
    """
    search = PairSearch.of(work, settings, selection, overwrite=overwrite)
    keep(work, settings)
    searches = search.run(engine)
    exclusions = search.exclusions
    is_new = decide_all(
        work, search.maps, settings, exclusions, search.searched(), overwrite=overwrite
    )
    report = Report(closures=len(read_closures(work.closures)), amount=searches)
    report.skipped += exclusions.sentences()
    fitting = {name: m for name, m in search.maps.items() if name not in exclusions.misfits}
    report.skipped += same_recordings(fitting)
    (report.done if is_new else report.kept).append("closures")
    return report


def decide_all(
    work: Workspace,
    maps: Maps,
    settings: Resolved,
    exclusions: Exclusions,
    known: Mapping[Pair, str] | None = None,
    *,
    overwrite: bool = False,
) -> bool:
    """Write the tables of closures and rejections, and the picture; whether they were not there.

    They are of the alignments of all pairs (``known``, where they are known already) but the
    ``exclusions``.
    """
    known = known_pairs(work) if known is None else known
    if not overwrite and is_decided(work, settings, known):
        return False
    # matplotlib is loaded only where something is drawn
    from semloc_logs.pictures.closures_picture import draw_closures

    paths = _alignment_tables(work, known, exclusions)
    searched = _searched(paths, maps, settings)
    decided = _decided(paths, maps, settings, searched)
    road = {name: session_map.distance for name, session_map in maps.items()}
    closures = unique_closures(decided.accepted(), road, settings.query.every)

    metadata = {
        **metadata_of(settings, maps.values()),
        "queries": sum(map(len, searched.values())),
        "fingerprint": _decided_from(known, settings),
        "settings": settings.tables(*SECTIONS),
    }
    # closures.parquet comes last: with its fingerprint it vouches for the other two
    write_rejected(work.rejected, decided.rejected(), metadata)
    draw_closures(work, closures, maps)
    write_closures(work.closures, closures, metadata)
    return True


def decided_alignments(
    work: Workspace, maps: Maps, settings: Resolved, exclusions: Exclusions
) -> Outcomes:
    """What becomes of the alignments of all pairs that :func:`decide_all` uses."""
    paths = _alignment_tables(work, known_pairs(work), exclusions)
    return _decided(paths, maps, settings, _searched(paths, maps, settings))


def _decided(
    paths: Mapping[Pair, Path], maps: Maps, settings: Resolved, searched: Mapping[str, list[int]]
) -> Outcomes:
    """The outcomes; ``searched`` queries without alignments are neighbours, too."""
    alignments = Alignments.joined(read_alignments(paths[p], p.query, p.target) for p in paths)
    return decide(alignments, maps, settings, searched)


def _searched(pairs: Iterable[Pair], maps: Maps, settings: Resolved) -> dict[str, list[int]]:
    """The keyframes of all queries by session."""
    sessions = sorted({pair.query for pair in pairs})
    return {name: query_keyframes(maps[name], settings) for name in sessions}


def _alignment_tables(
    work: Workspace, known: Iterable[Pair], exclusions: Exclusions
) -> dict[Pair, Path]:
    """The tables of alignments of the pairs of sessions that may get closures."""
    return {
        pair: work.alignments(pair.query, pair.target)
        for pair in sorted(known)
        if not exclusions.has(pair)
    }


def _decided_from(known: Mapping[Pair, str], settings: Resolved) -> str:
    """The fingerprint of all alignments, and of what the decision about them depends on."""
    pairs = [f"{p.query}/{p.target} {f}" for p, f in sorted(known.items())]
    return fingerprint_of((settings.fingerprint(*SECTIONS), *pairs))


def is_decided(
    work: Workspace, settings: Resolved, known: Mapping[Pair, str] | None = None
) -> bool:
    """Whether the tables are there and were decided from the alignments that are there."""
    fingerprint = _decided_from(known_pairs(work) if known is None else known, settings)
    try:
        tables = [read_metadata(path) for path in (work.closures, work.rejected)]
    except WorkspaceError:  # missing or damaged
        return False
    return all(metadata.get("fingerprint") == fingerprint for metadata in tables)

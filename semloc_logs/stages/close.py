"""Words -> loop closures."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import semloc_logs
from semloc_logs import progress
from semloc_logs.closures.acceptance.decide import decide
from semloc_logs.closures.closure import Alignment, Closure, Rejected
from semloc_logs.closures.closure_tables import (
    read_closures,
    unique_closures,
    write_closures,
    write_rejected,
)
from semloc_logs.closures.matching import CloseTask, close_queries
from semloc_logs.closures.query import query_keyframes
from semloc_logs.engines import Engine
from semloc_logs.errors import WorkspaceError
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import Resolved
from semloc_logs.stages.inputs import fingerprint_of, recorded_fingerprint
from semloc_logs.stages.report import Report
from semloc_logs.subvolumes.submap_descriptors import variants_for
from semloc_logs.tables.table import read_json, read_metadata
from semloc_logs.words.catalogue import Change, segments
from semloc_logs.workspace import SessionFolder, Workspace

LOGGER = logging.getLogger(__name__)
QUERIES_A_TASK = 4
SECTIONS = ("fusion", "labels", "descriptor", "query", "closures")


@dataclass(frozen=True, slots=True)
class Selection:
    """Sessions whose queries are searched, and sessions they are searched in; all where empty."""

    queries: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    self_closures: bool = True


def close(
    work: Workspace,
    settings: Resolved,
    engine: Engine,
    selection: Selection = Selection(),
    *,
    overwrite: bool = False,
) -> Report:
    """Write closures.parquet, rejected.parquet and closures.png.

    Raises WorkspaceError where a session or its words are missing.
    """
    queries = work.chosen(selection.queries)
    targets = work.chosen(selection.targets)
    maps = {folder.name: SessionMap(folder) for folder in (*queries, *targets)}
    skipped = _misfits(maps, settings)
    queries = [folder for folder in queries if folder.name not in skipped]
    targets = [folder for folder in targets if folder.name not in skipped]
    variants = _checked_variants(work, maps, settings)
    inputs = [f"{f.name} {recorded_fingerprint(f.words_json)}" for f in (*queries, *targets)]
    settings_fingerprint = settings.fingerprint(*SECTIONS)
    fingerprint = fingerprint_of(
        (settings_fingerprint, str(selection.self_closures), repr(len(queries)), *inputs)
    )
    if not overwrite and _is_up_to_date(work, fingerprint):
        count = len(read_closures(work.closures))
        return Report(kept=["closures"], closures=count, skipped=list(skipped.values()))

    # matplotlib is loaded only where something is drawn
    from semloc_logs.pictures.closures_picture import draw_closures

    _update_indexes(work, sorted(variants), [folder.name for folder in targets])
    tasks = _tasks(work, queries, targets, maps, settings, selection.self_closures)
    decided = decide(_search(tasks, engine), maps, settings)

    road = {name: session_map.distance for name, session_map in maps.items()}
    accepted = [outcome for outcome in decided if isinstance(outcome, Closure)]
    rejected = [outcome for outcome in decided if isinstance(outcome, Rejected)]
    closures = unique_closures(accepted, road, settings.query.every)
    metadata = _metadata(settings, maps, sum(len(task.keyframes) for task in tasks))
    metadata["fingerprint"] = fingerprint
    # closures.parquet comes last: with its fingerprint it vouches for the other two
    write_rejected(work.rejected, rejected, metadata)
    draw_closures(work, closures, maps)
    write_closures(work.closures, closures, metadata)
    return Report(done=["closures"], closures=len(closures), skipped=list(skipped.values()))


def _misfits(maps: Mapping[str, SessionMap], settings: Resolved) -> dict[str, str]:
    """Sessions that get no closures, since these would be false, and the sentences that say so."""
    if settings.closures.misfits:
        return {}
    return {
        name: f"Session {name} gets no closures: its poses do not fit ({'; '.join(misfits)});"
        " --set closures.misfits=true searches it all the same."
        for name, session_map in maps.items()
        if (misfits := session_map.misfits)
    }


def _checked_variants(
    work: Workspace, maps: Mapping[str, SessionMap], settings: Resolved
) -> set[str]:
    """The variants of words that the sessions are searched with; all of them have to be there."""
    sources = [session_map.label_source for session_map in maps.values()]
    variants: set[str] = set()
    for name, session_map in maps.items():
        wanted = set(variants_for(session_map.label_source, sources, settings))
        words_json = session_map.folder.words_json
        if not words_json.exists() or not wanted <= set(read_json(words_json)["variants"]):
            raise WorkspaceError(
                f"Session {name} lacks {' and '.join(sorted(wanted))} words:"
                f" run 'semloc describe -w {work.path}' first."
            )
        session_map.check_version()
        variants |= wanted
    return variants


def _is_up_to_date(work: Workspace, fingerprint: str) -> bool:
    return all(
        table.exists() and read_metadata(table).get("fingerprint") == fingerprint
        for table in (work.closures, work.rejected)
    )


def _update_indexes(work: Workspace, variants: Sequence[str], targets: Sequence[str]) -> None:
    """Once, before every worker needs them."""
    for variant in variants:
        change = Change()
        segments(work, variant, targets, change)
        if str(change):
            LOGGER.info("index of %s words: %s", variant, change)


def _tasks(
    work: Workspace,
    queries: Sequence[SessionFolder],
    targets: Sequence[SessionFolder],
    maps: Mapping[str, SessionMap],
    settings: Resolved,
    self_closures: bool,
) -> list[CloseTask]:
    tasks = []
    for folder in queries:
        names = sorted(f.name for f in targets if self_closures or f.name != folder.name)
        keyframes = query_keyframes(maps[folder.name], settings)
        for first in range(0, len(keyframes), QUERIES_A_TASK):
            chunk = tuple(keyframes[first : first + QUERIES_A_TASK])
            path = work.path.absolute()
            tasks.append(CloseTask(path, folder.name, chunk, tuple(names), settings))
    return tasks


def _search(tasks: Sequence[CloseTask], engine: Engine) -> list[Alignment]:
    """All alignments of all queries, in the order of the tasks."""
    totals: dict[str, int] = {}
    for task in tasks:
        totals[task.session] = totals.get(task.session, 0) + len(task.keyframes)
    alignments: list[Alignment] = []
    done = dict.fromkeys(totals, 0)
    for task, results in zip(tasks, engine.map(close_queries, tasks), strict=True):
        alignments += [alignment for result in results for alignment in result]
        done[task.session] += len(task.keyframes)
        progress.report("close", task.session, done[task.session], totals[task.session], "queries")
    return alignments


def _metadata(settings: Resolved, maps: Mapping[str, SessionMap], queries: int) -> dict[str, Any]:
    return {
        "schema_version": 1,
        "voxel_size": settings.fusion.voxel_size,
        "session_T_map": np.eye(4).tolist(),
        "label_space": "cityscapes",
        "label_source": ",".join(sorted({m.label_source for m in maps.values()})),
        "version": semloc_logs.__version__,
        "queries": queries,
        "settings": settings.model_dump(mode="json", include=set(SECTIONS)),
    }

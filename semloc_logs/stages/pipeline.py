"""The pipeline on one screen: fuse, describe, close, annotate, run. Each stage reads files of the
one before and writes its own.

A stage is done when its outputs are there for the same inputs, settings and version; then it is not
done again.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import semloc_logs
from semloc_logs.closures.acceptance.consistency import decide
from semloc_logs.closures.closure import Alignment
from semloc_logs.closures.closure_tables import (
    keyframe_at,
    read_closures,
    unique_closures,
    write_closures,
    write_rejected,
)
from semloc_logs.closures.matching import CloseTask, close_queries
from semloc_logs.closures.query import SessionMap, query_keyframes
from semloc_logs.engines import Engine, Serial
from semloc_logs.errors import LogError, SemlocError, WorkspaceError
from semloc_logs.labels.segmentation import fingerprint as label_fingerprint
from semloc_logs.logs.annotation.annotate import (
    AnnotateReport,
    ClosureRecord,
    Results,
    annotate_copy,
    annotate_in_place,
    annotate_sidecar,
    content_fingerprint,
    recover,
)
from semloc_logs.logs.poses.trajectory_file import TrajectoryFile
from semloc_logs.logs.problems import lost, sentences
from semloc_logs.mapping.session_fusion import FusedSession, FuseTask, fuse_session
from semloc_logs.numerics.transforms import transform
from semloc_logs.pictures.closures_picture import draw_closures
from semloc_logs.settings import Resolved
from semloc_logs.subvolumes.submap_descriptors import DescribeTask, variants_for
from semloc_logs.tables.table import read_json, read_metadata, replacing_folder, write_json
from semloc_logs.voxels.store import blocks_path
from semloc_logs.words.catalogue import Change, segments
from semloc_logs.words.submap_words import index_submap, write_words
from semloc_logs.workspace import SessionFolder, Workspace

Note = Callable[[str], None]
QUERIES_A_TASK = 4


@dataclass(slots=True)
class Report:
    """What a stage did: seconds, what was done and what was found done, and sentences about input
    that was skipped.
    """

    done: list[str] = field(default_factory=list)
    kept: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    closures: int = 0


def session_name(log: Path) -> str:
    """The name of a log's session: the file's stem or the directory's name."""
    log = log.absolute()
    if log.name == "metadata.yaml":
        log = log.parent
    return log.name if log.is_dir() else log.stem


def _hash(*parts: str) -> str:
    return hashlib.sha256("\n".join((semloc_logs.__version__, *parts)).encode()).hexdigest()[:16]


# -- fuse
# ------------------------------------------------------------------------------------------------------------------------


def fuse(
    sessions: Mapping[str, Sequence[Path]],
    work: Workspace,
    settings: Resolved,
    topics: Mapping[str, str],
    engine: Engine,
    note: Note,
    overwrite: bool = False,
    poses: Mapping[str, TrajectoryFile] | None = None,
) -> Report:
    """Logs -> keyframes, submaps and map of each session. A session that fails is named in
    ``failed``; the others go on.

    ``poses``: files of poses by session, instead of those of its logs.
    """
    report = Report()
    tasks = []
    label_files = label_fingerprint(settings.labels)
    for name, logs in sessions.items():
        for log in logs:
            recover(log)
        folder = work.session(name)
        inputs = [content_fingerprint(log) for log in logs]
        trajectory = (poses or {}).get(name)
        inputs += [f"poses {trajectory.fingerprint()}"] if trajectory else []
        fingerprint = _hash(
            settings.fingerprint("fusion", "labels"),
            label_files,
            repr(sorted(topics.items())),
            *inputs,
        )
        if not overwrite and _fingerprint(folder.session_json) == fingerprint:
            report.kept.append(name)
            report.skipped += read_json(folder.session_json)["skipped"]
        else:
            tasks.append(
                FuseTask(
                    tuple(Path(log).absolute() for log in logs),
                    folder,
                    settings,
                    dict(topics),
                    fingerprint,
                    trajectory,
                )
            )
    # only a task in this process can say how far it is
    fuse_one = partial(_fuse_one, note=note) if isinstance(engine, Serial) else _fuse_one
    for task, outcome in zip(tasks, engine.map(fuse_one, tasks), strict=True):
        name = task.folder.name
        if isinstance(outcome, SemlocError):
            report.failed.append(str(outcome))
            if len(tasks) > 1:  # the only one is raised below, and need not be said twice
                note(f"{name}: {outcome}")
        else:
            report.done.append(name)
            content = outcome.content
            report.skipped += sentences(lost(outcome.problems))
            made = f"{content['keyframes']} keyframes, {len(content['submaps'])} submaps, {content['voxels']} voxels"
            note(f"{name}: {made}, labels from {content['label_source']}")
            for problem in outcome.problems:
                if not problem.lost:
                    note(f"{name}: {problem.text}")
    if report.failed and not report.done and not report.kept:
        raise LogError(" ".join(report.failed))
    return report


def _fuse_one(task: FuseTask, note: Note = lambda _: None) -> FusedSession | SemlocError:
    """An expected error is a result: one bad log does not end the night's work."""
    try:
        task.folder.session_json.unlink(missing_ok=True)  # what is half replaced must not look done
        return fuse_session(task, lambda said: note(f"{task.folder.name}: {said}"))
    except SemlocError as problem:
        return problem


def _fingerprint(path: Path) -> str | None:
    try:
        return str(read_json(path)["fingerprint"])
    except (WorkspaceError, KeyError):
        return None


# -- describe
# --------------------------------------------------------------------------------------------------------------------


def describe(
    work: Workspace,
    names: Sequence[str],
    settings: Resolved,
    engine: Engine,
    note: Note,
    overwrite: bool = False,
) -> Report:
    """Maps -> semantic words, for the sessions ``names`` (all if empty)."""
    report = Report()
    folders = _sessions(work, names)
    sources = {f.name: str(read_json(f.session_json)["label_source"]) for f in folders}
    for folder in folders:
        session = read_json(folder.session_json)
        variants = variants_for(sources[folder.name], sources.values(), settings)
        voxel_settings = session["settings"]["fusion"]["voxel_size"]
        if voxel_settings != settings.fusion.voxel_size:
            raise WorkspaceError(
                f"Session {folder.name} was fused with voxels of {voxel_settings} m, the settings say {settings.fusion.voxel_size} m: "
                f"give --set fusion.voxel_size={voxel_settings}, or fuse it again."
            )
        fingerprint = _hash(
            session["fingerprint"],
            settings.fingerprint("descriptor"),
            _weights(settings),
            *variants,
        )
        if not overwrite and _fingerprint(folder.words_json) == fingerprint:
            report.kept.append(folder.name)
            continue
        folder.words_json.unlink(missing_ok=True)
        keys = (
            "schema_version",
            "voxel_size",
            "session_T_map",
            "label_space",
            "label_source",
            "version",
        )
        metadata = {k: session[k] for k in keys}
        road = SessionMap(folder).road
        with replacing_folder(folder.words) as output:
            tasks = [
                DescribeTask(
                    folder,
                    s["id"],
                    s["ground_z"],
                    road(s),
                    variants,
                    blocks_path(output, s["id"]),
                    metadata,
                    settings,
                )
                for s in session["submaps"]
            ]
            words = sum(engine.map(index_submap, tasks))
            if not tasks:
                write_words(blocks_path(output, 0), 0, [], metadata)
        used = settings.model_dump(mode="json", include={"descriptor"})
        write_json(
            folder.words_json,
            {
                "fingerprint": fingerprint,
                "words": words,
                "variants": list(variants),
                "settings": used,
            },
        )
        report.done.append(folder.name)
        note(f"{folder.name}: {words} words")
    return report


def _weights(settings: Resolved) -> str:
    """Fingerprint of weights and vocabulary given as files; the shipped ones belong to the version."""
    paths = [
        p for p in (settings.descriptor.weights, settings.descriptor.vocabulary) if p is not None
    ]
    return _hash(*(hashlib.sha256(p.read_bytes()).hexdigest() for p in paths if p.is_file()))


def _sessions(work: Workspace, names: Sequence[str]) -> list[SessionFolder]:
    known = {f.name: f for f in work.sessions()}
    missing = [n for n in names if n not in known]
    if missing or not known:
        listed = ", ".join(known) or "none"
        raise WorkspaceError(
            f"{work.path} has no fused session {', '.join(missing) or 'at all'} (there are: {listed}): run 'semloc fuse' first."
        )
    return [known[n] for n in names] if names else list(known.values())


# -- close
# -----------------------------------------------------------------------------------------------------------------------


def close(
    work: Workspace,
    queries: Sequence[str],
    targets: Sequence[str],
    settings: Resolved,
    engine: Engine,
    note: Note,
    self_closures: bool = True,
    overwrite: bool = False,
) -> Report:
    """Words -> closures.parquet and rejected.parquet: every session of ``queries`` against all of
    ``targets`` (all if empty).
    """
    asking = _sessions(work, queries)
    asked = _sessions(work, targets)
    maps = {f.name: SessionMap(f) for f in (*asking, *asked)}
    variants: set[str] = set()
    sources = [str(m.json["label_source"]) for m in maps.values()]
    for name, m in maps.items():
        wanted = set(variants_for(str(m.json["label_source"]), sources, settings))
        variants |= wanted
        if not m.folder.words_json.exists() or not wanted <= set(
            read_json(m.folder.words_json)["variants"]
        ):
            raise WorkspaceError(
                f"Session {name} lacks {' and '.join(sorted(wanted))} words: run 'semloc describe -w {work.path}' first."
            )
        _ = m.views  # a session of an earlier version is refused before its queries are asked
    inputs = [f"{f.name} {_fingerprint(f.words_json)}" for f in (*asking, *asked)]
    sections = ("fusion", "labels", "descriptor", "query", "closures")
    fingerprint = _hash(
        settings.fingerprint(*sections), str(self_closures), repr(len(asking)), *inputs
    )
    report = Report()
    if (
        not overwrite
        and work.rejected.exists()
        and work.closures.exists()
        and read_metadata(work.closures).get("fingerprint") == fingerprint
    ):
        report.kept.append("closures")
        report.closures = len(read_closures(work.closures))
        return report
    for variant in sorted(variants):  # once, before every worker wants it
        segments(work, variant, [f.name for f in asked], change := Change())
        if said := str(change):
            note(f"index of {variant} words: {said}")
    tasks = []
    for folder in asking:
        others = tuple(sorted(f.name for f in asked if self_closures or f.name != folder.name))
        keyframes = query_keyframes(maps[folder.name], settings)
        chunks = [
            tuple(keyframes[i : i + QUERIES_A_TASK])
            for i in range(0, len(keyframes), QUERIES_A_TASK)
        ]
        tasks += [
            CloseTask(work.path.absolute(), folder.name, chunk, others, settings)
            for chunk in chunks
        ]
    found: list[Alignment] = []
    least = settings.closures.min_probability
    total = sum(len(t.keyframes) for t in tasks)
    asked_queries = 0
    for task, results in zip(tasks, engine.map(close_queries, tasks), strict=True):
        asked_queries += len(task.keyframes)
        found += [a for result in results for a in result]
        note(
            f"query {asked_queries} of {total}: {sum(a.probability >= least for a in found)} probable places"
        )
    found = decide(found, maps, settings)
    road = {name: m.distance for name, m in maps.items()}
    closures = unique_closures([a for a in found if a.accepted], road, settings.query.every)
    metadata = {
        "schema_version": 1,
        "voxel_size": settings.fusion.voxel_size,
        "session_T_map": np.eye(4).tolist(),
        "label_space": "cityscapes",
        "label_source": ",".join(sorted({m.json["label_source"] for m in maps.values()})),
        "version": semloc_logs.__version__,
        "queries": total,
        "settings": settings.model_dump(mode="json", include=set(sections)),
    }
    write_rejected(work.rejected, [a for a in found if not a.accepted], metadata)
    write_closures(work.closures, closures, metadata | {"fingerprint": fingerprint})
    draw_closures(work, closures, maps)
    report.done.append("closures")
    report.closures = len(closures)
    return report


# -- annotate
# --------------------------------------------------------------------------------------------------------------------


def annotate(
    log: Path,
    work: Workspace,
    settings: Resolved,
    *,
    output: Path | None,
    mode: str,
    overwrite: bool = False,
    session: str | None = None,
) -> AnnotateReport:
    """Closures that the log takes part in -> channels. ``mode`` is copy, in-place or sidecar; all
    but in-place need ``output``.
    """
    recover(log)
    name = session or session_name(log)
    folder = _sessions(work, [name])[0]
    mine = SessionMap(folder)
    rows = [
        r for r in read_closures(work.closures) if name in (r["query_session"], r["target_session"])
    ]
    records = [_record(work, mine, name, row) for row in rows]
    times = dict(zip(mine.stamps_ns.tolist(), mine.frames["log_time_ns"].to_pylist(), strict=True))
    notes = {
        "version": semloc_logs.__version__,
        "settings": settings.fingerprint("fusion", "labels", "descriptor", "query", "closures"),
    }
    notes["fusion.voxel_size"] = str(settings.fusion.voxel_size)
    results = Results(
        records, name, notes, times, frame_id=str(mine.json.get("session_frame") or "") or None
    )
    if mode == "in-place":
        return annotate_in_place(log, results)
    if output is None:
        raise WorkspaceError("Annotating needs an output file.")
    write = annotate_sidecar if mode == "sidecar" else annotate_copy
    return write(log, output, results, overwrite=overwrite)


def _record(work: Workspace, mine: SessionMap, name: str, row: dict[str, Any]) -> ClosureRecord:
    """A closure with what the channels need beside the row: poses in the frames of the pose
    streams.
    """
    target = SessionMap(work.session(row["target_session"]))
    target_end = keyframe_at(target, row["target_stamp_ns"])
    target_T_query = transform(
        np.array([row["t_x"], row["t_y"], row["t_z"]]),
        np.array([row["q_x"], row["q_y"], row["q_z"], row["q_w"]]),
    )
    session_T_query = (
        np.array(target.json["session_T_map"]) @ target.map_T_base[target_end] @ target_T_query
    )
    own_end = keyframe_at(
        mine, row["query_stamp_ns"] if row["query_session"] == name else row["target_stamp_ns"]
    )
    position = (np.array(mine.json["session_T_map"]) @ mine.map_T_base[own_end])[:3, 3]
    is_query = row["query_session"] == name
    return ClosureRecord.from_row(
        row, session_T_query=session_T_query if is_query else None, session_position=position
    )


# -- run
# -------------------------------------------------------------------------------------------------------------------------


def run(
    sessions: Mapping[str, Sequence[Path]],
    work: Workspace,
    settings: Resolved,
    topics: Mapping[str, str],
    engine: Engine,
    note: Note,
    annotation: str = "none",
    overwrite: bool = False,
    poses: Mapping[str, TrajectoryFile] | None = None,
) -> Report:
    """All of it: each log is a session. Resumable; ``annotation`` is none, copy, sidecar or
    in-place; ``poses`` as in :func:`fuse`.
    """
    total = Report()
    clock = time.perf_counter()

    def add(stage: str, part: Report) -> None:
        nonlocal clock
        for key in ("done", "kept", "skipped", "failed"):
            getattr(total, key).extend(
                f"{stage} {x}" if key in ("done", "kept") else x for x in getattr(part, key)
            )
        total.closures = part.closures
        total.seconds[stage] = round(time.perf_counter() - clock, 3)
        clock = time.perf_counter()

    fused = fuse(sessions, work, settings, topics, engine, note, overwrite, poses)
    add("fuse", fused)
    names = [n for n in sessions if work.session(n).session_json.exists()]
    add("describe", describe(work, names, settings, engine, note, overwrite))
    add("close", close(work, names, names, settings, engine, note, overwrite=overwrite))
    if annotation != "none":
        for name in names:
            for log in sessions[name]:
                output = (
                    None
                    if annotation == "in-place"
                    else work.annotated
                    / f"{name if log.is_dir() else log.stem}{'.semloc' if annotation == 'sidecar' else ''}.mcap"
                )
                made = annotate(
                    log,
                    work,
                    settings,
                    output=output,
                    mode=annotation,
                    overwrite=True,
                    session=name,
                )
                note(f"{name}: {made.messages} messages in {made.path}")
        total.seconds["annotate"] = round(time.perf_counter() - clock, 3)
    write_json(
        work.summary,
        {
            "version": semloc_logs.__version__,
            "seconds": total.seconds,
            "skipped": total.skipped,
            "failed": total.failed,
            "closures": total.closures,
        },
    )
    return total

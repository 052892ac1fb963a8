"""Logs -> keyframes, submaps and the map of each session."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from semloc_logs import progress
from semloc_logs.engines import Engine
from semloc_logs.errors import (
    LogError,
    RemoteError,
    SemlocError,
    TemporaryError,
    TopicError,
    WorkspaceError,
)
from semloc_logs.labels.segmentation import fingerprint as label_fingerprint
from semloc_logs.logs.annotation.annotate import content_fingerprint, recover
from semloc_logs.logs.poses.base_frame import BASE_LINK
from semloc_logs.logs.poses.mountings import NO_MOUNTINGS, Mountings
from semloc_logs.logs.problems import sentences, to_report
from semloc_logs.logs.session.lent_transforms import lent_transforms
from semloc_logs.mapping.session_fusion import FusedSession, FuseTask, fuse_session
from semloc_logs.settings import Logs, Resolved
from semloc_logs.stages.inputs import Redo, SessionInput, fingerprint_of, recorded_fingerprint
from semloc_logs.stages.lock import writing
from semloc_logs.stages.report import Report
from semloc_logs.stages.state import keep
from semloc_logs.tables.atomic_files import replacing_folder
from semloc_logs.tables.table import read_json, read_table, write_json
from semloc_logs.voxels.store import poses_of
from semloc_logs.workspace import SessionFolder, Workspace

LOGGER = logging.getLogger(__name__)
# keys without which a session.json is not one that fuse wrote
_WHOLE = frozenset({"fingerprint", "skipped"})


@dataclass(slots=True)
class FusePlan:
    """The sessions to fuse, and in ``report`` those that are done or failed before."""

    tasks: list[FuseTask] = field(default_factory=list)
    report: Report = field(default_factory=Report)


def fuse(
    sessions: Sequence[SessionInput],
    work: Workspace,
    settings: Resolved,
    engine: Engine,
    *,
    names: Sequence[str] = (),
    redo: Redo = Redo.NOTHING,
) -> Report:
    """Fuse each session, or only ``names``. One that fails is named in ``failed``; the others
    go on.

    The reason is kept, and the same log is not read again unless failed ones are to be redone.
    Raises LogError when all of them failed, WorkspaceError where another log has the name of a
    session, unless everything is to be redone.
    """
    chosen = [session for session in sessions if not names or session.name in names]
    with writing(work, [session.name for session in chosen]):
        for session in chosen:
            for log in session.logs:
                recover(log)
        plan = plan_fuse(sessions, work, settings, names=names, redo=redo)
        keep(work, settings, overwrite=redo is Redo.EVERYTHING)
        return _fuse(plan, work, engine)


def plan_fuse(
    sessions: Sequence[SessionInput],
    work: Workspace,
    settings: Resolved,
    *,
    names: Sequence[str] = (),
    redo: Redo = Redo.NOTHING,
) -> FusePlan:
    """What :func:`fuse` would do. Nothing is written."""
    plan = FusePlan()
    logs = [log for session in sessions for log in session.logs]
    for session in sessions:
        if names and session.name not in names:
            continue
        others = [log for log in logs if log not in session.logs]
        folder = work.session(session.name)
        present = {} if redo is Redo.EVERYTHING else _present(folder)
        reading = _as_read_before(present, settings)
        task = _task(session, folder, reading, others)
        plan.report.skipped += _given_twice(task)
        if present.get("fingerprint") == task.fingerprint:
            plan.report.kept.append(session.name)
            plan.report.skipped += present["skipped"]
            continue
        _check_same_log(task, present)
        if (
            redo is Redo.NOTHING
            and recorded_fingerprint(work.failure(session.name)) == task.fingerprint
        ):
            reason = read_json(work.failure(session.name))["reason"]
            sentence = f"{reason} It failed before: --retry-failed reads it again."
            plan.report.failed.append(sentence)
        else:
            plan.tasks.append(task)
    return plan


def _fuse(plan: FusePlan, work: Workspace, engine: Engine) -> Report:
    report = plan.report
    tasks = plan.tasks
    kinds: set[type[SemlocError]] = {LogError} if report.failed else set()
    progress.report_start("fuse", len(tasks), "sessions")
    for done, (task, outcome) in enumerate(
        zip(tasks, engine.map(_fuse_one, tasks), strict=True), 1
    ):
        failure = work.failure(task.folder.name)
        if isinstance(outcome, SemlocError):
            report.failed.append(str(outcome))
            kinds.add(type(outcome))
            # else the log is not to blame
            if not isinstance(outcome, RemoteError | TopicError | TemporaryError):
                content = {"fingerprint": task.fingerprint, "reason": str(outcome)}
                write_json(failure, content | {"logs": [str(log) for log in task.logs]})
            if len(tasks) > 1:  # the only one is raised below
                LOGGER.info("%s: %s", task.folder.name, outcome)
        else:
            if not task.folder.session_json.exists():
                raise WorkspaceError(
                    f"A worker wrote {task.folder.path} on a disk of its own: all workers have to"
                    " see the workspace under the same path."
                )
            failure.unlink(missing_ok=True)
            report.done.append(task.folder.name)
            report.amount += _seconds(outcome.content)
            report.skipped += sentences(to_report(outcome.problems))
            _log_outcome(task.folder.name, outcome)
        progress.report("fuse", "", done, len(tasks), "sessions")
    if report.failed and not report.done and not report.kept:
        kind = kinds.pop() if len(kinds) == 1 else LogError
        raise (kind if kind in (TemporaryError, TopicError) else LogError)(" ".join(report.failed))
    return report


def _present(folder: SessionFolder) -> dict[str, Any]:
    """The content of session.json; empty where there is none, or a damaged one."""
    if not folder.session_json.exists():
        return {}
    try:
        content = read_json(folder.session_json)
    except WorkspaceError as problem:
        LOGGER.warning("%s The session is made again from its log.", problem)
        return {}
    return content if content.keys() >= _WHOLE else {}


def _as_read_before(present: Mapping[str, Any], settings: Resolved) -> Resolved:
    """The settings; reading is as the session was made with, unless other values are given.

    They belong to a log: its clocks, its mountings, its direction of up.
    """
    is_given = settings.logs != Logs(memory=settings.logs.memory)
    if is_given or not present:
        return settings
    recorded = present.get("settings", {}).get("logs", {})
    logs = Logs.model_validate({**recorded, "memory": settings.logs.memory})
    return settings.model_copy(update={"logs": logs})


def _task(
    session: SessionInput, folder: SessionFolder, settings: Resolved, others: Sequence[Path]
) -> FuseTask:
    """The task of a session, with the fingerprint of all that its tables depend on.

    ``others``: the logs of the other sessions, which may have transforms that this one lacks.
    """
    mountings = _mountings(session, settings, others)
    made_from = {
        "content": [content_fingerprint(log) for log in session.logs],
        "topics": dict(sorted(session.topics.items())),
        "poses": None if session.poses is None else session.poses.fingerprint(),
    }
    fingerprint = fingerprint_of(
        (
            settings.fingerprint("logs", "fusion", "labels"),
            label_fingerprint(settings.labels),
            json.dumps(made_from, sort_keys=True),
            *(repr(transform) for transform in mountings.lent),
        )
    )
    logs = tuple(log.absolute() for log in session.logs)
    topics = dict(session.topics)
    folder = SessionFolder(folder.path.absolute())  # workers may have another current folder
    return FuseTask(
        logs, folder, settings, topics, fingerprint, made_from, session.poses, mountings
    )


def _given_twice(task: FuseTask) -> list[str]:
    """A sentence for each part of a session that is the same as one before it."""
    first: dict[str, Path] = {}
    repeated = []
    for log, content in zip(task.logs, task.made_from["content"], strict=True):
        if content in first:
            before = first[content]
            what = "is given twice" if before == log else f"is the same as {before}"
            repeated.append(f"Session {task.folder.name}: {log} {what}: give each part once.")
        else:
            first[content] = log
    return repeated


def _mountings(session: SessionInput, settings: Resolved, others: Sequence[Path]) -> Mountings:
    child = None
    if session.poses is not None:
        child = session.poses.frame or BASE_LINK
    elif settings.fusion.odometry == "lidar":
        child = BASE_LINK
    try:
        memory = settings.logs.memory
        return lent_transforms(session.logs, others, session.topics, child, memory=memory)
    except SemlocError:
        return NO_MOUNTINGS  # the task meets the same error, and names it


def _check_same_log(task: FuseTask, present: Mapping[str, Any]) -> None:
    """WorkspaceError where the ``present`` session of a task was made from other input.

    Made from the same under other settings, or by another version, it is made again.
    """
    before = present.get("made_from", task.made_from)
    changed = [what for what in task.made_from if before.get(what) != task.made_from[what]]
    if not changed:
        return
    name = task.folder.name
    if "content" in changed:
        paths = ", ".join(str(log["path"]) for log in present.get("logs", []))
        raise WorkspaceError(
            f"Session '{name}' was made from another log ({paths}) than {task.logs[0]}: give this"
            f" one a name, as in NAME={task.logs[0].name}, or replace '{name}' with --overwrite."
        )
    raise WorkspaceError(
        f"Session '{name}' was made with other {' and '.join(changed)}: give the same, or make it"
        " again with --overwrite."
    )


def _fuse_one(task: FuseTask) -> FusedSession | SemlocError:
    """An expected error is a result: one bad log does not end the night's work."""
    try:
        # beside the present session, which stays until the new one is whole
        with replacing_folder(task.folder.path) as scratch:
            folder = SessionFolder(scratch, task.folder.name)
            return fuse_session(replace(task, folder=folder), on_tables=partial(_draw, folder))
    except SemlocError as problem:
        return problem


def _seconds(content: Mapping[str, Any]) -> float:
    """Of the logs of a session."""
    ends = [(log["start_ns"], log["end_ns"]) for log in content["logs"]]
    lengths_ns = (end - start for start, end in ends if start is not None and end is not None)
    return float(sum(lengths_ns)) / 1e9


def _draw(folder: SessionFolder, content: dict[str, Any]) -> None:
    # matplotlib is loaded only where something is drawn
    from semloc_logs.pictures.map_picture import Caption, draw_map
    from semloc_logs.pictures.times import period_text

    frames = read_table(folder.frames)
    poses = poses_of(frames)
    stamps_ns = frames["stamp_ns"].to_pylist()
    period = period_text(stamps_ns[0], stamps_ns[-1]) if stamps_ns else ""
    positions = poses[:, :3, 3] if content["posed"] else np.zeros((0, 3))
    caption = Caption(folder.name, content["label_source"], content["voxel_size"], period)
    draw_map(folder.voxels, positions, caption, folder.picture)


def _log_outcome(name: str, fused: FusedSession) -> None:
    content = fused.content
    LOGGER.info(
        "%s: %d keyframes, %d voxels, labels from %s",
        name,
        content["keyframes"],
        content["voxels"],
        content["label_source"],
    )
    for problem in fused.problems:
        if not problem.is_reported:
            LOGGER.info("%s: %s", name, problem.text)

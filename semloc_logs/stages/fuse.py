"""Logs -> keyframes, submaps and the map of each session."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from semloc_logs.engines import Engine
from semloc_logs.errors import LogError, SemlocError
from semloc_logs.labels.segmentation import fingerprint as label_fingerprint
from semloc_logs.logs.annotation.annotate import content_fingerprint, recover
from semloc_logs.logs.poses.base_frame import BASE_LINK
from semloc_logs.logs.poses.mountings import NO_MOUNTINGS, Mountings
from semloc_logs.logs.problems import sentences, to_report
from semloc_logs.logs.session.lent_transforms import lent_transforms
from semloc_logs.mapping.session_fusion import FusedSession, FuseTask, fuse_session
from semloc_logs.settings import Resolved
from semloc_logs.stages.inputs import SessionInput, fingerprint_of, recorded_fingerprint
from semloc_logs.stages.report import Report
from semloc_logs.tables.table import read_json, read_table
from semloc_logs.voxels.store import poses_of
from semloc_logs.workspace import SessionFolder, Workspace

LOGGER = logging.getLogger(__name__)


def fuse(
    sessions: Sequence[SessionInput],
    work: Workspace,
    settings: Resolved,
    engine: Engine,
    *,
    overwrite: bool = False,
) -> Report:
    """Fuse each session. One that fails is named in ``failed``; the others go on.

    Raises LogError when all of them failed.
    """
    report = Report()
    tasks: list[FuseTask] = []
    logs = [log for session in sessions for log in session.logs]
    for session in sessions:
        others = [log for log in logs if log not in session.logs]
        task = _task(session, work.session(session.name), settings, others)
        if not overwrite and recorded_fingerprint(task.folder.session_json) == task.fingerprint:
            report.kept.append(session.name)
            report.skipped += read_json(task.folder.session_json)["skipped"]
        else:
            tasks.append(task)

    for task, outcome in zip(tasks, engine.map(_fuse_one, tasks), strict=True):
        if isinstance(outcome, SemlocError):
            report.failed.append(str(outcome))
            if len(tasks) > 1:  # the only one is raised below
                LOGGER.info("%s: %s", task.folder.name, outcome)
        else:
            report.done.append(task.folder.name)
            report.skipped += sentences(to_report(outcome.problems))
            _log_outcome(task.folder.name, outcome)
    if report.failed and not report.done and not report.kept:
        raise LogError(" ".join(report.failed))
    return report


def _task(
    session: SessionInput, folder: SessionFolder, settings: Resolved, others: Sequence[Path]
) -> FuseTask:
    """The task of a session, with the fingerprint of all that its tables depend on.

    ``others``: the logs of the other sessions, which may have transforms that this one lacks.
    """
    for log in session.logs:
        recover(log)
    inputs = [content_fingerprint(log) for log in session.logs]
    if session.poses is not None:
        inputs.append(f"poses {session.poses.fingerprint()}")
    mountings = _mountings(session, settings, others)
    inputs += [repr(transform) for transform in mountings.lent]
    fingerprint = fingerprint_of(
        (
            settings.fingerprint("logs", "fusion", "labels"),
            label_fingerprint(settings.labels),
            repr(sorted(session.topics.items())),
            *inputs,
        )
    )
    logs = tuple(Path(log).absolute() for log in session.logs)
    return FuseTask(
        logs, folder, settings, dict(session.topics), fingerprint, session.poses, mountings
    )


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


def _fuse_one(task: FuseTask) -> FusedSession | SemlocError:
    """An expected error is a result: one bad log does not end the night's work."""

    def draw(content: dict[str, Any]) -> None:
        # matplotlib is loaded only where something is drawn
        from semloc_logs.pictures.map_picture import Caption, draw_map

        poses = poses_of(read_table(task.folder.frames))
        positions = poses[:, :3, 3] if content["posed"] else np.zeros((0, 3))
        caption = Caption(task.folder.name, content["label_source"], content["voxel_size"])
        draw_map(task.folder.voxels, positions, caption, task.folder.picture)

    try:
        task.folder.session_json.unlink(missing_ok=True)  # half a replacement must not look done
        return fuse_session(task, on_tables=draw)
    except SemlocError as problem:
        return problem


def _log_outcome(name: str, fused: FusedSession) -> None:
    content = fused.content
    LOGGER.info(
        "%s: %d keyframes, %d submaps, %d voxels, labels from %s",
        name,
        content["keyframes"],
        len(content["submaps"]),
        content["voxels"],
        content["label_source"],
    )
    for problem in fused.problems:
        if not problem.is_reported:
            LOGGER.info("%s: %s", name, problem.text)

"""Fusing one session: log -> keyframes, submaps and the session map (paper 3.1).

One pass over the log, bounded memory.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import semloc_logs
from semloc_logs.errors import LogError
from semloc_logs.labels.labeller import Labeller
from semloc_logs.logs.poses.trajectory_file import TrajectoryFile
from semloc_logs.logs.problems import Problem, sentences, to_report
from semloc_logs.logs.sensors.depth import RangeNoise
from semloc_logs.logs.session.session import Session, SessionOptions, open_session
from semloc_logs.mapping.keyframes import collect
from semloc_logs.mapping.levelling import check_reach, level
from semloc_logs.mapping.map_tables import LevelSession, write_map
from semloc_logs.settings import Resolved
from semloc_logs.tables import contracts
from semloc_logs.tables.table import write_json, write_table
from semloc_logs.voxels.store import pose_columns
from semloc_logs.workspace import SessionFolder

# points are read this much farther than they are drawn into the map: they carve free space
READ_RANGE = 2.0


@dataclass(frozen=True, slots=True)
class FuseTask:
    """One session to fuse; picklable.

    ``made_from`` is what session.json keeps about its input, ``fingerprint`` of that and settings.
    """

    logs: tuple[Path, ...]
    folder: SessionFolder
    settings: Resolved
    topics: dict[str, str] = field(default_factory=dict)
    fingerprint: str = ""
    made_from: dict[str, Any] = field(default_factory=dict)
    poses: TrajectoryFile | None = None


@dataclass(frozen=True, slots=True)
class FusedSession:
    """The ``content`` of session.json, and the ``problems`` that it lists as sentences."""

    content: dict[str, Any]
    problems: tuple[Problem, ...]


def fuse_session(
    task: FuseTask,
    on_tables: Callable[[dict[str, Any]], None] = lambda _: None,
) -> FusedSession:
    """Write every table and, last, session.json.

    ``on_tables`` is called with its content just before that, when all tables are there. Raises
    LogError when the log has nothing to fuse, RoleError when its streams leave open what to use.
    """
    with closing(_opened(task)) as session:
        labeller = Labeller(task.settings.labels, session)
        metadata, content = _fused(task, session, labeller)
        _write_trajectory(task.folder, session, metadata)
        problems = [*session.problems, *labeller.problems]
        content = {
            **session.to_json(),
            "problems": sentences(problems),
            "labels": labeller.to_json(),
            "name": task.folder.name,
            "fingerprint": task.fingerprint,
            "made_from": task.made_from,
            "settings": task.settings.tables("logs", "fusion", "labels"),
            **metadata,
            **content,
            "skipped": sentences(to_report(problems)),
        }
    on_tables(content)
    write_json(task.folder.session_json, content)
    return FusedSession(content, tuple(problems))


def _opened(task: FuseTask) -> Session:
    """The session of the task's logs."""
    fusion = task.settings.fusion
    options = SessionOptions(
        topics=task.topics,
        min_range=fusion.min_range,
        max_range=READ_RANGE * fusion.max_range,
        noise=RangeNoise(fusion.depth_noise, fusion.disparity_noise),
        poses=task.poses,
        odometry=fusion.odometry,
        logs=task.settings.logs,
    )
    return open_session([*task.logs], options)


def _fused(
    task: FuseTask, session: Session, labeller: Labeller
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read the log and write the tables of the map: their metadata, and what they hold."""
    fusion = task.settings.fusion
    with _scratch(task.folder) as scratch:
        collected = collect(session, labeller, fusion, scratch, task.folder.name)
        if not len(collected):
            reasons = "; ".join(sentences(session.problems)) or "its sensor streams are empty"
            raise LogError(f"{session.name} gave no usable points: {reasons}")
        check_reach(session, collected, fusion.voxel_size)
        labeller.conclude()
        session_T_map, map_T_base = level(session, collected)
        metadata = {
            "schema_version": 1,
            "voxel_size": fusion.voxel_size,
            "session_T_map": session_T_map.tolist(),
            "label_space": "cityscapes",
            "label_source": labeller.source,
            "version": semloc_logs.__version__,
        }
        levelled = LevelSession(task.folder.name, collected, labeller, map_T_base, fusion, metadata)
        return metadata, write_map(levelled, task.folder)


@contextmanager
def _scratch(folder: SessionFolder) -> Iterator[Path]:
    """A folder for the keyframes of the pass, beside the results.

    Temporary folders of the system may be memory.
    """
    folder.path.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".scratch.", dir=folder.path) as name:
        yield Path(name)


def _write_trajectory(folder: SessionFolder, session: Session, metadata: dict[str, Any]) -> None:
    """Every pose of the log, in the session frame."""
    stamps_ns, poses = session.trajectory()
    table = contracts.table("trajectory", {"stamp_ns": stamps_ns, **pose_columns(poses)})
    write_table(folder.trajectory, table, metadata, ("stamp_ns",))

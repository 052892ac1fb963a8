"""Fusing one session: log -> keyframes, submaps and the session map (paper 3.1).

One pass over the log, bounded memory.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from semloc_logs.errors import LogError
from semloc_logs.labels.label_sources import labeller_of
from semloc_logs.labels.labeller import KeyframeView, Labeller
from semloc_logs.logs.poses.mountings import NO_MOUNTINGS, Mountings
from semloc_logs.logs.poses.trajectory_file import TrajectoryFile
from semloc_logs.logs.problems import Problem, sentences, sorted_problems, to_report
from semloc_logs.logs.sensors.depth import RangeNoise
from semloc_logs.logs.session.session import Session, SessionOptions, open_session
from semloc_logs.mapping.fit.findings import SessionFit
from semloc_logs.mapping.fit.fit_check import check_session
from semloc_logs.mapping.gravity import Gravity
from semloc_logs.mapping.keyframes import collect
from semloc_logs.mapping.levelling import check_reach, level
from semloc_logs.mapping.map_tables import LevelSession, write_map
from semloc_logs.numerics.transforms import apply
from semloc_logs.settings import STREET_VOXEL, Resolved
from semloc_logs.tables import contracts
from semloc_logs.tables.metadata import map_metadata
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
    mountings: Mountings = NO_MOUNTINGS


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
        labeller = labeller_of(task.settings.labels, session)
        fused = _fused(task, session, labeller)
        _write_trajectory(task.folder, session, fused.metadata)
        problems = sorted_problems([*session.problems, *fused.problems, *labeller.problems])
        content = {
            **session.to_json(),
            "problems": sentences(problems),
            "gravity": fused.gravity.to_json(),
            "labels": labeller.to_json(),
            "name": task.folder.name,
            "fingerprint": task.fingerprint,
            "made_from": task.made_from,
            "settings": task.settings.tables("logs", "fusion", "labels"),
            "fit": fused.check.to_json(),
            **fused.metadata,
            **fused.content,
            "skipped": sentences(to_report(problems)),
        }
    on_tables(content)
    write_json(task.folder.session_json, content)
    return FusedSession(content, tuple(problems))


def _opened(task: FuseTask) -> Session:
    """The session of the task's logs."""
    options = reading_options(task.settings, task.topics)
    return open_session([*task.logs], replace(options, poses=task.poses, mountings=task.mountings))


def reading_options(settings: Resolved, topics: Mapping[str, str]) -> SessionOptions:
    """How a log is read to be fused, or to be checked as it would be fused."""
    fusion = settings.fusion
    return SessionOptions(
        topics=topics,
        min_range=fusion.min_range,
        max_range=READ_RANGE * fusion.max_range,
        noise=RangeNoise(fusion.depth_noise, fusion.disparity_noise),
        odometry=fusion.odometry,
        logs=settings.logs,
    )


@dataclass(frozen=True, slots=True)
class _Fused:
    """The ``metadata`` of the tables, the ``content`` that session.json has of them, and findings.

    ``check``: whether poses and range data fit; ``gravity``: which way is up, and how sure.
    """

    metadata: dict[str, Any]
    content: dict[str, Any]
    check: SessionFit
    gravity: Gravity

    @property
    def problems(self) -> list[Problem]:
        """What the keyframes showed to be wrong or doubtful."""
        return [*self.check.problems, *self.gravity.problems]


def _fused(task: FuseTask, session: Session, labeller: Labeller) -> _Fused:
    """Read the log and write the tables of the map."""
    fusion = task.settings.fusion
    with _scratch(task.folder) as scratch:
        collected = collect(session, labeller, fusion, scratch, task.folder.name)
        if not len(collected):
            reasons = "; ".join(sentences(session.problems)) or "its sensor streams are empty"
            raise LogError(f"{session.name} gave no usable points: {reasons}")
        check_reach(session, collected, fusion.voxel_size)
        check = check_session(session, collected, fusion.voxel_size)
        levelled = level(session, collected, task.settings)
        check.add_tilt(levelled.tilt, session.roles.imu or "")
        map_T_base = levelled.map_T_base

        def view(keyframe: int) -> KeyframeView:
            points, labels, _ = collected.load(keyframe)
            map_T = map_T_base[keyframe]
            origin = apply(map_T, collected.origins[keyframe][None])[0]
            is_posed = collected.poses[keyframe] is not None
            return KeyframeView(apply(map_T, points), origin, labels, is_posed)

        labeller.conclude(view, fusion.voxel_size / STREET_VOXEL)
        metadata = map_metadata(fusion.voxel_size, levelled.session_T_map, labeller.source)
        keyframes = LevelSession(
            task.folder.name, collected, labeller, map_T_base, fusion, metadata
        )
        return _Fused(metadata, write_map(keyframes, task.folder), check, levelled.gravity)


@contextmanager
def _scratch(folder: SessionFolder) -> Iterator[Path]:
    """A folder for the keyframes of the pass, beside the results.

    Temporary folders of the system may be memory.
    """
    folder.path.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".scratch.", dir=folder.path) as name:
        yield Path(name)


def _write_trajectory(folder: SessionFolder, session: Session, metadata: dict[str, Any]) -> None:
    """Every pose of the log, in the session frame, and its satellite fixes."""
    stamps_ns, poses = session.trajectory()
    table = contracts.table("trajectory", {"stamp_ns": stamps_ns, **pose_columns(poses)})
    write_table(folder.trajectory, table, metadata, ("stamp_ns",))
    fixes = contracts.table("fixes", session.fixes())
    write_table(folder.fixes, fixes, metadata, ("stamp_ns",))

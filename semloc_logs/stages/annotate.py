"""Closures -> channels of a log."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

import semloc_logs
from semloc_logs.arrays import F64
from semloc_logs.closures.closure_tables import keyframe_at, read_closures
from semloc_logs.errors import WorkspaceError
from semloc_logs.exports.map_cloud import map_cloud
from semloc_logs.logs.annotation.annotate import (
    AnnotateReport,
    ClosureRecord,
    Results,
    annotate_copy,
    annotate_in_place,
    annotate_sidecar,
    recover,
)
from semloc_logs.logs.annotation.channels import COMMON_FRAME
from semloc_logs.logs.annotation.scene import Drive, Scene, StampedPose, Transform
from semloc_logs.logs.containers.open import open_log
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply, inverse, transform
from semloc_logs.pictures.colours import SESSIONS
from semloc_logs.pose_graph.merged_map import keyframe_poses
from semloc_logs.settings import Resolved
from semloc_logs.stages.inputs import session_name
from semloc_logs.workspace import Workspace

MOST_POSITIONS = 2000  # of a drive in the overview
SECTIONS = ("fusion", "labels", "descriptor", "query", "closures")


class AnnotationMode(StrEnum):
    """Where the channels go."""

    NONE = "none"
    COPY = "copy"
    IN_PLACE = "in-place"
    SIDECAR = "sidecar"


@dataclass(frozen=True, slots=True)
class Annotation:
    """``output`` is the file of a copy or a sidecar; ``overwrite`` allows to replace it.

    ``common``: /semloc/pose has the poses of ``semloc optimize``, in the common frame.
    """

    mode: AnnotationMode
    output: Path | None = None
    overwrite: bool = False
    common: bool = False


def annotate(
    log: Path,
    work: Workspace,
    settings: Resolved,
    annotation: Annotation,
    *,
    session: str | None = None,
) -> AnnotateReport:
    """Write the closures of the log's session (default: by the log's name) as channels.

    Raises WorkspaceError where the session is missing, or a copy or sidecar has no output.
    """
    recover(log)
    name = session or session_name(log)
    own = SessionMap(work.chosen([name])[0])
    if own.is_map:
        raise WorkspaceError(
            f"{log} is a map of points, which has no channels: annotate the logs of drives; they"
            " get the closures with it."
        )
    _check_log(log, own)
    results = _results(work, own, settings, common=annotation.common)
    if annotation.mode is AnnotationMode.IN_PLACE:
        return annotate_in_place(log, results)
    if annotation.output is None:
        raise WorkspaceError("Annotating needs an output file.")
    write = annotate_sidecar if annotation.mode is AnnotationMode.SIDECAR else annotate_copy
    return write(log, annotation.output, results, overwrite=annotation.overwrite)


def _check_log(log: Path, own: SessionMap) -> None:
    """WorkspaceError where the log is not one that the session was made from, by its start."""
    with closing(open_log(log)) as opened:
        start_ns = opened.start_ns
    logs = own.json["logs"]
    if start_ns not in [made_from["start_ns"] for made_from in logs]:
        name = own.folder.name
        paths = ", ".join(str(made_from["path"]) for made_from in logs)
        raise WorkspaceError(
            f"{log} is not the log that session '{name}' was made from ({paths}): name its own"
            " with --session."
        )


def _results(work: Workspace, own: SessionMap, settings: Resolved, *, common: bool) -> Results:
    """Every closure that the session takes part in, as query or as target."""
    name = own.folder.name
    rows = [
        row
        for row in read_closures(work.closures)
        if name in (row["query_session"], row["target_session"])
    ]
    others = _Sessions(work)
    records = [_record(others, own, name, row) for row in rows]
    log_times = own.frames["log_time_ns"].to_pylist()
    times = dict(zip(own.stamps_ns.tolist(), log_times, strict=True))
    notes = {
        "version": semloc_logs.__version__,
        "settings": settings.fingerprint(*SECTIONS),
        "fusion.voxel_size": str(settings.fusion.voxel_size),
    }
    frame_id = own.frame_id
    memory = settings.logs.memory
    scene = _scene(others, own, rows) if own.posed else Scene()
    if common:
        notes["pose_frame"] = COMMON_FRAME
        scene = _with_common_poses(scene, work, own)
    return Results(records, name, notes, times, frame_id=frame_id, memory=memory, scene=scene)


class _Sessions:
    """The sessions of a workspace, each read once."""

    def __init__(self, work: Workspace) -> None:
        self._work = work
        self._maps: dict[str, SessionMap] = {}

    def __getitem__(self, name: str) -> SessionMap:
        if name not in self._maps:
            self._maps[name] = SessionMap(self._work.session(name))
        return self._maps[name]

    def session_T_base(self, row: dict[str, Any], end: str) -> F64:
        """Pose (4, 4) of an end of a closure in the session frame of its log's poses."""
        session = self[row[f"{end}_session"]]
        keyframe = keyframe_at(session, row[f"{end}_stamp_ns"])
        session_T_map = np.array(session.json["session_T_map"])
        return np.asarray(session_T_map @ session.map_T_base[keyframe])


def _pose_of(row: dict[str, Any]) -> F64:
    """``target_T_query`` (4, 4)."""
    translation = np.array([row[f"t_{c}"] for c in "xyz"])
    return transform(translation, np.array([row[f"q_{c}"] for c in "xyzw"]))


def _record(sessions: _Sessions, own: SessionMap, name: str, row: dict[str, Any]) -> ClosureRecord:
    """A closure as the channels need it: with poses in the frames of the pose streams."""
    target_T_query = _pose_of(row)
    is_query = row["query_session"] == name
    session_T_own = sessions.session_T_base(row, "query" if is_query else "target")
    own_T_other = inverse(target_T_query) if is_query else target_T_query
    return ClosureRecord.from_row(
        row,
        session_T_query=sessions.session_T_base(row, "target") @ target_T_query
        if is_query
        else None,
        session_position=session_T_own[:3, 3],
        session_other=(session_T_own @ own_T_other)[:3, 3],
    )


def _scene(sessions: _Sessions, own: SessionMap, rows: list[dict[str, Any]]) -> Scene:
    """What viewers show around the closures: the frames of the messages, and a map.

    ``semloc/SESSION`` is the session frame of each session that closures connect with the log, laid
    by the most probable one. The vehicle's own poses are given where the log has no transform above
    the vehicle.
    """
    name = own.folder.name
    frame_id = own.frame_id
    start_ns = int(own.stamps_ns[0])
    placed = {name: np.eye(4)}
    for row in sorted(rows, key=lambda r: (-r["probability"], r["query_stamp_ns"])):
        ends = ("query", "target") if row["query_session"] == name else ("target", "query")
        other = row[f"{ends[1]}_session"]
        if other in placed or not sessions[other].posed:
            continue
        target_T_query = _pose_of(row)
        own_T_other = inverse(target_T_query) if ends[0] == "query" else target_T_query
        session_T_own, other_session_T_other = (sessions.session_T_base(row, end) for end in ends)
        placed[other] = session_T_own @ own_T_other @ inverse(other_session_T_other)
    fixed = [
        Transform(start_ns, frame_id, f"semloc/{session}", pose)
        for session, pose in sorted(placed.items())
        if f"semloc/{session}" != frame_id
    ]
    shown = {n: pose for n, pose in placed.items() if n != name} or placed
    cloud = map_cloud([(sessions[n], pose) for n, pose in shown.items()], frame_id)
    drives = [
        _drive(sessions[n], frame_id if n == name else f"semloc/{n}", SESSIONS[k % len(SESSIONS)])
        for k, n in enumerate(sorted(placed))
        if sessions[n].posed and not sessions[n].is_map
    ]
    return Scene(_moving(own), fixed, cloud=cloud, drives=drives)


def _moving(own: SessionMap) -> list[Transform]:
    """Poses of the topmost frame of the vehicle, where the log has nothing above it.

    A frame has one parent, so other logs get no transform between the vehicle and its poses.
    """
    root = own.json.get("vehicle_root")
    if root is None or root["frame"] == own.frame_id:
        return []
    session_T_base = np.array(own.json["session_T_map"]) @ own.map_T_base
    session_T_root = session_T_base @ np.array(root["base_T_root"])
    return [
        Transform(int(stamp_ns), own.frame_id, root["frame"], pose)
        for stamp_ns, pose in zip(own.stamps_ns, session_T_root, strict=True)
    ]


def _drive(session: SessionMap, frame_id: str, colour: tuple[int, int, int]) -> Drive:
    """The way of a session in its session frame, which is called ``frame_id``."""
    step = -(-len(session.map_T_base) // MOST_POSITIONS)
    positions = session.map_T_base[::step, :3, 3]
    red, green, blue = (part / 255 for part in colour)
    session_T_map = np.array(session.json["session_T_map"])
    return Drive(
        session.folder.name, frame_id, apply(session_T_map, positions), (red, green, blue, 1.0)
    )


def _with_common_poses(scene: Scene, work: Workspace, own: SessionMap) -> Scene:
    """The keyframes' poses in the common frame, and that frame in the one of the log's poses.

    Odometry drifts against the common frame, so its transform moves.
    """
    path = work.optimized_trajectory(own.folder.name)
    if not own.posed or not path.exists():
        raise WorkspaceError(
            f"Session {own.folder.name} has no poses in a common frame: run 'semloc optimize -w"
            f" {work.path}' first."
        )
    common_T_base = keyframe_poses(work, own)
    stamps_ns = own.stamps_ns.tolist()
    unknown = np.zeros((6, 6))  # as ROS has it
    poses = [
        StampedPose(stamp_ns, COMMON_FRAME, pose, unknown)
        for stamp_ns, pose in zip(stamps_ns, common_T_base, strict=True)
    ]
    session_T_base = np.array(own.json["session_T_map"]) @ own.map_T_base
    session_T_common = session_T_base @ inverse(common_T_base)
    frames = [
        Transform(stamp_ns, own.frame_id, COMMON_FRAME, pose)
        for stamp_ns, pose in zip(stamps_ns, session_T_common, strict=True)
    ]
    return replace(scene, moving=[*scene.moving, *frames], common=poses)

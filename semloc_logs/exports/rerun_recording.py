"""A recording for the Rerun viewer: maps, drives and closures in one frame, with timelines."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from semloc_logs.arrays import I64
from semloc_logs.closures.closure_tables import keyframe_at, read_closures
from semloc_logs.errors import SemlocError
from semloc_logs.exports.common_frame import KeyframeMotion
from semloc_logs.exports.map_cloud import ThinnedPoints
from semloc_logs.exports.map_points import SessionPoints
from semloc_logs.exports.point_formats import point_colours
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import translation_quaternion
from semloc_logs.pictures.placement import Placement, Tie, place_sessions
from semloc_logs.workspace import Workspace

# of drives, one after the other; told apart with any colour vision (Okabe, Ito)
DRIVES = (
    (0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (86, 180, 233), (213, 94, 0),
)  # fmt: skip
TIME = "time"  # when it was recorded
DRIVE = "drive"  # since the start of the session, so that drives of several days run side by side
LINE_RADIUS = 0.1  # m
AXIS_LENGTH = 2.0  # m


def write_rerun(path: Path, work: Workspace, sessions: Mapping[str, SessionMap]) -> None:
    """Write an .rrd file. SemlocError where rerun-sdk is not installed.

    Sessions lie as `semloc optimize` has them, else as their most probable closures lay them.
    Entities are maps/SESSION, drives/SESSION with the vehicle below it, and closures.
    """
    rr = rerun_library()
    rows = [
        row
        for row in (read_closures(work.closures) if work.closures.exists() else [])
        if row["query_session"] in sessions and row["target_session"] in sessions
    ]
    placement = place_sessions(work, sessions, [Tie.of_row(row) for row in rows])
    name = hashlib.sha256("\n".join(sessions).encode()).hexdigest()[:16]
    recording = rr.RecordingStream("semloc", recording_id=name)
    recording.save(str(path), default_blueprint=_blueprint())
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for number, session in enumerate(sessions.values()):
        if session.folder.name in placement.common_T_base and session.posed:
            _map(rr, recording, session, placement)
            _drive(rr, recording, session, placement, DRIVES[number % len(DRIVES)])
    _closures(rr, recording, rows, sessions, placement)
    recording.flush()
    recording.disconnect()


def rerun_library() -> Any:
    """The module; SemlocError where it is not installed."""
    try:
        return import_module("rerun")
    except ImportError:
        raise SemlocError(
            "semloc export --format rrd needs Rerun: run pip install 'semloc_logs[rerun]'."
        ) from None


def _blueprint() -> Any:
    layout = import_module("rerun.blueprint")
    return layout.Blueprint(
        layout.Horizontal(
            layout.Spatial3DView(origin="/", name="Maps, drives and closures"),
            layout.TimeSeriesView(origin="/probability", name="Probability of closures"),
            column_shares=[3, 1],
        ),
        layout.TimePanel(timeline=DRIVE),
    )


def _map(rr: Any, recording: Any, session: SessionMap, placement: Placement) -> None:
    """The thinned voxels of a session."""
    name = session.folder.name
    motion = KeyframeMotion(session.map_T_base, placement.common_T_base[name])
    points = SessionPoints(session, "voxels", "map", None)
    thinned = ThinnedPoints(2.0 * points.voxel_size)
    for batch, label in points.batches():
        thinned.add(batch, label)
    if not len(thinned.label):
        return
    placed = motion.points(thinned.points).astype(np.float32)
    colours = point_colours()[thinned.label]
    cloud = rr.Points3D(placed, colors=colours, radii=thinned.cell / 2.0)
    recording.log(["maps", name], cloud, static=True)


def _drive(
    rr: Any, recording: Any, session: SessionMap, placement: Placement, colour: tuple[int, ...]
) -> None:
    """The way of a session, and its vehicle that moves along it."""
    name = session.folder.name
    positions, quaternions = translation_quaternion(placement.common_T_base[name])
    line = rr.LineStrips3D(
        [positions.astype(np.float32)], colors=[colour], radii=LINE_RADIUS, labels=[name]
    )
    recording.log(["drives", name], line, static=True)
    vehicle = ["drives", name, "vehicle"]
    recording.log(vehicle, rr.TransformAxes3D(AXIS_LENGTH), static=True)
    recording.send_columns(
        rr.new_entity_path(vehicle),
        indexes=_times(rr, session.stamps_ns, session),
        columns=rr.Transform3D.columns(translation=positions, quaternion=quaternions),
    )


def _times(rr: Any, stamps_ns: I64, session: SessionMap) -> list[Any]:
    """Both timelines at stamps (n,) of a session."""
    since_start = (stamps_ns - session.stamps_ns[0]).astype("timedelta64[ns]")
    return [
        rr.TimeColumn(TIME, timestamp=stamps_ns.astype("datetime64[ns]")),
        rr.TimeColumn(DRIVE, duration=since_start),
    ]


def _closures(
    rr: Any,
    recording: Any,
    rows: Sequence[Mapping[str, Any]],
    sessions: Mapping[str, SessionMap],
    placement: Placement,
) -> None:
    """A line for each closure, and a plot of the probabilities over time."""
    lines = []
    shown: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        ends = []
        for end in ("query", "target"):
            name = row[f"{end}_session"]
            keyframe = keyframe_at(sessions[name], row[f"{end}_stamp_ns"])
            poses = placement.common_T_base.get(name)
            ends.append(np.full(3, np.nan) if poses is None else poses[keyframe, :3, 3])
        line = np.array(ends, np.float32)
        if np.isfinite(line).all():
            lines.append((line, row))
            own = shown.setdefault(row["query_session"], [])
            own.append((row["query_stamp_ns"], row["probability"]))
    if not lines:
        return
    colours = [_colour(row["probability"]) for _, row in lines]
    texts = [f"{row['query_session']} in {row['target_session']}" for _, row in lines]
    strips = rr.LineStrips3D(
        [line for line, _ in lines], colors=colours, radii=LINE_RADIUS, labels=texts,
        show_labels=False,
    )  # fmt: skip
    recording.log("closures", strips, static=True)
    for name, own in shown.items():
        stamps_ns, probabilities = np.array([s for s, _ in own]), [p for _, p in own]
        recording.send_columns(
            rr.new_entity_path(["probability", name]),
            indexes=_times(rr, stamps_ns, sessions[name]),
            columns=rr.Scalars.columns(scalars=probabilities),
        )


def _colour(probability: float) -> tuple[int, int, int]:
    """Red at 0.5 and below, green at 1."""
    good = min(1.0, max(0.0, 2.0 * probability - 1.0))
    return round(255 * (1.0 - good)), round(255 * good), 25

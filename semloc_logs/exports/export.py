"""Sessions and closures in other programs' formats: poses (TUM, KITTI), a pose graph (g2o), lines
on the earth (GeoJSON), points (PLY, PCD, LAS, LAZ, XYZ).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pyarrow as pa

from semloc_logs.closures.closure_tables import read_closures
from semloc_logs.errors import WorkspaceError
from semloc_logs.exports.common_frame import CommonFrame
from semloc_logs.exports.foxglove_layout import foxglove_layout
from semloc_logs.exports.geojson import geojson
from semloc_logs.exports.map_points import Bounds, SessionPoints
from semloc_logs.exports.point_formats import write_las, write_pcd, write_ply, write_xyz
from semloc_logs.exports.pose_graph_file import pose_graph
from semloc_logs.exports.rerun_recording import write_rerun
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import translation_quaternion
from semloc_logs.tables.atomic_files import replacing_file
from semloc_logs.tables.table import read_table
from semloc_logs.voxels.store import poses_of
from semloc_logs.workspace import Workspace

WRITERS: dict[str, Callable[[Path, SessionPoints], None]] = {
    "ply": write_ply,
    "pcd": write_pcd,
    "las": write_las,
    "laz": write_las,
    "xyz": write_xyz,
}
POINT_FORMATS = tuple(WRITERS)
LAYOUT = "foxglove-layout"
FORMATS = ("tum", "kitti", "g2o", LAYOUT, "geojson", "rrd", *POINT_FORMATS)


@dataclass(frozen=True, slots=True)
class Selection:
    """Which points: the ``voxels`` of the map or the points of the ``keyframes``, in which frame,
    and within which bounds of it (m) if any.
    """

    what: Literal["voxels", "keyframes"] = "voxels"
    frame: Literal["session", "map", "common", "utm"] = "session"
    bounds: Bounds | None = None


def export(
    work: Workspace,
    names: Sequence[str],
    form: str,
    output: Path,
    selection: Selection | None = None,
    *,
    overwrite: bool = False,
) -> list[Path]:
    """Write the sessions ``names`` (all if empty) to the folder ``output``; the files written.

    ``form`` is one of FORMATS. ``tum`` and ``kitti``: the trajectory in the session frame or the
    common one; ``g2o``: one pose graph of all; ``foxglove-layout``: a layout for annotated logs;
    ``geojson``: all drives and closures on the earth; ``rrd``: a recording of all for Rerun;
    the point formats: ``selection``, by default the centres of all occupied voxels in the session
    frame. Raises WorkspaceError when a session is not there or does not fit the format, or a file
    exists and ``overwrite`` is not set; SemlocError when a library is missing.
    """
    sessions = {folder.name: SessionMap(folder) for folder in work.chosen(names)}
    chosen = selection or Selection()
    if form == "g2o":
        path = _free(output / "closures.g2o", overwrite)
        _write(path, pose_graph(sessions, work).encode())
        return [path]
    if form == "geojson":
        path = _free(output / "drives.geojson", overwrite)
        _write(path, geojson(work, sessions).encode())
        return [path]
    if form == "rrd":
        path = _free(output / "drives.rrd", overwrite)
        with replacing_file(path, suffix=".rrd") as temporary:
            write_rerun(temporary, work, sessions)
        return [path]
    paths = {name: _free(output / _file_name(name, form, chosen), overwrite) for name in sessions}
    for name, session in sessions.items():
        if form in ("tum", "kitti"):
            table = poses_table(work, session, chosen.frame)
            _write(paths[name], (tum if form == "tum" else kitti)(table))
            continue
        if form == LAYOUT:
            _write(paths[name], foxglove_layout(session, _targets(work, name)).encode())
            continue
        is_common = chosen.frame in ("common", "utm")
        common = CommonFrame(work, session, chosen.frame == "utm") if is_common else None
        points = SessionPoints(session, chosen.what, chosen.frame, chosen.bounds, common)
        with replacing_file(paths[name], suffix=f".{form}") as temporary:
            WRITERS[form](temporary, points)
    return list(paths.values())


def _targets(work: Workspace, name: str) -> set[str]:
    """The sessions in which closures place a session."""
    rows = read_closures(work.closures) if work.closures.exists() else []
    return {row["target_session"] for row in rows if row["query_session"] == name}


def _file_name(session: str, form: str, chosen: Selection) -> str:
    if form == "kitti":
        return f"{session}.txt"
    if form == LAYOUT:
        return f"{session}.{LAYOUT}.json"
    is_of_keyframes = form != "tum" and chosen.what == "keyframes"
    return f"{session}{'-keyframes' if is_of_keyframes else ''}.{form}"


def _free(path: Path, overwrite: bool) -> Path:
    """``path``; WorkspaceError where it exists and must not be replaced."""
    if path.exists() and not overwrite:
        raise WorkspaceError(f"{path} exists already: give --overwrite or another folder with -o.")
    return path


def _write(path: Path, content: bytes) -> None:
    with replacing_file(path) as temporary:
        temporary.write_bytes(content)


def poses_table(work: Workspace, session: SessionMap, frame: str) -> pa.Table:
    """The trajectory in the ``session`` frame, or in the ``common`` one of ``semloc optimize``."""
    if frame != "common":
        return read_table(session.folder.trajectory)
    path = work.optimized_trajectory(session.folder.name)
    if not path.exists():
        raise WorkspaceError(
            f"Session {session.folder.name} has no poses in a common frame: run 'semloc optimize"
            f" -w {work.path}' first."
        )
    return read_table(path)


def tum(table: pa.Table) -> bytes:
    """Seconds, position (m), quaternion xyzw of the base frame: the whole trajectory."""
    t, q = translation_quaternion(poses_of(table))
    lines = [
        f"{stamp // 10**9}.{stamp % 10**9:09d} "
        + " ".join(f"{x:.12g}" for x in (*position, *quaternion))
        for stamp, position, quaternion in zip(table["stamp_ns"].to_pylist(), t, q, strict=True)
    ]
    return "".join(f"{line}\n" for line in lines).encode()


def kitti(table: pa.Table) -> bytes:
    """Twelve numbers a line: the upper 3 x 4 of each pose of the base frame, row-major."""
    return "".join(
        " ".join(f"{x:.12g}" for x in pose[:3].ravel()) + "\n" for pose in poses_of(table)
    ).encode()

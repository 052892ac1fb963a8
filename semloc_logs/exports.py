"""Sessions and closures in other programs' formats: poses (TUM, KITTI), a pose graph (g2o), the map as points (PLY)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semloc_logs.closures.queries import SessionMap
from semloc_logs.closures.results import keyframe_at, read_closures
from semloc_logs.errors import WorkspaceError
from semloc_logs.geometry import inverse, transform, translation_quaternion
from semloc_logs.labels.space import cityscapes
from semloc_logs.tables import read_table, replacing_file
from semloc_logs.voxels.store import poses_of
from semloc_logs.workspace import Workspace

F64 = NDArray[np.float64]
ODOMETRY_SIGMA_M, ODOMETRY_SIGMA_RAD = (0.02, 0.01), (0.002, 0.002)  # fixed part, and part per metre of road


def export(work: Workspace, names: Sequence[str], form: str, output: Path) -> list[Path]:
    """Write the sessions ``names`` (all if empty) to the folder ``output``; the files written.

    ``tum`` and ``kitti``: keyframe poses in the session frame; ``ply``: centres of the map's occupied voxels in the session frame, coloured
    by class; ``g2o``: one pose graph of all. Raises WorkspaceError when a session is not there.
    """
    known = {f.name: SessionMap(f) for f in work.sessions()}
    missing = [n for n in names if n not in known]
    if missing or not known:
        raise WorkspaceError(
            f"{work.path} has no fused session {', '.join(missing) or 'at all'} (there are: {', '.join(known) or 'none'})."
        )
    sessions = {n: known[n] for n in names or known}
    if form == "g2o":
        path = output / "closures.g2o"
        _write(path, pose_graph(sessions, work).encode())
        return [path]
    made: dict[str, Callable[[SessionMap], bytes]] = {"tum": tum, "kitti": kitti, "ply": ply}
    paths = []
    for name, session in sessions.items():
        paths.append(output / f"{name}.{'txt' if form == 'kitti' else form}")
        _write(paths[-1], made[form](session))
    return paths


def _write(path: Path, content: bytes) -> None:
    with replacing_file(path) as temporary:
        temporary.write_bytes(content)


def tum(session: SessionMap) -> bytes:
    """Seconds, position (m), quaternion xyzw of the base frame in the session frame: the whole trajectory."""
    table = read_table(session.folder.trajectory)
    t, q = translation_quaternion(poses_of(table))
    lines = [
        f"{stamp // 10**9}.{stamp % 10**9:09d} " + " ".join(f"{x:.9g}" for x in (*position, *quaternion))
        for stamp, position, quaternion in zip(table["stamp_ns"].to_pylist(), t, q, strict=True)
    ]
    return "".join(f"{line}\n" for line in lines).encode()


def kitti(session: SessionMap) -> bytes:
    """Twelve numbers a line: the upper 3 x 4 of ``session_T_base`` of each pose of the trajectory, row-major."""
    poses = poses_of(read_table(session.folder.trajectory))
    return "".join(" ".join(f"{x:.9g}" for x in pose[:3].ravel()) + "\n" for pose in poses).encode()


def ply(session: SessionMap) -> bytes:
    """Binary PLY: x y z (m), class, and a colour for each class."""
    fields = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("label", "u1")])
    session_T_map, v = np.array(session.json["session_T_map"]), session.json["voxel_size"]
    colour = np.full((256, 3), 128, np.uint8)
    known = cityscapes().colours
    colour[: len(known)] = known
    parts = []
    for path in sorted(session.folder.voxels.rglob("*.parquet")):
        table = read_table(path, ["ix", "iy", "iz", "label"])
        centres = (np.stack([table[c].to_numpy() for c in ("ix", "iy", "iz")], 1) + 0.5) * v
        rows = np.zeros(len(centres), fields)
        rows["label"] = table["label"].to_numpy()
        for k, c in enumerate("xyz"):
            rows[c] = centres @ session_T_map[k, :3] + session_T_map[k, 3]
        for k, c in enumerate(("red", "green", "blue")):
            rows[c] = colour[rows["label"], k]
        parts.append(rows)
    every = np.concatenate(parts) if parts else np.zeros(0, fields)
    kinds = {"<f4": "float", "|u1": "uchar"}
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(every)}"]
    head += [f"property {kinds[fields[name].str]} {name}" for name in fields.names or ()]
    return "\n".join([*head, "end_header\n"]).encode() + every.tobytes()


def pose_graph(sessions: dict[str, SessionMap], work: Workspace) -> str:
    """g2o text: keyframes as vertices (each session in its own map frame), odometry between neighbours, closures of closures.parquet.

    Information is of (x y z, rotation vector in radians) in the axes of the edge's second vertex, as GTSAM and Ceres read it. Odometry
    has no covariance in a workspace; it is given 2 cm + 1 % of the road and 2 mrad + 2 mrad/m.
    """
    lines: list[str] = []
    first: dict[str, int] = {}
    for name, session in sessions.items():
        first[name] = sum(len(s.stamps_ns) for s in list(sessions.values())[: len(first)])
        lines.append(f"# {name}: vertices {first[name]} .. {first[name] + len(session.stamps_ns) - 1}")
        lines += [f"VERTEX_SE3:QUAT {first[name] + i} {_pose_text(pose)}" for i, pose in enumerate(session.map_T_base)]
    for name, session in sessions.items():
        if session.posed:
            lines += _odometry(first[name], session.map_T_base)
    for row in read_closures(work.closures) if work.closures.exists() else []:
        if row["query_session"] in sessions and row["target_session"] in sessions:
            query, target = (
                first[row[f"{end}_session"]] + keyframe_at(sessions[row[f"{end}_session"]], row[f"{end}_stamp_ns"])
                for end in ("query", "target")
            )
            target_T_query = transform(np.array([row[f"t_{c}"] for c in "xyz"]), np.array([row[f"q_{c}"] for c in "xyzw"]))
            turn = np.kron(np.eye(2), target_T_query[:3, :3].T)  # from the target's axes into the query's
            covariance = turn @ np.array(row["covariance"]).reshape(6, 6) @ turn.T
            lines.append(_edge(target, query, target_T_query, covariance))
    return "\n".join(lines) + "\n"


def _odometry(first: int, poses: F64) -> list[str]:
    out = []
    for i in range(len(poses) - 1):
        step = inverse(poses[i]) @ poses[i + 1]
        road = float(np.linalg.norm(step[:3, 3]))
        sigma = np.repeat([a + b * road for a, b in (ODOMETRY_SIGMA_M, ODOMETRY_SIGMA_RAD)], 3)
        out.append(_edge(first + i, first + i + 1, step, np.diag(sigma**2)))
    return out


def _edge(a: int, b: int, a_T_b: F64, covariance: F64) -> str:
    upper = np.linalg.inv(covariance)[np.triu_indices(6)]
    return f"EDGE_SE3:QUAT {a} {b} {_pose_text(a_T_b)} " + " ".join(f"{x:.9g}" for x in upper)


def _pose_text(pose: F64) -> str:
    t, q = translation_quaternion(pose)
    return " ".join(f"{x:.9g}" for x in (*t, *q))

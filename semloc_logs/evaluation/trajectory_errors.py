"""Errors of trajectories against the truth by the definitions of evo: ATE (its APE) and RPE.

Both are root mean squares. ATE: distances after the best rigid alignment (Umeyama 1991, without
scale). RPE: errors of the way between consecutive poses that are a given road apart.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64
from semloc_logs.errors import WorkspaceError
from semloc_logs.evaluation.truth import TrueTrack, read_truth
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse
from semloc_logs.tables.table import read_metadata, read_table
from semloc_logs.voxels.store import poses_of
from semloc_logs.workspace import Workspace

RPE_ROAD_M = 10.0


@dataclass(frozen=True, slots=True)
class SessionErrors:
    """Errors of one session, None where nothing can be compared."""

    session: str
    frame: str
    poses: int
    ate_before_m: float | None
    ate_after_m: float | None
    rpe_before_m: float | None
    rpe_after_m: float | None
    rpe_before_deg: float | None
    rpe_after_deg: float | None


@dataclass(frozen=True, slots=True)
class TrajectoryErrors:
    """Errors of all sessions together.

    Before: the odometry of each session, which has a frame of its own, so each is aligned alone.
    After: each session is aligned alone, too, in ``ate_alone_after_m``; in ``ate_after_m`` all
    sessions of one frame together, which also counts where they lie to each other.
    """

    ate_before_m: float | None
    ate_after_m: float | None
    ate_alone_after_m: float | None
    rpe_before_m: float | None
    rpe_after_m: float | None
    rpe_before_deg: float | None
    rpe_after_deg: float | None
    rpe_road_m: float
    trajectories: list[SessionErrors]

    def to_json(self) -> dict[str, Any]:
        """As ``--json`` prints it."""
        return asdict(self)


def rigid_alignment(reference: F64, estimate: F64) -> F64:
    """``reference_T_estimate`` (4, 4) of the least squared distances of points (n, 3)."""
    to_estimate = estimate.mean(0)
    to_reference = reference.mean(0)
    covariance = (reference - to_reference).T @ (estimate - to_estimate)
    u, _, vt = np.linalg.svd(covariance)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    out = np.eye(4)
    out[:3, :3] = u @ flip @ vt
    out[:3, 3] = to_reference - out[:3, :3] @ to_estimate
    return out


def aligned_distances(reference: F64, estimate: F64) -> F64:
    """Distances (n,) of the positions of poses (n, 4, 4), the estimate aligned."""
    a = reference[:, :3, 3]
    b = estimate[:, :3, 3]
    alignment = rigid_alignment(a, b)
    return np.asarray(np.linalg.norm(b @ alignment[:3, :3].T + alignment[:3, 3] - a, axis=1))


def relative_errors(reference: F64, estimate: F64, road_m: float) -> tuple[F64, F64]:
    """Position (m) and rotation (deg) errors of pairs of poses ``road_m`` of the estimate apart."""
    steps = np.linalg.norm(np.diff(estimate[:, :3, 3], axis=0), axis=1)
    ids = [0]
    travelled = 0.0
    for row, step in enumerate(steps.tolist(), start=1):
        travelled += step
        if travelled >= road_m:
            ids.append(row)
            travelled = 0.0
    first = np.array(ids[:-1], np.int64)
    second = np.array(ids[1:], np.int64)
    true_step = inverse(reference[first]) @ reference[second]
    error = inverse(true_step) @ inverse(estimate[first]) @ estimate[second]
    turns = Rotation.from_matrix(error[:, :3, :3].reshape(-1, 3, 3)).magnitude()
    return np.linalg.norm(error[:, :3, 3], axis=1), np.degrees(turns)


def rms(values: F64) -> float | None:
    """Root mean square; None without values."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None


@dataclass(frozen=True, slots=True, eq=False)
class _Compared:
    """True poses of a session at the stamps where they are known, and the two estimates.

    Without odometry there is nothing before.
    """

    session: str
    frame: str
    truth: F64
    before: F64 | None
    after: F64


def trajectory_errors(work: Workspace, truth: Path) -> TrajectoryErrors:
    """Errors of trajectory.parquet and of optimized/ against the file ``truth``.

    Raises TruthError when it is missing or wrong, WorkspaceError before ``semloc optimize``.
    """
    sessions = {folder.name: SessionMap(folder) for folder in work.chosen(())}
    tracks = read_truth(truth, sessions)
    every = [_compared(work, sessions[name], track) for name, track in tracks.items()]
    compared = [part for part in every if len(part.truth)]
    posed = [(c.truth, c.before) for c in compared if c.before is not None]
    before = [relative_errors(true, estimate, RPE_ROAD_M) for true, estimate in posed]
    after = [relative_errors(c.truth, c.after, RPE_ROAD_M) for c in compared]
    return TrajectoryErrors(
        _pooled([aligned_distances(true, estimate) for true, estimate in posed]),
        _pooled(_together(compared)),
        _pooled([aligned_distances(c.truth, c.after) for c in compared]),
        _pooled([m for m, _ in before]),
        _pooled([m for m, _ in after]),
        _pooled([deg for _, deg in before]),
        _pooled([deg for _, deg in after]),
        RPE_ROAD_M,
        [_session_errors(c) for c in compared],
    )


def _pooled(parts: list[F64]) -> float | None:
    return rms(np.concatenate([np.zeros(0), *parts]))


def _together(compared: list[_Compared]) -> list[F64]:
    """Distances (n,) of each component, all of its sessions under one alignment."""
    by_frame: dict[str, list[_Compared]] = {}
    for part in compared:
        by_frame.setdefault(part.frame, []).append(part)
    return [
        aligned_distances(
            np.concatenate([p.truth for p in parts]), np.concatenate([p.after for p in parts])
        )
        for parts in by_frame.values()
    ]


def _session_errors(part: _Compared) -> SessionErrors:
    ate_before, rpe_before_m, rpe_before_deg = _figures(part.truth, part.before)
    ate_after, rpe_after_m, rpe_after_deg = _figures(part.truth, part.after)
    return SessionErrors(
        part.session,
        part.frame,
        len(part.truth),
        ate_before,
        ate_after,
        rpe_before_m,
        rpe_after_m,
        rpe_before_deg,
        rpe_after_deg,
    )


def _figures(truth: F64, estimate: F64 | None) -> tuple[float | None, float | None, float | None]:
    """ATE (m), and RPE in metres and in degrees."""
    if estimate is None:
        return None, None, None
    metres, degrees = relative_errors(truth, estimate, RPE_ROAD_M)
    return rms(aligned_distances(truth, estimate)), rms(metres), rms(degrees)


def _compared(work: Workspace, session: SessionMap, track: TrueTrack) -> _Compared:
    name = session.folder.name
    path = work.optimized_trajectory(name)
    if not path.exists():
        raise WorkspaceError(
            f"Session {name} has no optimised trajectory: run 'semloc optimize -w {work.path}'."
        )
    optimized = read_table(path)
    stamps_ns = np.asarray(optimized["stamp_ns"].to_numpy())
    recorded = read_table(session.folder.trajectory)
    same = np.array_equal(stamps_ns, recorded["stamp_ns"].to_numpy())
    if session.posed and not same:
        raise WorkspaceError(
            f"{path} is of an earlier log of session {name}: run 'semloc optimize -w {work.path}'."
        )
    true_poses, known = track.at(stamps_ns)
    before = poses_of(recorded)[known] if session.posed else None
    frame = str(read_metadata(path)["frame"])
    return _Compared(name, frame, true_poses[known], before, poses_of(optimized)[known])

"""Alignments of simulated towns against the truth: which are right, and how far off the others are.

Every town is judged into a table of its own. The models of the acceptance are fitted on these
tables, and the report of the acceptance is made from them: neither needs a new query.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64, Bools
from semloc_logs.closures.acceptance.joint_poses import JointPoses, Uncertainty
from semloc_logs.closures.acceptance.placements import Placed
from semloc_logs.closures.alignment_tables import read_alignments
from semloc_logs.closures.closure import FEATURES, Alignments, Features
from semloc_logs.closures.session_pairs import known_pairs
from semloc_logs.errors import WorkspaceError
from semloc_logs.evaluation.truth import CORRECT_DEG, CORRECT_M, TrueTrack, read_truth
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse
from semloc_logs.tables.table import read_metadata, read_table, write_table
from semloc_logs.workspace import Workspace

Rows = Bools | NDArray[np.int64]

COPIES = "repeating"  # in the names of towns of copied blocks
UNCERTAINTY = tuple(f.name for f in fields(Uncertainty))


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """Alignments (n) of several towns: ``features`` (n,), where they lie (the caller sets the
    probabilities there), how ``uncertain`` they are, whether they are ``right`` (n,), and their
    errors (n, 6) in metres and radians, in the axes of the target.
    """

    town: NDArray[np.object_]
    features: Features[F64]
    placed: Placed
    uncertain: Uncertainty
    right: Bools
    error: F64
    voxel_size: float

    @property
    def error_m(self) -> F64:
        """Errors of the positions (n,), metres."""
        return np.asarray(np.linalg.norm(self.error[:, :3], axis=1))

    @property
    def error_deg(self) -> F64:
        """Errors of the rotations (n,), degrees."""
        return np.asarray(np.degrees(np.linalg.norm(self.error[:, 3:], axis=1)))

    @property
    def nees_position(self) -> F64:
        """Squares (n,) of the errors over their covariance, of 3 degrees of freedom (Bar-Shalom et
        al., Estimation with Applications to Tracking and Navigation, 2001, section 5.4).
        """
        return normalised_squares(self.error[:, :3], self.uncertain.covariance[:, :3, :3])

    @property
    def nees_pose(self) -> F64:
        """The same of position and rotation (n,), of 6 degrees of freedom."""
        return normalised_squares(self.error, self.uncertain.covariance)

    @property
    def clear(self) -> Bools:
        """Right, or wrong by three times the bounds (n,): cases in between teach neither side."""
        return np.asarray(
            self.right | (self.error_m > 3 * CORRECT_M) | (self.error_deg > 3 * CORRECT_DEG)
        )

    @property
    def copies(self) -> Bools:
        """Which lie in towns of copied blocks (n,)."""
        return np.array([COPIES in town for town in self.town], bool)

    def __len__(self) -> int:
        return len(self.town)

    def part(self, rows: Rows) -> Judged:
        """Some of them."""
        return replace(
            self,
            town=self.town[rows],
            features=self.features.part(rows),
            placed=self.placed.part(rows),
            uncertain=self.uncertain.part(rows),
            right=self.right[rows],
            error=self.error[rows],
        )

    def with_poses(self, joint: JointPoses) -> Judged:
        """Judged anew with the poses that neighbours estimate together."""
        error = self.error + joint.increment
        return replace(
            self,
            uncertain=replace(self.uncertain, covariance=joint.covariance),
            right=is_right(error),
            error=error,
        )


def is_right(error: F64) -> Bools:
    """Which errors (n, 6), in metres and radians, are within the bounds of right closures."""
    position, rotation = np.linalg.norm(error.reshape(-1, 2, 3), axis=2).T
    return np.asarray((position <= CORRECT_M) & (np.degrees(rotation) <= CORRECT_DEG))


def judge_town(work: Workspace, truth: Path, town: str, output: Path) -> None:
    """All alignments of a workspace, judged, as the table ``output``.

    Columns: the sessions, stamps, standard deviation and features of alignments, and town, query,
    road, target_road, own_* and at_* (the query in its own map by odometry, in the target's by
    alignment), the fields of :class:`Uncertainty`, and error (6), error_m and right, which are null
    without a true pose.
    """
    maps = {f.name: SessionMap(f) for f in work.sessions()}
    tracks = read_truth(truth, maps)
    rows = Alignments.joined(
        read_alignments(work.alignments(pair.query, pair.target), pair.query, pair.target)
        for pair in sorted(known_pairs(work))
    )
    n = len(rows)
    road, target_road = np.zeros((2, n))
    own, map_T_query = np.zeros((2, n, 4, 4))
    for (query, target), of_pair in rows.by_pair():
        ends = (rows.query_keyframe[of_pair], rows.target_keyframe[of_pair])
        road[of_pair] = maps[query].distance[ends[0]]
        target_road[of_pair] = maps[target].distance[ends[1]]
        own[of_pair] = maps[query].map_T_base[ends[0]]
        map_T_query[of_pair] = maps[target].map_T_base[ends[1]] @ rows.target_T_query[of_pair]
    query_session, target_session = rows.sessions()
    uncertain = Uncertainty.of(rows, maps)
    columns: dict[str, Any] = {
        "query_session": query_session.tolist(),
        "target_session": target_session.tolist(),
        "query_stamp_ns": rows.query_stamp_ns,
        "target_stamp_ns": rows.target_stamp_ns,
        "sigma": rows.sigma(),
        **{name: getattr(rows.features, name) for name in FEATURES},
        "town": [town] * n,
        "query": rows.query_keyframe,
        "road": road,
        "target_road": target_road,
        **{name: _lists(getattr(uncertain, name)) for name in UNCERTAINTY},
        **_errors(rows, tracks),
    }
    columns |= {f"own_{i}{j}": own[:, i, j] for i in range(3) for j in range(4)} | {
        f"at_{i}{j}": map_T_query[:, i, j] for i in range(3) for j in range(4)
    }
    metadata = {k: read_metadata(work.rejected).get(k) for k in ("voxel_size", "queries")}
    write_table(output, pa.table(columns), metadata | {"town": town})


def _errors(rows: Alignments, tracks: Mapping[str, TrueTrack]) -> dict[str, pa.Array]:
    """The errors of alignments and whether they are right, as columns; null where a true pose is
    not known.
    """
    n = len(rows)
    known = np.zeros(n, bool)
    error = np.zeros((n, 6))  # in the target's axes, as the covariance is
    for (query, target), of_pair in rows.by_pair():
        if query not in tracks or target not in tracks:
            continue
        query_pose, query_known = tracks[query].at(rows.query_stamp_ns[of_pair])
        target_pose, target_known = tracks[target].at(rows.target_stamp_ns[of_pair])
        known[of_pair] = query_known & target_known
        true = inverse(target_pose) @ query_pose
        measured = rows.target_T_query[of_pair]
        error[of_pair, :3] = measured[:, :3, 3] - true[:, :3, 3]
        turned = measured[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2)
        error[of_pair, 3:] = Rotation.from_matrix(turned).as_rotvec()

    return {
        "error": _lists(error),
        "error_m": pa.array(np.linalg.norm(error[:, :3], axis=1), mask=~known),
        "right": pa.array(is_right(error), mask=~known),
    }


def _lists(values: F64) -> pa.Array:
    """Values (n, ...) as a column of lists of one length."""
    flat = values.reshape(len(values), -1)
    return pa.FixedSizeListArray.from_arrays(pa.array(flat.ravel()), flat.shape[1])


def normalised_squares(errors: F64, covariance: F64) -> F64:
    """Squares (n,) of ``errors`` (n, d) over their ``covariance`` (n, d, d): d in the mean, where
    it is true.
    """
    solved = np.linalg.solve(covariance, errors[..., None])[..., 0]
    return np.asarray(np.einsum("nd,nd->n", errors, solved))


def read_judged(paths: Sequence[Path]) -> Judged:
    """The tables of several towns. WorkspaceError without any, or of another version."""
    if not paths:
        raise WorkspaceError("No town was judged yet: run 'collect' first.")
    tables = [read_table(path) for path in paths]
    for path, held in zip(paths, tables, strict=True):
        if not {"error", *UNCERTAINTY} <= set(held.column_names):
            raise WorkspaceError(f"{path} is of another version: remove it and collect again.")
    table = pa.concat_tables(tables)
    table = table.filter(table["right"].is_valid())
    column = {
        name: table[name].to_numpy()
        for name in table.column_names
        if name not in ("town", "query_session", "target_session", "error", *UNCERTAINTY)
    }

    def lists(name: str, *shape: int) -> F64:
        flat = table[name].combine_chunks().flatten().to_numpy()
        return np.asarray(flat.reshape(len(table), *shape))

    def poses(prefix: str) -> F64:
        out = np.tile(np.eye(4), (len(table), 1, 1))
        for i in range(3):
            for j in range(4):
                out[:, i, j] = column[f"{prefix}_{i}{j}"]
        return out

    names = {
        name: np.array(table[name].to_pylist(), object)
        for name in ("town", "query_session", "target_session")
    }
    placed = Placed(
        names["query_session"],
        names["target_session"],
        column["query"],
        column["road"],
        column["target_road"],
        poses("own"),
        poses("at"),
        column["sigma"],
        np.full(len(table), np.nan),
        np.ones(len(table), bool),
    )
    return Judged(
        names["town"],
        Features(*(column[n] for n in FEATURES)),
        placed,
        Uncertainty(
            lists("covariance", 6, 6),
            lists("map_R_target", 3, 3),
            lists("query_drift", 6),
            lists("target_drift", 6),
        ),
        column["right"].astype(bool),
        lists("error", 6),
        float(read_metadata(paths[0])["voxel_size"]),
    )

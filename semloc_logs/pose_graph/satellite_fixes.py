"""Satellite fixes of sessions as positions of keyframes, east, north and up of one point."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from semloc_logs.arrays import F64, I64
from semloc_logs.logs.poses.navsat import LocalFrame
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse, transform
from semloc_logs.pose_graph.graph import Datum, Positions
from semloc_logs.tables.table import read_table
from semloc_logs.voxels.store import poses_of

MOST_SIGMA = 20.0  # m, horizontally; a fix that is less certain tells nothing
USUAL_SIGMA = 5.0  # m, where the receiver does not know
UNKNOWN_HEIGHT = 1e4  # m, the uncertainty of a height that was not measured
MOST_GAP_NS = 1_000_000_000  # of a fix to the poses around it


def read_fixes(session: SessionMap) -> pa.Table | None:
    """The usable fixes of a session; None where it has none."""
    table = session.fixes
    if not session.posed or table is None:
        return None
    east, north = (table[f"sigma_{axis}"].to_numpy() for axis in ("east", "north"))
    table = table.filter(pa.array(~(np.maximum(east, north) > MOST_SIGMA)))
    return table if table.num_rows else None


def datum_of(fixes: pa.Table) -> Datum:
    """The point of the first fix."""
    row = fixes.slice(0, 1).to_pylist()[0]
    height = float(row["height"])
    return row["latitude_deg"], row["longitude_deg"], height if np.isfinite(height) else 0.0


def positions_of(
    session: SessionMap, fixes: pa.Table, datum: Datum, least_sigma: float
) -> Positions:
    """Of the keyframes of a session, at most one for each; vertices are their numbers.

    ``least_sigma`` (m) is added to what the receiver gives.
    """
    table = read_table(session.folder.trajectory)
    stamps_ns = np.asarray(fixes["stamp_ns"].to_numpy())
    is_known, map_T_base = _poses_at(session, table, stamps_ns)
    fixes = fixes.filter(pa.array(is_known))
    stamps_ns = stamps_ns[is_known]
    keyframe, rows = _of_keyframes(session.stamps_ns, stamps_ns)
    chosen = fixes.take(rows)

    antenna = _columns(chosen, [f"antenna_{axis}" for axis in "xyz"])
    antenna = np.nan_to_num(antenna)  # else the base frame is taken as its place
    base_T_fix = inverse(session.map_T_base[keyframe]) @ map_T_base[rows]
    antenna = np.einsum("nij,nj->ni", base_T_fix[:, :3, :3], antenna) + base_T_fix[:, :3, 3]

    places = _columns(chosen, ["latitude_deg", "longitude_deg", "height"])
    is_high = np.isfinite(places[:, 2])
    places[~is_high, 2] = datum[2]
    local = LocalFrame(*datum)
    position = np.array([local.position(*place) for place in places]).reshape(-1, 3)
    sigma = _columns(chosen, [f"sigma_{axis}" for axis in ("east", "north", "up")])
    sigma = np.where(np.isfinite(sigma) & (sigma > 0), sigma, USUAL_SIGMA)
    sigma[~is_high, 2] = UNKNOWN_HEIGHT
    return Positions(keyframe, antenna, position, np.hypot(sigma, least_sigma))


def _columns(table: pa.Table, names: list[str]) -> F64:
    return np.stack([table[name].to_numpy() for name in names], axis=1).astype(float)


def _of_keyframes(keyframes_ns: I64, stamps_ns: I64) -> tuple[I64, I64]:
    """Keyframes (k,) that have fixes, and the row of the fix that is nearest in time to each."""
    after = np.clip(np.searchsorted(keyframes_ns, stamps_ns), 0, len(keyframes_ns) - 1)
    before = np.maximum(after - 1, 0)
    is_before = np.abs(keyframes_ns[before] - stamps_ns) < np.abs(keyframes_ns[after] - stamps_ns)
    keyframe = np.where(is_before, before, after)
    order = np.lexsort((np.abs(keyframes_ns[keyframe] - stamps_ns), keyframe))
    chosen, first = np.unique(keyframe[order], return_index=True)
    return chosen, order[first]


def _poses_at(
    session: SessionMap, trajectory: pa.Table, stamps_ns: I64
) -> tuple[NDArray[np.bool_], F64]:
    """Which stamps (n,) lie between poses that are close, and ``map_T_base`` of those."""
    known_ns, rows = np.unique(trajectory["stamp_ns"].to_numpy(), return_index=True)
    map_T_session = inverse(np.array(session.json["session_T_map"], float))
    known = map_T_session @ poses_of(trajectory)[rows]
    if len(known_ns) < 2:
        return np.zeros(len(stamps_ns), bool), np.zeros((0, 4, 4))
    after = np.clip(np.searchsorted(known_ns, stamps_ns), 1, len(known_ns) - 1)
    is_between = (stamps_ns >= known_ns[0]) & (stamps_ns <= known_ns[-1])
    is_known = is_between & (known_ns[after] - known_ns[after - 1] <= MOST_GAP_NS)
    seconds = (stamps_ns[is_known] - known_ns[0]) * 1e-9
    known_s = (known_ns - known_ns[0]) * 1e-9
    turns = Slerp(known_s, Rotation.from_matrix(known[:, :3, :3]))(seconds)
    places = np.stack([np.interp(seconds, known_s, known[:, axis, 3]) for axis in range(3)], 1)
    return is_known, transform(places, turns.as_quat().reshape(-1, 4))

"""Drives and closures as GeoJSON (RFC 7946), where satellites place them on the earth."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.closures.closure_tables import keyframe_at, read_closures
from semloc_logs.errors import WorkspaceError
from semloc_logs.exports.common_frame import earth_frame
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.pose_graph.merged_map import keyframe_poses
from semloc_logs.pose_graph.satellite_fixes import read_fixes
from semloc_logs.tables.table import read_table
from semloc_logs.workspace import Workspace

DEGREES = 7  # decimals: a centimetre
METRES = 2
COPIED = ("query_session", "target_session", "query_stamp_ns", "target_stamp_ns", "probability")


def geojson(work: Workspace, sessions: Mapping[str, SessionMap]) -> str:
    """A line for each drive, and one for each closure between two of them.

    Drives are the poses of ``semloc optimize``, or without these the satellite fixes; closures
    need the poses. WorkspaceError where no session is on the earth.
    """
    features: list[dict[str, Any]] = []
    places: dict[str, F64] = {}
    for name, session in sessions.items():
        local = earth_frame(work, session)
        if local is not None:
            places[name] = local.geodetic(keyframe_poses(work, session)[:, :3, 3])
            features.append(_drive(session, places[name], "semloc optimize"))
        elif (fixes := read_fixes(session)) is not None:
            columns = ("latitude_deg", "longitude_deg", "height")
            recorded = np.stack([fixes[c].to_numpy() for c in columns], axis=1)
            features.append(_drive(session, recorded, "satellite fixes"))
    if not features:
        raise WorkspaceError(
            f"No session of {work.path} has satellite fixes, so none can be placed on the earth."
        )
    features += _closures(work, sessions, places)
    content = {"type": "FeatureCollection", "features": features}
    return json.dumps(content, separators=(",", ":"), allow_nan=False) + "\n"


def _drive(session: SessionMap, places: F64, source: str) -> dict[str, Any]:
    stamps_ns = session.stamps_ns
    properties = {
        "kind": "drive",
        "session": session.folder.name,
        "start_ns": int(stamps_ns[0]),
        "end_ns": int(stamps_ns[-1]),
        "positions": source,
    }
    # a line has two positions at least
    return _line(places if len(places) > 1 else np.repeat(places, 2, axis=0), properties)


def _closures(
    work: Workspace, sessions: Mapping[str, SessionMap], places: Mapping[str, F64]
) -> Iterator[dict[str, Any]]:
    kept = _kept(work)
    for row in read_closures(work.closures) if work.closures.exists() else []:
        names = [row[f"{end}_session"] for end in ("query", "target")]
        if not all(name in places for name in names):
            continue
        ends = [
            places[name][keyframe_at(sessions[name], row[f"{end}_stamp_ns"])]
            for name, end in zip(names, ("query", "target"), strict=True)
        ]
        properties = {"kind": "closure", **{name: row[name] for name in COPIED}}
        known = kept.get(tuple(row[name] for name in COPIED[:4]))
        yield _line(np.array(ends), properties | ({} if known is None else {"kept": known}))


def _kept(work: Workspace) -> dict[tuple[Any, ...], bool]:
    """Whether `semloc optimize` kept each closure, by its ends."""
    if not work.graph_closures.exists():
        return {}
    rows = read_table(work.graph_closures).to_pylist()
    return {tuple(row[name] for name in COPIED[:4]): row["kept"] for row in rows}


def _line(places: F64, properties: dict[str, Any]) -> dict[str, Any]:
    """Of latitudes, longitudes (degrees) and heights (n, 3), NaN where these are unknown."""
    coordinates = [
        [round(float(lon), DEGREES), round(float(lat), DEGREES)]
        + ([round(float(height), METRES)] if np.isfinite(height) else [])
        for lat, lon, height in places
    ]
    geometry = {"type": "LineString", "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}

"""The data of the page: sessions, closures, rejected hypotheses, settings; no pictures."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import PurePath
from typing import Any

import numpy as np

import semloc_logs
from semloc_logs.arrays import F64
from semloc_logs.closures.closure import FEATURES, Agreement, Closure, Rejected
from semloc_logs.closures.closure_tables import AGREEMENT_COLUMNS
from semloc_logs.closures.exclusions import Exclusions
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply
from semloc_logs.pictures.placement import Placement, keyframe_near, pose_of
from semloc_logs.report_page.packed import BYTE, FLOAT, INDEX, SIGNED, packed
from semloc_logs.tables import contracts
from semloc_logs.tables.table import read_json
from semloc_logs.workspace import Workspace

Row = Mapping[str, Any]
# session and stamp of the query, session and stamp of the target
Key = tuple[str, int, str, int]
MOST_PLACES = 1200  # of a drive in the picture
VOTES = tuple(f.name for f in fields(Agreement))
FACTORS = ("place_probability", "position_confidence", "mode_share")
NUMBER = re.compile(r"\d+(?:\.\d+)?")


@dataclass(frozen=True, slots=True, eq=False)
class Tables:
    """The tables of a workspace; ``outcomes`` are its alignments with what decided about them.

    ``refused`` are the closures that the optimised poses do not rest on, with the reason.
    ``exclusions``: which sessions and pairs get no closures.
    """

    maps: Mapping[str, SessionMap]
    closures: list[dict[str, Any]]
    rejected: Sequence[Row]
    outcomes: Mapping[Key, Closure | Rejected]
    placement: Placement
    refused: Mapping[Key, str]
    exclusions: Exclusions


def key_of(row: Row) -> Key:
    """The query and the target of a row of closures.parquet or rejected.parquet."""
    return (
        row["query_session"],
        row["query_stamp_ns"],
        row["target_session"],
        row["target_stamp_ns"],
    )


def content_of(work: Workspace, tables: Tables, settings: Mapping[str, Any]) -> dict[str, Any]:
    """All data of the page as JSON values; ``settings`` are the sections of the tables."""
    names = _order(tables.maps)
    number = {name: k for k, name in enumerate(names)}
    groups = [[number[name] for name in group] for group in tables.placement.groups]
    columns = {c["name"]: c["meaning"] for c in contracts.contract("rejected")["columns"]}
    meanings = {name: columns[name] for name in FEATURES}
    meanings |= {field: columns[column] for column, field in AGREEMENT_COLUMNS.items()}
    return {
        "version": semloc_logs.__version__,
        "workspace": work.path.absolute().name,
        "sessions": [_session(tables, name) for name in names],
        "groups": groups,
        "optimised": [number[n] for n in names if n in tables.placement.optimised],
        "closures": _closures(tables, number),
        "rejected": _rejected(tables, number),
        "excluded": _excluded(tables, names),
        "exclusions": tables.exclusions.sentences(),
        "features": list(FEATURES),
        "votes": list(VOTES),
        "factors": list(FACTORS),
        "meanings": meanings,
        "settings": dict(settings),
        "run": read_json(work.summary) if work.summary.exists() else {},
        "failed": [
            {"session": path.stem, "reason": str(read_json(path).get("reason"))}
            for path in work.failures()
        ],
    }


def _order(maps: Mapping[str, SessionMap]) -> list[str]:
    """Sessions by the time of their recording."""
    return sorted(maps, key=lambda name: (int(maps[name].stamps_ns[0]), name))


def _excluded(tables: Tables, names: Sequence[str]) -> dict[str, str]:
    """Why two sessions, or one and itself, get no closures, by their numbers as "0 1"."""
    reasons = {}
    for k, name in enumerate(names):
        for m, other in enumerate(names[: k + 1]):
            reason = tables.exclusions.reason(name, other)
            if reason:
                reasons[f"{m} {k}"] = reason
    return reasons


# -- sessions


def _session(tables: Tables, name: str) -> dict[str, Any]:
    session = tables.maps[name]
    content = session.json
    stamps_ns = session.stamps_ns
    seconds = (stamps_ns - stamps_ns[0]) / 1e9
    places = tables.placement.common_T_base[name][:, :3, 3]
    known = np.flatnonzero(np.isfinite(places).all(1))
    shown = known[:: max(1, -(-len(known) // MOST_PLACES))]
    if len(known) and shown[-1] != known[-1]:
        shown = np.append(shown, known[-1])
    poses = content.get("poses") or {}
    return {
        "name": name,
        "logs": [
            {"file": PurePath(str(log["path"])).name, "format": log.get("format")}
            for log in content.get("logs", [])
        ],
        "start_ns": str(int(stamps_ns[0])),
        "duration_s": float(seconds[-1]),
        "road_m": float(session.distance[-1]),
        "keyframes": len(stamps_ns),
        "submaps": len(session.submaps),
        "voxels": content.get("voxels"),
        "voxel_size": content.get("voxel_size"),
        "label_source": session.label_source,
        "posed": session.posed,
        "pose_source": (content.get("pose_source") or {}).get("kind"),
        "poses": {k: poses.get(k) for k in ("count", "gaps", "length_m") if k in poses},
        "base_frame": content.get("base_frame"),
        "session_frame": content.get("session_frame"),
        "up": (content.get("gravity") or {}).get("source"),
        "version": content.get("version"),
        "streams": [
            [s.get("role"), s.get("topic"), s.get("type"), s.get("count")]
            for s in content.get("streams", [])
        ],
        "warnings": [str(text) for text in content.get("skipped", [])],
        "misfits": session.misfits,
        "drive": {
            "t": packed(seconds[shown]),
            "xy": packed(places[shown, :2]),
            "is_line": session.posed,
        },
    }


# -- closures


class _Ends:
    """Where the two ends of rows lie, in the picture and in their maps."""

    def __init__(self, tables: Tables, number: Mapping[str, int], rows: Sequence[Row]) -> None:
        self.rows = rows
        self.common = np.full((len(rows), 2, 4, 4), np.nan)
        self.own = np.full((len(rows), 2, 4, 4), np.nan)
        self.seconds = np.zeros((len(rows), 2))
        self.sessions = np.zeros((len(rows), 2), int)
        for k, row in enumerate(rows):
            for end, side in enumerate(("query", "target")):
                name = row[f"{side}_session"]
                session = tables.maps[name]
                keyframe = keyframe_near(session, row[f"{side}_stamp_ns"])
                self.common[k, end] = tables.placement.common_T_base[name][keyframe]
                self.own[k, end] = session.map_T_base[keyframe]
                since_ns = row[f"{side}_stamp_ns"] - int(session.stamps_ns[0])
                self.seconds[k, end] = since_ns / 1e9
                self.sessions[k, end] = number[name]

    def columns(self) -> dict[str, list[str]]:
        """The columns that closures and rejected hypotheses share."""
        return {
            "sessions": packed(self.sessions, INDEX),
            "t": packed(self.seconds),
            "xy": packed(self.common[:, :, :2, 3]),
            "probability": packed([row["probability"] for row in self.rows]),
            "overlap": packed([row["overlap"] for row in self.rows]),
            "inliers": packed([row["inliers"] for row in self.rows], SIGNED),
            "words": packed([row["words"] for row in self.rows], SIGNED),
        }


def _closures(tables: Tables, number: Mapping[str, int]) -> dict[str, Any]:
    rows = tables.closures
    ends = _Ends(tables, number, rows)
    poses = np.array([pose_of(row) for row in rows]).reshape(-1, 4, 4)
    covariance = np.array([row["covariance"] for row in rows], float).reshape(-1, 6, 6)
    offset = np.full(len(rows), np.nan)  # of the query's end from where the closure puts it
    for k, pose in enumerate(poses):
        aligned = apply(ends.common[k, 1], pose[None, :3, 3])[0]
        offset[k] = np.linalg.norm(aligned - ends.common[k, 0, :3, 3])
    outcomes = [tables.outcomes.get(key_of(row)) for row in rows]
    missing = [np.nan] * (len(FEATURES) + len(VOTES) + len(FACTORS))
    evidence = [missing if o is None else _evidence(o) for o in outcomes]
    return {
        "count": len(rows),
        **ends.columns(),
        "pose": packed(_planar(poses)),
        "height": packed(poses[:, 2, 3]),
        "own": packed(_planar(ends.own)),
        "heading": packed(_planar(ends.common)[..., 2]),
        "sigma": packed(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))),
        "ellipse": packed(
            np.stack([covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]], 1)
        ),
        "offset": packed(offset),
        "refused": {
            str(k): tables.refused[key]
            for k, row in enumerate(rows)
            if (key := key_of(row)) in tables.refused
        },
        "evidence": packed(np.array(evidence).reshape(len(rows), len(missing))),
    }


def _planar(poses: F64) -> F64:
    """x, y and the yaw (..., 3) of poses (..., 4, 4)."""
    yaw = np.arctan2(poses[..., 1, 0], poses[..., 0, 0])
    return np.stack([poses[..., 0, 3], poses[..., 1, 3], yaw], -1)


def _evidence(outcome: Closure | Rejected) -> list[float]:
    decision = outcome.decision
    return [
        *(getattr(outcome.alignment.features, name) for name in FEATURES),
        *(getattr(decision.agreement, name) for name in VOTES),
        *(getattr(decision, name) for name in FACTORS),
    ]


# -- rejected hypotheses


def _rejected(tables: Tables, number: Mapping[str, int]) -> dict[str, Any]:
    """The best rejected hypothesis of each query without closure, and of each pair of sessions."""
    closed = {(row["query_session"], row["query_stamp_ns"]) for row in tables.closures}
    of_query: dict[Any, Row] = {}
    of_pair: dict[Any, Row] = {}
    for row in tables.rejected:
        query = (row["query_session"], row["query_stamp_ns"])
        if query not in closed:
            _keep_best(of_query, query, row)
        _keep_best(of_pair, (row["query_session"], row["target_session"]), row)
    rows = list(of_query.values())
    at_query = {id(row) for row in rows}
    rows += [row for row in of_pair.values() if id(row) not in at_query]
    at_pair = {id(row) for row in of_pair.values()}

    sentences: dict[str, int] = {}
    figures: list[float] = []
    first: list[int] = []
    which: list[int] = []
    for row in rows:
        sentence, numbers = _template(row["reason"])
        which.append(sentences.setdefault(sentence, len(sentences)))
        first.append(len(figures))
        figures += numbers
    return {
        "count": len(rows),
        **_Ends(tables, number, rows).columns(),
        "at_query": packed([id(row) in at_query for row in rows], BYTE),
        "at_pair": packed([id(row) in at_pair for row in rows], BYTE),
        "sigma": packed([row["sigma"] for row in rows]),
        "evidence": packed(
            np.array([[row[name] for name in FEATURES] for row in rows], float).reshape(
                len(rows), len(FEATURES)
            )
        ),
        "sentence": packed(which, INDEX),
        "first_figure": packed(first, SIGNED),
        "figures": packed(figures, FLOAT),
        "sentences": list(sentences),
    }


def _keep_best(best: dict[Any, Row], key: Any, row: Row) -> None:
    other = best.get(key)
    rank = (row["probability"], row["structure"])
    if other is None or rank > (other["probability"], other["structure"]):
        best[key] = row


def _template(reason: str) -> tuple[str, list[float]]:
    """A sentence with ``{decimals}`` for its numbers, and the numbers: many reasons, few forms."""
    numbers = NUMBER.findall(reason)
    forms = iter([len(n.partition(".")[2]) for n in numbers])
    # a reason does not hold braces
    return NUMBER.sub(lambda _: f"{{{next(forms)}}}", reason), [float(n) for n in numbers]

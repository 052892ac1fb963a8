"""The content of a picture of a closure or a rejected hypothesis.

The query, the map that it was laid on, and subvolumes that matched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.query_map import Query
from semloc_logs.alignment.target_map import Target
from semloc_logs.arrays import F64, U8
from semloc_logs.closures.closure_tables import keyframe_at, read_closures
from semloc_logs.closures.database import Database
from semloc_logs.closures.matching import allowed_words, match_words
from semloc_logs.closures.query import build_query, query_members
from semloc_logs.closures.visibility import Visibility, visible_to
from semloc_logs.errors import WorkspaceError
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse, turned_about_z
from semloc_logs.settings import Resolved, Settings
from semloc_logs.subvolumes.completed import completed, load_completion, states_of
from semloc_logs.subvolumes.cut import SIZE, turn
from semloc_logs.tables.table import read_metadata, read_table
from semloc_logs.voxels.grid import UNOBSERVED_STATE
from semloc_logs.voxels.store import poses_of
from semloc_logs.workspace import Workspace

APART = 3 * SIZE // 4  # voxels between subvolumes that are shown
AGREES = 8  # voxels that a word match may lie off the alignment
TURNED = np.radians(15.0)  # and by how much it may be turned against it


@dataclass(frozen=True, slots=True)
class Choice:
    """A row of closures.parquet, or of rejected.parquet if it has a ``reason``.

    ``target_T_query`` (4, 4) is its pose.
    """

    row: dict[str, Any]
    target_T_query: F64

    @property
    def reason(self) -> str:
        return str(self.row.get("reason") or "")

    @property
    def accepted(self) -> bool:
        return "reason" not in self.row

    @property
    def covariance(self) -> F64 | None:
        """(6, 6) of an accepted closure."""
        return (
            np.array(self.row["covariance"], float).reshape(6, 6)
            if "covariance" in self.row
            else None
        )


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """A subvolume of the query and of the target whose words match.

    States (32, 32, 32): of the query, turned into the target's axes; as the network completes it;
    and of the target. ``distance`` of the words in bits; ``centre`` of the target's subvolume in
    its map, metres.
    """

    query: U8
    completion: U8
    target: U8
    distance: int
    centre: tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class ClosureView:
    """A query in the map of its target.

    ``map_T_query`` (4, 4) as aligned, ``before`` as it lies without an alignment. ``roads`` are the
    positions (n, 3) of the target's and the query's keyframes, the latter in the query's frame.
    """

    choice: Choice
    query: Query
    target: Target
    map_T_query: F64
    before: F64
    query_T_base: F64
    map_R_target: F64
    roads: tuple[F64, F64]
    matches: tuple[Match, ...]
    label_source: str


@dataclass(frozen=True, slots=True)
class Wanted:
    """Which closures to show.

    Closure ``number`` (from 1 on, in the order of closures.parquet); or the result of the query of
    ``session`` nearest to ``at`` seconds, of the log or since its first keyframe; or the ``count``
    best closures and the best rejected hypothesis.
    """

    session: str | None = None
    at: float | None = None
    number: int | None = None
    count: int = 2


def choose(work: Workspace, wanted: Wanted) -> list[Choice]:
    """The rows to show.

    The best closures of different pairs of sessions come first; the rejected hypothesis belongs to
    a query without a closure, if there is any. WorkspaceError when there is nothing to show.
    """
    accepted = _choices(work, work.closures)
    rejected = _choices(work, work.rejected)
    if wanted.number is not None:
        if not 1 <= wanted.number <= len(accepted):
            raise WorkspaceError(
                f"{work.closures} has {len(accepted)} closures, and no closure {wanted.number}: "
                "give a number from 1 on."
            )
        return [accepted[wanted.number - 1]]
    if wanted.session is not None:
        accepted, rejected = (
            [c for c in rows if c.row["query_session"] == wanted.session]
            for rows in (accepted, rejected)
        )
    if wanted.at is not None:
        chosen = _at(work, accepted + rejected, wanted.at)
    else:
        localised = {(c.row["query_session"], c.row["query_stamp_ns"]) for c in accepted}
        without_closure = [
            c
            for c in rejected
            if (c.row["query_session"], c.row["query_stamp_ns"]) not in localised
        ]
        chosen = (
            _varied(_best_first(accepted), wanted.count)
            + _best_first(without_closure or rejected)[:1]
        )
    if not chosen:
        whose = f" of session '{wanted.session}'" if wanted.session else ""
        raise WorkspaceError(
            f"{work.path} has neither a closure nor a rejected hypothesis{whose}: the "
            "sessions share no place that was found."
        )
    return chosen


def _choices(work: Workspace, path: Path) -> list[Choice]:
    work.chosen(())
    if not path.exists():
        raise WorkspaceError(f"{path} does not exist: run 'semloc close -w {work.path}' first.")
    return [
        Choice(row, T)
        for row, T in zip(read_closures(path), poses_of(read_table(path)), strict=True)
    ]


def _best_first(choices: Sequence[Choice]) -> list[Choice]:
    return sorted(
        choices,
        key=lambda c: (
            -c.row["probability"],
            -c.row["overlap"],
            c.row["query_session"],
            c.row["query_stamp_ns"],
        ),
    )


def _at(work: Workspace, choices: Sequence[Choice], seconds: float) -> list[Choice]:
    """The best choice of the query that is nearest to a time, accepted ones first."""

    def away(choice: Choice) -> float:
        first = SessionMap(work.session(choice.row["query_session"])).stamps_ns[0] / 1e9
        stamp = choice.row["query_stamp_ns"] / 1e9
        return float(abs(stamp - (seconds if seconds >= first else seconds + first)))

    nearest = min(map(away, choices), default=0.0)
    nearest_choices = [c for c in choices if away(c) <= nearest + 1e-6]
    return sorted(nearest_choices, key=lambda c: (bool(c.reason), -c.row["probability"]))[:1]


def _varied(choices: Sequence[Choice], count: int) -> list[Choice]:
    """The first of each pair of sessions, then the others."""
    first: dict[tuple[str, str], Choice] = {}
    for c in choices:
        first.setdefault((c.row["query_session"], c.row["target_session"]), c)
    leading = list(first.values())
    return [*leading, *(c for c in choices if c not in leading)][:count]


def closing_settings(work: Workspace) -> Resolved:
    """The settings that the workspace's closures were found with, which its tables hold."""
    try:
        return Settings.model_validate(read_metadata(work.closures)["settings"]).resolved()
    except (KeyError, ValueError):
        raise WorkspaceError(
            f"{work.closures} does not hold its settings: run 'semloc close -w {work.path} "
            "--overwrite'."
        ) from None


def closure_view(
    work: Workspace, choice: Choice, settings: Resolved, most_matches: int = 3
) -> ClosureView:
    """All that a picture of ``choice`` needs; ``settings`` are the ones of the closures."""
    row = choice.row
    session, target = (
        SessionMap(work.session(row[f"{end}_session"])) for end in ("query", "target")
    )
    query_keyframe = keyframe_at(session, row["query_stamp_ns"])
    target_keyframe = keyframe_at(target, row["target_stamp_ns"])
    database = Database(work, (row["target_session"],), settings)
    visible = visible_to(database, session, query_keyframe)
    query, query_T_base = build_query(session, query_keyframe, settings)
    map_T_target = target.map_T_base[target_keyframe]
    map_T_query = map_T_target @ choice.target_T_query @ inverse(query_T_base)
    group = _group(visible, target_keyframe)
    before = np.eye(4)
    if session.folder.name == target.folder.name:
        before[:3, 3] = session.map_T_base[query_keyframe, :3, 3]  # by odometry
    else:
        # as if the query had been at the target's keyframe
        before = map_T_target @ inverse(query_T_base)
    members = query_members(session, query_keyframe, settings)
    road = session.map_T_base[members, :3, 3] - session.map_T_base[query_keyframe, :3, 3]
    ground = float(session.ground_z[query_keyframe] - session.map_T_base[query_keyframe, 2, 3])
    aligned = _Aligned(visible, session, query, ground, map_T_query, group)
    return ClosureView(
        choice,
        query,
        visible.target(group),
        map_T_query,
        before,
        query_T_base,
        map_T_target[:3, :3],
        (target.map_T_base[:, :3, 3], road),
        tuple(_matches(aligned, most_matches)),
        str(target.json["label_source"]),
    )


def drawn(view: ClosureView) -> dict[str, Any]:
    """The content of a picture for JSON: the row, ``accepted``, and the word matches."""
    matches = [{"bits": m.distance, "target_position_m": list(m.centre)} for m in view.matches]
    return {**view.choice.row, "accepted": view.choice.accepted, "matches": matches}


def _group(visible: Visibility, keyframe: int) -> int:
    """The submap in whose middle a keyframe of the only target session is."""

    def off(g: int) -> int:
        seen = visible.keyframes(g)
        return min(keyframe - seen[0], seen[-1] - keyframe) if len(seen) else -len(seen) - 1

    return max(range(len(visible.database.places)), key=off)


@dataclass(frozen=True, slots=True, eq=False)
class _Aligned:
    """A query aligned with submap ``group`` of the only target session of ``visible``.

    ``ground`` is the height of the ground in the query's frame, metres.
    """

    visible: Visibility
    session: SessionMap
    query: Query
    ground: float
    map_T_query: F64
    group: int

    @property
    def yaw(self) -> float:
        """Of the query in the target's map, radians."""
        return float(np.arctan2(self.map_T_query[1, 0], self.map_T_query[0, 0]))


def _matches(aligned: _Aligned, most: int) -> list[Match]:
    """Word matches that agree with the alignment, nearest first, none beside another."""
    if not most:
        return []
    places = allowed_words(aligned.visible, aligned.session)
    if not places:
        return []
    # a single target session has one kind of words
    variant, allowed = next(iter(places.items()))
    words, matches = match_words(
        aligned.visible.database, variant, allowed, aligned.query, aligned.ground
    )

    # the query's subvolumes, voxels in the map's axes, and those that agree
    laid = turned_about_z(words.centre.astype(float), np.full(len(words.centre), aligned.yaw))
    size = aligned.visible.database.settings.fusion.voxel_size
    position = aligned.map_T_query[:3, 3]
    offset = np.abs(matches.centre - laid[matches.query] * size - position).max(1)
    turned = np.abs(np.mod(matches.yaw - aligned.yaw + np.pi, 2 * np.pi) - np.pi)
    agrees = (matches.group == aligned.group) & (offset < AGREES * size) & (turned < TURNED)
    rows = np.flatnonzero(agrees)

    nearest_first = rows[np.argsort(matches.distance[rows], kind="stable")]
    chosen: list[int] = []
    for row in nearest_first.tolist():
        centre = laid[matches.query[row], :2]
        if all(np.abs(centre - laid[matches.query[o], :2]).max() >= APART for o in chosen):
            chosen.append(row)
        if len(chosen) == most:
            break
    if not chosen:
        return []
    centres = matches.centre[chosen]
    states = _states(aligned, variant, laid[matches.query[chosen]], centres)
    return [
        Match(*three, int(distance), (float(x), float(y), float(z)))
        for three, distance, (x, y, z) in zip(
            zip(*states, strict=True), matches.distance[chosen], centres, strict=True
        )
    ]


def _states(aligned: _Aligned, variant: str, laid: F64, centres: F64) -> tuple[U8, U8, U8]:
    """States (n, 32, 32, 32) of the query's subvolumes, as completed, and of the target's.

    ``laid`` (n, 3) are the query's centres, voxels in the map's axes; ``centres`` (n, 3) the
    target's, metres in its map.
    """
    settings = aligned.visible.database.settings
    half = SIZE // 2
    box, corner = _turned(aligned.query, aligned.yaw)
    corners = np.round(laid).astype(int) - corner - half
    query = np.stack([_cut(box, c, half) for c in corners])
    blocks = aligned.visible.target(aligned.group).blocks
    low = np.round(centres / settings.fusion.voxel_size).astype(int) - half
    target = np.stack([blocks.dense(c, (SIZE, SIZE, SIZE)) for c in low])
    completion = completed(
        load_completion(variant, settings.descriptor.weights), (query, target, query)
    )
    inner = query[:, half:-half, half:-half]
    return inner, states_of(completion.completed, completion.classes), target


def _turned(query: Query, yaw: float) -> tuple[U8, NDArray[np.int64]]:
    """States (x, y, z) of the query turned by ``yaw`` (rad) about its vertical.

    The second value is the corner voxel (3,).
    """
    low, high = query.blocks.bounds()
    state = query.blocks.dense(low, tuple((high - low).tolist()))
    half = query.reach + SIZE // 2
    box = np.empty((2 * half, 2 * half, state.shape[2]), np.uint8)
    turn(state, low.astype(np.int64), -yaw, np.array([0.0, 0.0, low[2] + state.shape[2] / 2]), box)
    return box, np.array([-half, -half, low[2]])


def _cut(box: U8, corner: NDArray[np.integer], margin: int) -> U8:
    """States of the subvolume at ``corner`` of ``box`` with a ``margin`` in x and y.

    Unobserved outside the box.
    """
    pad = SIZE + margin
    padded = np.pad(box, pad, constant_values=UNOBSERVED_STATE)
    x, y, z = (corner + pad).tolist()
    return padded[x - margin : x + SIZE + margin, y - margin : y + SIZE + margin, z : z + SIZE]

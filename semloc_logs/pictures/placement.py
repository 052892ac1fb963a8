"""All sessions in one picture: optimised poses where they are there, else a tree of closures.

Sessions that closures connect are a group. Each group has a frame of its own; the groups are laid
beside each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import interpolate, inverse, transform, yaw_transform
from semloc_logs.tables.table import read_metadata, read_table
from semloc_logs.voxels.store import poses_of
from semloc_logs.workspace import Workspace

GAP = 0.06  # between groups, over the width of the picture
LEAST_GAP = 240  # voxels: a map reaches about half as far beside its road
ASPECT = 1.6  # of the picture: width over height
MOST_COLUMNS = 40  # of groups


@dataclass(slots=True, eq=False)
class Placement:
    """Where each session lies in the picture.

    ``common_T_base`` (n, 4, 4) are the poses of the keyframes, NaN where they are not known;
    ``common_T_map`` (4, 4) lays the session's map below them. ``groups`` are names of sessions,
    the largest group first. ``optimised`` are the sessions with optimised poses, with their frames:
    poses of the same frame belong together.
    """

    common_T_base: dict[str, F64] = field(default_factory=dict)
    common_T_map: dict[str, F64] = field(default_factory=dict)
    groups: list[list[str]] = field(default_factory=list)
    optimised: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Tie:
    """A closure as the picture needs it."""

    query: str
    target: str
    query_stamp_ns: int
    target_stamp_ns: int
    target_T_query: F64
    probability: float
    overlap: float

    @classmethod
    def of_row(cls, row: Mapping[str, Any]) -> Tie:
        """Of a row of closures.parquet."""
        return cls(
            row["query_session"],
            row["target_session"],
            row["query_stamp_ns"],
            row["target_stamp_ns"],
            pose_of(row),
            row["probability"],
            row["overlap"],
        )


def pose_of(row: Mapping[str, Any]) -> F64:
    """``target_T_query`` (4, 4) of a row of closures.parquet."""
    return transform(
        np.array([row[f"t_{c}"] for c in "xyz"]), np.array([row[f"q_{c}"] for c in "xyzw"])
    )


def place_sessions(
    work: Workspace, maps: Mapping[str, SessionMap], ties: Sequence[Tie]
) -> Placement:
    """The poses of all keyframes in one picture."""
    placement = Placement()
    for name, session in maps.items():
        poses, frame = _optimised(work, session)
        if poses is not None:
            placement.common_T_base[name] = poses
            placement.common_T_map[name] = fitted(session.map_T_base, poses)
            placement.optimised[name] = frame

    links = _best_links(maps, ties)
    placement.groups = _groups(maps, links, placement.optimised)
    for group in placement.groups:
        _place_group(placement, group, maps, links)
    voxel = max((float(session.json["voxel_size"]) for session in maps.values()), default=0.0)
    _lay_out(placement, LEAST_GAP * voxel)
    for session in maps.values():
        if not session.posed:
            _place_frames(placement, session, maps, ties)
    return placement


def _optimised(work: Workspace, session: SessionMap) -> tuple[F64 | None, str]:
    """Poses (n, 4, 4) of the keyframes by optimized/SESSION.parquet, and their frame.

    None where the file is missing or is of an earlier log.
    """
    path = work.optimized_trajectory(session.folder.name)
    if not path.exists() or not session.posed:
        return None, ""
    table = read_table(path)
    stamps_ns = np.asarray(table["stamp_ns"].to_numpy())
    covers = (
        len(stamps_ns)
        and stamps_ns[0] <= session.stamps_ns[-1]
        and (session.stamps_ns[0] <= stamps_ns[-1])
    )
    if not covers:
        return None, ""
    frame = str(read_metadata(path).get("frame", ""))
    return interpolate(stamps_ns, poses_of(table), session.stamps_ns), frame


def fitted(map_T_base: F64, common_T_base: F64) -> F64:
    """The turn about z and the shift (4, 4) that lay the map's keyframes best on ``common``."""
    here = map_T_base[:, :3, 3]
    there = common_T_base[:, :3, 3]
    centre_here = here.mean(0)
    centre_there = there.mean(0)
    a = (here - centre_here)[:, :2]
    b = (there - centre_there)[:, :2]
    sine = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    cosine = float((a * b).sum())
    if np.hypot(sine, cosine) < 1e-9:  # one place: its heading tells
        turn = common_T_base[0, :3, :3] @ map_T_base[0, :3, :3].T
        sine, cosine = float(turn[1, 0]), float(turn[0, 0])
    common_T_map = yaw_transform(float(np.arctan2(sine, cosine)))
    common_T_map[:3, 3] = centre_there - common_T_map[:3, :3] @ centre_here
    return common_T_map


# -- the tree


@dataclass(frozen=True, slots=True, eq=False)
class _Link:
    """The most probable closure of a pair of sessions, by keyframes."""

    query: str
    target: str
    query_keyframe: int
    target_keyframe: int
    target_T_query: F64
    probability: float


def _best_links(maps: Mapping[str, SessionMap], ties: Sequence[Tie]) -> list[_Link]:
    """A link for each pair of different sessions with poses, the most probable first."""
    best: dict[tuple[str, str], Tie] = {}
    for tie in ties:
        known = all(name in maps and maps[name].posed for name in (tie.query, tie.target))
        if not known or tie.query == tie.target:
            continue
        other = best.get((tie.query, tie.target))
        rank = (tie.probability, tie.overlap)
        if other is None or rank > (other.probability, other.overlap):
            best[tie.query, tie.target] = tie
    links = [
        _Link(
            tie.query,
            tie.target,
            keyframe_near(maps[tie.query], tie.query_stamp_ns),
            keyframe_near(maps[tie.target], tie.target_stamp_ns),
            tie.target_T_query,
            tie.probability,
        )
        for tie in best.values()
    ]
    return sorted(links, key=lambda link: (-link.probability, link.query, link.target))


def keyframe_near(session: SessionMap, stamp_ns: int) -> int:
    """The keyframe with this stamp, or the nearest; stamps of keyframes rise."""
    stamps_ns = session.stamps_ns
    right = min(int(np.searchsorted(stamps_ns, stamp_ns)), len(stamps_ns) - 1)
    left = max(right - 1, 0)
    return right if stamps_ns[right] - stamp_ns <= stamp_ns - stamps_ns[left] else left


def _groups(
    maps: Mapping[str, SessionMap], links: Sequence[_Link], frames: Mapping[str, str]
) -> list[list[str]]:
    """Sessions with poses that links connect, the largest group first, by time within one.

    Those that have ``frames`` belong together if these are the same, and only then.
    """
    parent = {name: name for name in maps if maps[name].posed}

    def root(name: str) -> str:
        while parent[name] != name:
            parent[name] = parent[parent[name]]
            name = parent[name]
        return name

    first_of: dict[str, str] = {}
    for name, frame in frames.items():
        parent[root(name)] = root(first_of.setdefault(frame, name))
    roots = {root(name) for name in frames}
    for link in links:
        one, other = root(link.query), root(link.target)
        if one in roots:
            one, other = other, one
        if one not in roots:  # it is laid on the frame, or joins the other without one
            parent[one] = other
    order = sorted(parent, key=lambda n: (int(maps[n].stamps_ns[0]), n))
    groups: dict[str, list[str]] = {}
    for name in order:
        groups.setdefault(root(name), []).append(name)
    return sorted(groups.values(), key=lambda g: (-len(g), order.index(g[0])))


def _place_group(
    placement: Placement,
    group: Sequence[str],
    maps: Mapping[str, SessionMap],
    links: Sequence[_Link],
) -> None:
    """Place the sessions of a group that are not placed yet, one by one, by the best link."""
    members = set(group)
    if not members & placement.common_T_base.keys():
        _place(placement, maps[group[0]], np.eye(4))
    inside = [link for link in links if {link.query, link.target} <= members]
    while not members <= placement.common_T_base.keys():
        link = next(
            link
            for link in inside
            if (link.query in placement.common_T_base) != (link.target in placement.common_T_base)
        )
        query_map_T_base = maps[link.query].map_T_base[link.query_keyframe]
        target_map_T_base = maps[link.target].map_T_base[link.target_keyframe]
        if link.target in placement.common_T_base:
            base = placement.common_T_base[link.target][link.target_keyframe]
            common_T_map = base @ link.target_T_query @ inverse(query_map_T_base)
            _place(placement, maps[link.query], common_T_map)
        else:
            base = placement.common_T_base[link.query][link.query_keyframe]
            common_T_map = base @ inverse(link.target_T_query) @ inverse(target_map_T_base)
            _place(placement, maps[link.target], common_T_map)


def _place(placement: Placement, session: SessionMap, common_T_map: F64) -> None:
    name = session.folder.name
    placement.common_T_map[name] = common_T_map
    placement.common_T_base[name] = common_T_map @ session.map_T_base


def _place_frames(
    placement: Placement,
    session: SessionMap,
    maps: Mapping[str, SessionMap],
    ties: Sequence[Tie],
) -> None:
    """Keyframes of a log without poses, each where its most probable closure puts it."""
    name = session.folder.name
    poses = np.full((len(session.stamps_ns), 4, 4), np.nan)
    best = np.full(len(poses), -1.0)
    for tie in ties:
        target = placement.common_T_base.get(tie.target)
        if tie.query != name or target is None:
            continue
        keyframe = keyframe_near(session, tie.query_stamp_ns)
        if tie.probability > best[keyframe]:
            best[keyframe] = tie.probability
            end = keyframe_near(maps[tie.target], tie.target_stamp_ns)
            poses[keyframe] = target[end] @ tie.target_T_query
    placement.common_T_base[name] = poses


# -- groups beside each other


def _lay_out(placement: Placement, least_gap: float) -> None:
    """Move the groups to the right of and below each other, ``least_gap`` (m) apart at least."""
    boxes = []
    for group in placement.groups:
        places = np.concatenate([placement.common_T_base[name][:, :2, 3] for name in group])
        boxes.append((places.min(0), places.max(0)))
    if len(boxes) < 2:
        return
    sizes = np.array([high - low for low, high in boxes])
    gap = max(least_gap, GAP * float(sizes.max()))
    most = np.cumsum(sizes[:, 0] + gap)
    layouts = [_rows(sizes, gap, float(width)) for width in most[:MOST_COLUMNS]]
    corners = min(layouts, key=lambda c: _extent(c, sizes))
    for group, corner, (low, high) in zip(placement.groups, corners, boxes, strict=True):
        shift = corner - [low[0], high[1]]
        for name in group:
            placement.common_T_base[name][:, :2, 3] += shift
            placement.common_T_map[name][:2, 3] += shift


def _rows(sizes: F64, gap: float, width: float) -> F64:
    """Upper left corners (n, 2) of boxes (n, 2) in rows not wider than ``width``."""
    corners = np.zeros((len(sizes), 2))
    x = y = row_height = 0.0
    for k, (box_width, box_height) in enumerate(sizes.tolist()):
        if x > 0 and x + box_width > width:
            x = 0.0
            y -= row_height + gap
            row_height = 0.0
        corners[k] = x, y
        x += box_width + gap
        row_height = max(row_height, box_height)
    return corners


def _extent(corners: F64, sizes: F64) -> float:
    """The height of a picture of the usual shape that holds all boxes."""
    width = float((corners[:, 0] + sizes[:, 0]).max())
    height = -float((corners[:, 1] - sizes[:, 1]).min())
    return max(width / ASPECT, height)

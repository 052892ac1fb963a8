"""The picture of a workspace's closures: all sessions in one frame, their drives and maps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from semloc_logs.arrays import F64, U8
from semloc_logs.closures.closure import Closure
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply
from semloc_logs.pictures.colours import (
    CLOSURE,
    PALE,
    SESSIONS,
    SOFT,
    Colour,
    Legend,
    web_colour,
)
from semloc_logs.pictures.map_marks import TEXT, draw_grid, draw_line
from semloc_logs.pictures.map_picture import below_ceiling
from semloc_logs.pictures.placement import Placement, Tie, place_sessions
from semloc_logs.pictures.sheet import Lettering, Panel, Sheet
from semloc_logs.pictures.times import period_text
from semloc_logs.tables.table import read_table
from semloc_logs.workspace import Workspace

WIDTH = 1400  # pixels of the longer edge
EDGES = (0.2, 99.8)  # percentiles of the maps between which the picture lies
BORDER = 3.0  # metres around them
POINT = 0.3  # metres that a voxel is drawn wide
OPACITY = 0.55  # of a map, so that the other ones show through
# voxels are drawn from so many above the height below which this percentage of their tile lies
GROUND_PERCENTILE, ABOVE_GROUND = 20, 3
MOST_MAPS = 30  # sessions whose maps are drawn; of more the drives alone
MOST_DOTS = 2000  # closures with dots of the usual size


def draw_closures(
    work: Workspace, closures: Sequence[Closure], maps: Mapping[str, SessionMap]
) -> None:
    """WORK/closures.png: all sessions, laid together by their closures.

    Without closures nothing is drawn and an older picture is removed.
    """
    if not closures:
        work.picture.unlink(missing_ok=True)
        return
    ties = [_tie(closure) for closure in closures]
    _sheet(place_sessions(work, maps, ties), closures, maps).save(work.picture)


def _tie(closure: Closure) -> Tie:
    a = closure.alignment
    return Tie(
        a.query_session,
        a.target_session,
        a.query_stamp_ns,
        a.target_stamp_ns,
        a.target_T_query,
        closure.decision.probability,
        a.overlap,
    )


def _sheet(
    placement: Placement, closures: Sequence[Closure], maps: Mapping[str, SessionMap]
) -> Sheet:
    """Maps and drives of all sessions, and a line from each query to where it was found."""
    names = sorted(maps, key=lambda name: (int(maps[name].stamps_ns[0]), name))
    colours = _colours(names)
    drives = {name: placement.common_T_base[name][:, :3, 3] for name in names}
    clouds = {
        name: apply(placement.common_T_map[name], _points(maps[name]))
        for name in names
        if len(names) <= MOST_MAPS and name in placement.common_T_map
    }
    everything = np.concatenate([p[:, :2] for p in (*clouds.values(), *drives.values())])
    everything = everything[np.isfinite(everything).all(1)]
    driven = np.concatenate([p[:, :2] for p in drives.values()])
    low = np.minimum(np.percentile(everything, EDGES[0], axis=0), np.nanmin(driven, 0)) - BORDER
    high = np.maximum(np.percentile(everything, EDGES[1], axis=0), np.nanmax(driven, 0)) + BORDER
    scale = WIDTH / float((high - low).max())
    width, height = np.ceil((high - low) * scale).astype(int).tolist()

    def pixels(points: F64) -> F64:
        """Pixels (n, 2) of points (n, 3), y downwards."""
        xy = (points[:, :2] - low) * scale
        return np.stack([xy[:, 0], height - xy[:, 1]], 1)

    image = np.full((height, width, 3), 255, np.uint8)
    point = max(1, round(POINT * scale))
    for name, cloud in clouds.items():
        _blend(image, pixels(cloud), colours.get(name, PALE), point)
    lettering = _lettering(placement, closures, maps, 1 / scale)
    sheet = Sheet([[Panel(image)]], lettering)
    axes = sheet.axes[0][0]
    draw_grid(axes, (float(low[0]), float(low[1])), 1 / scale)
    for name in names:
        if maps[name].posed:
            draw_line(axes, pixels(drives[name]), colours.get(name, SOFT), _width(names))
    _draw_lines(axes, closures, {name: pixels(drive) for name, drive in drives.items()})
    _draw_groups(axes, placement, drives, pixels)
    return sheet


def _colours(names: Sequence[str]) -> dict[str, Colour]:
    """A colour for each session, if there are enough."""
    return dict(zip(names, SESSIONS, strict=False)) if len(names) <= len(SESSIONS) else {}


def _width(names: Sequence[str]) -> float:
    """Of the line of a drive, points."""
    return 2.0 if len(names) <= len(SESSIONS) else 0.8


def _draw_lines(axes: Axes, closures: Sequence[Closure], drives: Mapping[str, F64]) -> None:
    alignments = [closure.alignment for closure in closures]
    starts = np.array([drives[a.query_session][a.query_keyframe] for a in alignments])
    ends = np.array([drives[a.target_session][a.target_keyframe] for a in alignments])
    is_fine = len(closures) > MOST_DOTS
    lines = LineCollection(
        list(np.stack([starts, ends], 1)),
        colors=web_colour(CLOSURE),
        linewidths=0.6 if is_fine else 1.5,
        zorder=3,
    )
    axes.add_collection(lines)
    size = 1.5 if is_fine else 5
    axes.plot(*starts.T, "o", color=web_colour(CLOSURE), markersize=size, markeredgewidth=0)


def _draw_groups(
    axes: Axes, placement: Placement, drives: Mapping[str, F64], pixels: Callable[[F64], F64]
) -> None:
    """The name of each group of sessions, where there are several."""
    if len(placement.groups) < 2:
        return
    for number, group in enumerate(placement.groups, 1):
        places = np.concatenate([drives[name] for name in group])
        corner = pixels(np.array([[places[:, 0].min(), places[:, 1].max(), 0.0]]))[0]
        count = f"{len(group)} session{'s' if len(group) > 1 else ''}"
        axes.annotate(
            f"group {number}: {count}",
            (corner[0], corner[1]),
            (0, 6),
            textcoords="offset points",
            color=web_colour(SOFT),
            fontsize=TEXT,
        )


def _lettering(
    placement: Placement,
    closures: Sequence[Closure],
    maps: Mapping[str, SessionMap],
    metres: float,
) -> Lettering:
    """Title, facts and legend of the picture."""
    count = f"{len(closures)} closure{'s' if len(closures) != 1 else ''}"
    sessions = f"{len(maps)} session{'s' if len(maps) != 1 else ''}"
    stamps_ns = [int(s) for m in maps.values() for s in (m.stamps_ns[0], m.stamps_ns[-1])]
    facts = [period_text(min(stamps_ns), max(stamps_ns))]
    if placement.optimised:
        facts.append("optimised poses")
    elif len(maps) > 1:
        facts.append("laid together by the most probable closures")
    if len(placement.groups) > 1:
        facts.append(f"{len(placement.groups)} groups that no closure connects")
    if len(maps) > MOST_MAPS:
        facts.append("drives only")
    names = sorted(maps, key=lambda name: (int(maps[name].stamps_ns[0]), name))
    legend: Legend = list(_colours(names).items()) or [("drives", SOFT)]
    legend.append(("closure, from the query (dot) to where it was found", CLOSURE))
    return Lettering(f"{sessions}, {count}", facts, legend, metres)


def _blend(image: U8, pixels: F64, colour: Colour, point: int) -> None:
    """Draw points (n, 2) as squares ``point`` pixels wide into ``image``, which shows through."""
    height, width = image.shape[:2]
    column = np.floor(pixels).astype(np.int64)
    column = column[((column >= 0) & (column < (width, height))).all(1)]
    layer = np.zeros((height, width), np.uint8)
    layer[column[:, 1], column[:, 0]] = 1
    drawn = cv2.dilate(layer, np.ones((point, point), np.uint8)) > 0
    mixed = (1 - OPACITY) * image[drawn] + OPACITY * np.array(colour)
    image[drawn] = mixed.astype(np.uint8)


def _points(session: SessionMap) -> F64:
    """Centres (n, 3) of the voxels about a metre above the ground of their tile, map frame;
    indoors without the ceiling.
    """
    parts = []
    for path in sorted(session.folder.voxels.rglob("*.parquet")):
        table = read_table(path, ["ix", "iy", "iz"])
        ijk = np.stack([table[c].to_numpy() for c in ("ix", "iy", "iz")], 1)
        if len(ijk):
            ground = np.percentile(ijk[:, 2], GROUND_PERCENTILE)
            parts.append(ijk[ijk[:, 2] > ground + ABOVE_GROUND])
    if not parts:
        return np.zeros((0, 3))
    size = float(session.json["voxel_size"])
    ijk = np.concatenate(parts)
    if session.posed:
        ijk = ijk[below_ceiling(ijk, session.map_T_base[:, :3, 3] / size)]
    return np.asarray((ijk + 0.5) * size)

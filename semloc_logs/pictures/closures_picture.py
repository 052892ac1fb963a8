"""The picture of a workspace's closures: where two sessions meet, one map laid on the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.closures.closure import Closure
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply, inverse
from semloc_logs.pictures.colours import CLOSURE, QUERY, TARGET, Colour, web_colour
from semloc_logs.pictures.map_marks import draw_line
from semloc_logs.pictures.sheet import Lettering, Panel, Sheet
from semloc_logs.tables.table import read_table
from semloc_logs.workspace import Workspace

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

WIDTH = 1400  # pixels of the longer edge
EDGES = (0.2, 99.8)  # percentiles of the maps between which the picture lies
BORDER = 3.0  # metres around them
POINT = 0.3  # metres that a voxel is drawn wide
OPACITY = 0.55  # of a map, so that the other one shows through
# voxels are drawn from so many above the height below which this percentage of their tile lies
GROUND_PERCENTILE, ABOVE_GROUND = 20, 3


def draw_closures(
    work: Workspace, closures: Sequence[Closure], maps: Mapping[str, SessionMap]
) -> None:
    """WORK/closures.png: the pair of sessions with most closures, laid together by the best one.

    Without closures nothing is drawn and an older picture is removed.
    """
    pairs: dict[tuple[str, str], list[Closure]] = {}
    for closure in closures:
        ends = closure.alignment.query_session, closure.alignment.target_session
        pairs.setdefault(ends, []).append(closure)
    if not pairs:
        work.picture.unlink(missing_ok=True)
        return
    (query_name, target_name), chosen = max(pairs.items(), key=lambda p: (len(p[1]), p[0]))
    _pair_sheet(maps[query_name], maps[target_name], chosen).save(work.picture)


def _pair_sheet(query: SessionMap, target: SessionMap, closures: Sequence[Closure]) -> Sheet:
    """Both maps, the drives of both, and a line from each query to where it was found."""
    best = max(
        closures, key=lambda c: (c.decision.probability, c.alignment.features.structure)
    ).alignment
    target_T_query = (
        target.map_T_base[best.target_keyframe]
        @ best.target_T_query
        @ inverse(query.map_T_base[best.query_keyframe])
    )
    target_points = _points(target)
    query_points = apply(target_T_query, _points(query))
    target_drive = target.map_T_base[:, :3, 3]
    query_drive = apply(target_T_query, query.map_T_base[:, :3, 3])

    everything = np.concatenate(
        [p[:, :2] for p in (target_points, query_points, target_drive, query_drive)]
    )
    low = np.percentile(everything, EDGES[0], axis=0) - BORDER
    high = np.percentile(everything, EDGES[1], axis=0) + BORDER
    scale = WIDTH / float((high - low).max())
    width, height = np.ceil((high - low) * scale).astype(int).tolist()

    def pixels(points: F64) -> F64:
        """Pixels (n, 2) of points (n, 3), y downwards."""
        xy = (points[:, :2] - low) * scale
        return np.stack([xy[:, 0], height - xy[:, 1]], 1)

    image = np.full((height, width, 3), 255, np.uint8)
    point = max(1, round(POINT * scale))
    _blend(image, pixels(target_points), TARGET, point)
    _blend(image, pixels(query_points), QUERY, point)
    sheet = Sheet([[Panel(image)]], _lettering(query, target, len(closures), 1 / scale))
    axes = sheet.axes[0][0]
    draw_line(axes, pixels(target_drive), TARGET)
    draw_line(axes, pixels(query_drive), QUERY)
    starts = pixels(query_drive[[c.alignment.query_keyframe for c in closures]])
    ends = pixels(target_drive[[c.alignment.target_keyframe for c in closures]])
    axes.plot(*np.stack([starts, ends]).transpose(2, 0, 1), color=web_colour(CLOSURE))
    axes.plot(*starts.T, "o", color=web_colour(CLOSURE), markersize=7)
    return sheet


def _lettering(query: SessionMap, target: SessionMap, count: int, metres: float) -> Lettering:
    """Title and legend of a picture of ``count`` closures."""
    query_name = query.folder.name
    target_name = target.folder.name
    return Lettering(
        f"{query_name} in {target_name}: {count} closure{'s' if count != 1 else ''}",
        ["the query's map is laid on the target's by the most probable closure"],
        [
            (f"query: {query_name}", QUERY),
            (f"target: {target_name}", TARGET),
            ("closure, from the query to where it was found", CLOSURE),
        ],
        metres,
    )


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
    """Centres (n, 3) of the voxels about a metre above the ground of their tile, map frame."""
    parts = []
    for path in sorted(session.folder.voxels.rglob("*.parquet")):
        table = read_table(path, ["ix", "iy", "iz"])
        ijk = np.stack([table[c].to_numpy() for c in ("ix", "iy", "iz")], 1)
        if len(ijk):
            ground = np.percentile(ijk[:, 2], GROUND_PERCENTILE)
            parts.append(ijk[ijk[:, 2] > ground + ABOVE_GROUND])
    if not parts:
        return np.zeros((0, 3))
    return np.asarray((np.concatenate(parts) + 0.5) * session.json["voxel_size"])

"""Voxels of the query on voxels of the target, before and after the alignment, small."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count
from typing import Any

from semloc_logs.errors import SemlocError
from semloc_logs.pictures.closure_scene import ClosureScene
from semloc_logs.pictures.closure_view import Choice, closing_settings, closure_view
from semloc_logs.pictures.placement import pose_of
from semloc_logs.pictures.solids import top_view
from semloc_logs.report_page.map_sheets import webp
from semloc_logs.workspace import Workspace

MOST = 40  # closures with pictures: half a second each
EDGE = 320  # pixels
QUALITY = 60  # of WebP


def chosen(rows: Sequence[dict[str, Any]], most: int = MOST) -> list[int]:
    """Numbers of the rows of closures.parquet that get pictures: of each pair of sessions.

    The least probable ones of all pairs first, as these are the ones to look at.
    """
    ranks: dict[tuple[str, str], count[int]] = {}
    order = []
    for number in sorted(range(len(rows)), key=lambda k: (rows[k]["probability"], k)):
        pair = (rows[number]["query_session"], rows[number]["target_session"])
        order.append((next(ranks.setdefault(pair, count())), number))
    return sorted(number for _, number in sorted(order)[:most])


def closure_pictures(work: Workspace, rows: Sequence[dict[str, Any]]) -> dict[str, str]:
    """WebP in base64 by ids, of the chosen rows; maps that cannot be read are left out."""
    settings = closing_settings(work)
    pictures = {}
    for number in chosen(rows):
        choice = Choice(rows[number], pose_of(rows[number]))
        try:
            view = closure_view(work, choice, settings, most_matches=0)
        except SemlocError:
            continue
        scene = ClosureScene(view)
        above = scene.top_view()
        small = top_view(above.at, EDGE, EDGE, above.metres * above.width / EDGE)
        for name, pose in (("before", view.before), ("after", view.map_T_query)):
            pictures[f"{name}-{number}"] = webp(scene.draw(pose, small), quality=QUALITY)
    return pictures

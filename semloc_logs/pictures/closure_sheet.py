"""Closures to look at, as in figures 4 and 5 of the paper's supplement.

A sheet shows the query over the map before and after the alignment, from above and obliquely, and
subvolumes whose words matched.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes

from semloc_logs.arrays import F64
from semloc_logs.pictures.boxes import draw_boxes
from semloc_logs.pictures.closure_scene import ClosureScene
from semloc_logs.pictures.closure_view import ClosureView
from semloc_logs.pictures.colours import (
    ALIGNED,
    IN_FREE_SPACE,
    PALE,
    QUERY,
    TARGET,
    UNOBSERVED,
    Legend,
    web_colour,
)
from semloc_logs.pictures.map_marks import draw_ellipse, draw_grid, draw_line
from semloc_logs.pictures.sheet import Lettering, Panel, Sheet, write_sheets
from semloc_logs.pictures.solids import View
from semloc_logs.pictures.times import time_text
from semloc_logs.subvolumes.cut import SIZE

SUBVOLUME = (208, 240)  # pixels of a subvolume's picture: width, height
HEADING = 0.16  # length of the arrow that shows where the query looks, over the scene's radius


def draw_views(path: Path, views: Sequence[ClosureView]) -> None:
    """A sheet for each view, one below the other; of a PDF each is a page.

    The ending of ``path`` tells the format: PNG, SVG or PDF.
    """
    write_sheets(path, [_sheet(view) for view in views])


def _sheet(view: ClosureView) -> Sheet:
    """The pictures of one view."""
    scene = ClosureScene(view)
    top = scene.top_view()
    side = scene.side_view()
    before = view.before
    aligned = view.map_T_query
    rows = [
        [
            Panel(scene.draw(before, top), "before the alignment"),
            Panel(scene.draw(aligned, top), "aligned"),
            Panel(scene.draw_agreement(top), "aligned: the query's voxels by the target's map"),
        ],
        [
            Panel(scene.draw(before, side), "before the alignment, from the side"),
            Panel(scene.draw(aligned, side), "aligned, from the side"),
        ],
    ]
    if view.matches:
        rows.append(_subvolumes(view))
    sheet = Sheet(rows, Lettering(_title(view), _facts(view), _legend(view, scene), scene.metres))

    over_before, over_aligned = sheet.axes[0][:2]
    corner = (top.at[0] - scene.radius, top.at[1] - scene.radius)
    for axes, map_T_query in ((over_before, before), (over_aligned, aligned)):
        draw_grid(axes, corner, scene.metres)
        _draw_drives(axes, scene, top, map_T_query)
    if view.choice.covariance is not None:
        rotation = view.map_R_target
        covariance = rotation @ view.choice.covariance[:3, :3] @ rotation.T
        draw_ellipse(over_aligned, covariance[:2, :2], QUERY)
    return sheet


def _title(view: ClosureView) -> str:
    row = view.choice.row
    query, target = (
        f"{row[f'{end}_session']} at {time_text(row[f'{end}_stamp_ns'])}"
        for end in ("query", "target")
    )
    return f"{query} in {target}: {'closure' if view.choice.accepted else 'rejected'}"


def _facts(view: ClosureView) -> list[str]:
    """The closure's row of the table, and the reason of a rejection."""
    row = view.choice.row
    T = view.choice.target_T_query
    yaw = round(float(np.degrees(np.arctan2(T[1, 0], T[0, 0]))), 1) + 0.0  # not -0.0
    facts = [
        f"probability {row['probability']:.4f}",
        f"tau {row['overlap']:.2f}",
        f"{np.linalg.norm(T[:3, 3]):.2f} m apart, yaw {yaw:.1f} deg",
    ]
    if view.choice.covariance is not None:
        x, y, z, _, _, turn = np.sqrt(np.diag(view.choice.covariance))
        facts.append(f"1 sigma: x {x:.3f}, y {y:.3f}, z {z:.3f} m, yaw {np.degrees(turn):.2f} deg")
    facts.append(view.choice.reason or f"{row['inliers']} aligned voxels, {row['words']} words")
    if view.matches:
        edge = SIZE * view.query.voxel_size
        facts.append(f"subvolumes of {edge:.3g} m whose words match, turned into the map's axes")
    return facts


def _legend(view: ClosureView, scene: ClosureScene) -> Legend:
    """Classes of the query, the most frequent first, the drives, and the agreement."""
    return [
        *scene.classes(),
        ("target's map", PALE),
        ("drive of the query", QUERY),
        ("drive of the target", TARGET),
        ("on an occupied voxel of the map", ALIGNED),
        ("in free space of the map", IN_FREE_SPACE),
        ("where the map observed nothing", UNOBSERVED),
    ]


def _draw_drives(axes: Axes, scene: ClosureScene, view: View, map_T_query: F64) -> None:
    """The drives of both, and where the query was and looked."""
    target, query = scene.drives(map_T_query)
    draw_line(axes, view.pixels(target)[:, :2], TARGET)
    draw_line(axes, view.pixels(query)[:, :2], QUERY)
    position, ahead = view.pixels(scene.heading(map_T_query, HEADING * scene.radius))[:, :2]
    axes.annotate(
        "",
        ahead,
        position,
        arrowprops={
            "arrowstyle": "-|>",
            "color": web_colour(QUERY),
            "linewidth": 2.5,
            "mutation_scale": 18,
        },
    )
    axes.plot(*position, "o", color=web_colour(QUERY), markeredgecolor="white", markersize=8)


def _subvolumes(view: ClosureView) -> list[Panel]:
    """Subvolumes whose words matched: of the query as observed and as completed, of the target."""
    panels = []
    for match in view.matches:
        states = {"query": match.query, "completed": match.completion, "target": match.target}
        heading = f"{match.distance} of 64 bits differ"
        for name, state in states.items():
            small = cv2.resize(draw_boxes(state), SUBVOLUME, interpolation=cv2.INTER_AREA)
            panels.append(Panel(np.asarray(small, np.uint8), f"{heading}\n{name}"))
            heading = " "
    return panels

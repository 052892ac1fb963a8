"""Closures to look at, as in figures 4 and 5 of the paper's supplement: the query laid over the map
before and after the alignment, from above and aside, and subvolumes whose words matched.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.mask_grid import FREE_BIT, look_up
from semloc_logs.labels.space import cityscapes
from semloc_logs.numerics.transforms import apply
from semloc_logs.pictures.closure_view import ClosureView
from semloc_logs.pictures.completion_picture import colours, render
from semloc_logs.pictures.lettering import FONT, INK, SOFT, Sheet
from semloc_logs.pictures.map_picture import GEOMETRY_NAMES
from semloc_logs.pictures.solids import Solid, View, draw_solids, top_view
from semloc_logs.subvolumes.cut import SIZE
from semloc_logs.tables.atomic_files import replacing_file

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]
PANEL, GAP, CAPTION = 640, 12, 44  # pixels
PALE = 0.78  # how far the database's colours are from their own to light grey
# RGB
GREY = (205, 205, 210)
ALIGNED = (34, 139, 84)
AGAINST = (214, 39, 40)
NEW = (240, 170, 60)
QUERY_ROAD = (214, 39, 40)
TARGET_ROAD = (40, 60, 160)
HEADROOM = 2  # voxels above the sensor that are drawn under a roof
SIGMAS = 2.0


def draw_views(path: Path, views: Sequence[ClosureView]) -> None:
    """PNG with a sheet for each view, one below the other."""
    sheets = [_sheet(view) for view in views]
    width = max(s.shape[1] for s in sheets)
    padded = [
        np.pad(s, ((0, 40), (0, width - s.shape[1]), (0, 0)), constant_values=255) for s in sheets
    ]
    with replacing_file(path) as temporary:
        temporary.write_bytes(
            cv2.imencode(".png", np.ascontiguousarray(np.vstack(padded)[:, :, ::-1]))[1].tobytes()
        )


def _sheet(view: ClosureView) -> U8:
    """The panels of one view under a title, over a scale bar and a legend."""
    scene = _Scene(view)
    body = np.hstack(
        _spaced(
            [
                scene.top(view.before, "before alignment"),
                scene.top(view.map_T_query, "aligned"),
                scene.judged(),
            ],
            1,
        )
    )
    aside = np.hstack(
        _spaced(
            [
                scene.aside(view.before, "before, from the side"),
                scene.aside(view.map_T_query, "aligned, from the side"),
            ],
            1,
        )
    )
    rows = [body, _fitted(aside, body.shape[1])]
    if view.matches:
        rows.append(_subvolumes(view, body.shape[1]))
    row = view.choice.row
    verdict = "closure" if view.choice.accepted else "rejected"
    query, target = (
        f"{row[f'{end}_session']} at {row[f'{end}_stamp_ns'] / 1e9:.1f} s"
        for end in ("query", "target")
    )
    return Sheet(np.vstack(_spaced(rows, 0))).finish(
        f"{query} in {target}: {verdict}", _facts(view), scene.legend(), scene.metres
    )


def _facts(view: ClosureView) -> list[str]:
    row = view.choice.row
    T = view.choice.target_T_query
    yaw = float(np.degrees(np.arctan2(T[1, 0], T[0, 0])))
    facts = [
        f"probability {row['probability']:.4f}",
        f"tau {row['overlap']:.2f}",
        f"{np.linalg.norm(T[:3, 3]):.2f} m apart, yaw {yaw:.1f} deg",
    ]
    if view.choice.covariance is not None:
        s = np.sqrt(np.diag(view.choice.covariance))
        facts.append(
            f"1 sigma: x {s[0]:.3f}, y {s[1]:.3f}, z {s[2]:.3f} m, yaw {np.degrees(s[5]):.2f} deg"
        )
    return (
        [*facts, view.choice.reason]
        if view.choice.reason
        else [*facts, f"{row['inliers']} aligned voxels, {row['words']} words"]
    )


class _Scene:
    """The voxels of a view, cut around the aligned query, and the pictures of them; those from
    above have the scale of the bar.
    """

    def __init__(self, view: ClosureView) -> None:
        self._view = view
        v = self._v = view.query.voxel_size
        self._query, self._query_label = view.query.blocks.occupied()
        at = view.map_T_query[:3, 3]
        self._at = (float(at[0]), float(at[1]), float(at[2]))
        away = np.abs((self._query[:, :2] + 0.5) * v).max(1) if len(self._query) else np.zeros(1)
        self._reach = max(float(np.percentile(away, 99.5)) + 2 * v, 20 * v)
        self.metres = 2 * self._reach / PANEL
        ijk, label = view.target.blocks.occupied()
        near = (np.abs((ijk[:, :2] + 0.5) * v - at[:2]) < self._reach).all(1)
        self._target = ijk[near]
        self._target_label = label[near]
        self._cut_roof()

    def _cut_roof(self) -> None:
        """Where most of the query's road lies under something, what is higher than the sensor is
        left out of all pictures.
        """
        v = self._v
        view = self._view
        road = apply(view.map_T_query, view.roads[1])
        above = (self._target[:, 2] + 0.5) * v > road[:, 2].mean() + (HEADROOM + 1) * v
        columns = {
            tuple(c)
            for c in np.floor((self._target[above][:, :2] + 0.5) * v / (4 * v)).astype(int).tolist()
        }
        covered = np.mean(
            [tuple(c) in columns for c in np.floor(road[:, :2] / (4 * v)).astype(int).tolist()]
        )
        self._roofed = covered > 0.5
        if self._roofed:
            self._target = self._target[~above]
            self._target_label = self._target_label[~above]
            low = (self._query[:, 2] + 0.5) * v <= view.roads[1][:, 2].mean() + (HEADROOM + 1) * v
            self._query = self._query[low]
            self._query_label = self._query_label[low]

    def _solids(self, map_T_query: F64, rgb: U8) -> list[Solid]:
        table = colours()[self._target_label]
        pale = (PALE * np.array(GREY) + (1 - PALE) * table).astype(np.uint8)
        return [
            Solid(self._target, pale, self._v, np.eye(4)),
            Solid(self._query, rgb, self._v, map_T_query),
        ]

    def top(self, map_T_query: F64, caption: str) -> U8:
        """The query in its class colours over the pale database, from above, with the roads of
        both.
        """
        view = top_view(self._at, PANEL, PANEL, self.metres)
        image = draw_solids(self._solids(map_T_query, colours()[self._query_label]), view)
        self._roads(image, view, map_T_query)
        if map_T_query is self._view.map_T_query and self._view.choice.covariance is not None:
            self._ellipse(image, self._view.choice.covariance)
        return _captioned(image, caption)

    def aside(self, map_T_query: F64, caption: str) -> U8:
        """The same obliquely, from behind."""
        v = self._view.map_T_query @ self._view.query_T_base
        azimuth = float(np.arctan2(v[1, 0], v[0, 0])) + np.pi + 0.45
        view = View(
            azimuth, np.radians(28), self._at, 3 * PANEL // 2, PANEL * 5 // 8, self.metres * 0.75
        )
        return _captioned(
            draw_solids(self._solids(map_T_query, colours()[self._query_label]), view), caption
        )

    def judged(self) -> U8:
        """The aligned query by what the map says of its voxels: occupied, free, or nothing."""
        view = top_view(self._at, PANEL, PANEL, self.metres)
        found = look_up(
            self._view.target.mask_grid,
            apply(self._view.map_T_query, (self._query + 0.5) * self._v),
        )
        rgb = np.where(
            (found & ~np.uint8(FREE_BIT))[:, None] != 0,
            ALIGNED,
            np.where(found[:, None] != 0, AGAINST, NEW),
        ).astype(np.uint8)
        image = draw_solids(self._solids(self._view.map_T_query, rgb), view)
        return _captioned(
            image, "green: on the map's, red: in its free space, orange: where it saw nothing"
        )

    def _roads(self, image: U8, view: View, map_T_query: F64) -> None:
        target, query = self._view.roads
        for road, colour in ((target, TARGET_ROAD), (apply(map_T_query, query), QUERY_ROAD)):
            line = np.round(view.pixels(road)[:, :2] * 16).astype(np.int32)
            near = (np.abs(line) < 1 << 20).all(1)
            cv2.polylines(
                image, [line[near].reshape(-1, 1, 2)], False, (255, 255, 255), 5, cv2.LINE_AA, 4
            )
            cv2.polylines(image, [line[near].reshape(-1, 1, 2)], False, colour, 2, cv2.LINE_AA, 4)
        base = map_T_query @ self._view.query_T_base
        ends = view.pixels(np.stack([base[:3, 3], base[:3, 3] + base[:3, 0] * self._reach * 0.16]))[
            :, :2
        ]
        start, tip = (tuple(p.tolist()) for p in np.round(ends).astype(int))
        for colour, width in (((255, 255, 255), 7), (QUERY_ROAD, 3)):
            cv2.arrowedLine(image, start, tip, colour, width, cv2.LINE_AA, 0, 0.35)
        cv2.circle(image, start, 6, (255, 255, 255), -1, cv2.LINE_AA)
        cv2.circle(image, start, 4, QUERY_ROAD, -1, cv2.LINE_AA)

    def _ellipse(self, image: U8, covariance: F64) -> None:
        """The error of the position in x and y, enlarged, in a corner."""
        rotation = self._view.map_R_target
        cov = (rotation @ covariance[:3, :3] @ rotation.T)[:2, :2]
        values, vectors = np.linalg.eigh(cov)
        half = SIGMAS * np.sqrt(np.maximum(values, 1e-12))
        box, pad = 132, 10
        x = PANEL - box - pad
        y = PANEL - box - pad
        image[y : y + box, x : x + box] = 255
        cv2.rectangle(image, (x, y), (x + box, y + box), SOFT, 1, cv2.LINE_AA)
        scale = 38 / float(half.max())
        angle = float(np.degrees(np.arctan2(-vectors[1, 1], vectors[0, 1])))
        centre = (x + box // 2, y + 50)
        axes = (max(1, round(half[1] * scale)), max(1, round(half[0] * scale)))
        cv2.ellipse(image, centre, axes, angle, 0, 360, (250, 205, 205), -1, cv2.LINE_AA)
        cv2.ellipse(image, centre, axes, angle, 0, 360, QUERY_ROAD, 2, cv2.LINE_AA)
        length = max(
            m * 10.0**e for e in range(-4, 2) for m in (1, 2, 5) if m * 10.0**e * scale <= 90
        )
        wide = round(length * scale)
        cv2.line(image, (centre[0] - wide // 2, y + 102), (centre[0] + wide // 2, y + 102), INK, 3)
        text = f"{length * 100:g} cm, 2 sigma"
        size = cv2.getTextSize(text, FONT, 0.42, 1)[0][0]
        cv2.putText(image, text, (centre[0] - size // 2, y + 122), FONT, 0.42, INK, 1, cv2.LINE_AA)

    def legend(self) -> list[tuple[str, tuple[int, ...]]]:
        """Classes of the query, the most frequent first, and the lines."""
        counts = np.bincount(self._query_label, minlength=256)
        names = list(cityscapes().names)
        if self._view.label_source == "geometry":
            names = [GEOMETRY_NAMES.get(i, n) for i, n in enumerate(names)]
        classes = sorted(np.flatnonzero(counts).tolist(), key=lambda c: (-counts[c], c))
        shown = [
            (names[c] if c < len(names) else "class unknown", tuple(colours()[c].tolist()))
            for c in classes
        ]
        return [
            *shown,
            ("database (pale)", GREY),
            ("road of the query", QUERY_ROAD),
            ("road of the database", TARGET_ROAD),
        ]


def _subvolumes(view: ClosureView, width: int) -> U8:
    """Pairs of subvolumes whose words matched: of the query as seen and as completed, and of the
    database.
    """
    groups = []
    for match in view.matches:
        parts = {"query": match.query, "completed": match.completion, "database": match.target}
        small = {
            name: cv2.resize(render(state), (208, 240), interpolation=cv2.INTER_AREA)
            for name, state in parts.items()
        }
        group = np.hstack(
            _spaced(
                [_captioned(np.asarray(image, np.uint8), name) for name, image in small.items()],
                1,
                4,
            )
        )
        groups.append(_captioned(group, f"word match, {match.distance} of 64 bits differ"))
    edge = SIZE * view.query.voxel_size
    row = np.hstack(_spaced(groups, 1))
    return _captioned(
        _fitted(row, width), f"corresponding subvolumes of {edge:.3g} m, turned into the map's axes"
    )


def _captioned(image: U8, text: str) -> U8:
    """The picture under a line of text."""
    out = np.full((image.shape[0] + CAPTION * 2 // 3, image.shape[1], 3), 255, np.uint8)
    out[-image.shape[0] :] = image
    cv2.putText(out, text, (4, CAPTION * 2 // 3 - 9), FONT, 0.55, SOFT, 1, cv2.LINE_AA)
    return out


def _spaced(images: Sequence[U8], axis: int, gap: int = GAP) -> list[U8]:
    """Pictures with white between them, to be put side by side (axis 1) or below each other (axis
    0).
    """
    out: list[U8] = []
    for image in images:
        shape = list(image.shape)
        shape[axis] = gap
        out += [image, np.full(shape, 255, np.uint8)]
    return out[:-1]


def _fitted(image: U8, width: int) -> U8:
    """With white to the right, or cut, to ``width``."""
    return np.asarray(
        np.pad(
            image[:, :width],
            ((0, 0), (0, max(0, width - image.shape[1])), (0, 0)),
            constant_values=255,
        )
    )

"""Quality of classes from geometry, against the labels of a log or of simulated sweeps.

The truth is the log's own label in the coarse set: road, sidewalk and terrain (parking and lane
marking too) are ground; building, wall and fence construction; vegetation and, as in Cityscapes,
tree trunks vegetation; poles, signs and lights poles. Vehicles and people have no class in
geometry: calling them anything but unlabelled counts against that class. Points without a label in
the log do not count.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import I64, U8
from semloc_logs.errors import LogError
from semloc_logs.labels.from_geometry import classify
from semloc_logs.labels.space import UNLABELLED, cityscapes
from semloc_logs.mapping.session_fusion import FuseTask, fuse_session
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply
from semloc_logs.settings import STREET_VOXEL, Resolved
from semloc_logs.voxels.grid import BlockMap, Fuser
from semloc_logs.voxels.keys import pack
from semloc_logs.voxels.store import read_keyframe
from semloc_logs.workspace import Workspace

CLASSES = ("ground", "construction", "vegetation", "pole")
OTHERS = "vehicle or other"
NONE = "unlabelled"

Figures = dict[str, dict[str, float | str]]


def _index() -> U8:
    """Of each train id its place in CLASSES, 4 for other classes, 5 for unlabelled."""
    coarse = cityscapes().coarse_names
    table = np.full(256, 5, np.uint8)
    for i, c in enumerate(cityscapes().coarse):
        if c != UNLABELLED:
            table[i] = CLASSES.index(coarse[c]) if coarse[c] in CLASSES else 4
    return table


def confusion(truth: U8, predicted: U8) -> I64:
    """Counts (5, 5) of train ids (n,): rows ground, construction, vegetation, pole, other; columns
    these four and unlabelled.
    """
    table = _index()
    row = table[truth]
    column = np.minimum(table[predicted], 4)
    known = row < 5
    return np.bincount(row[known].astype(np.int64) * 5 + column[known], minlength=25).reshape(5, 5)


def intersection_over_union(counts: I64) -> NDArray[np.float64]:
    """IoU (4,) of the classes; NaN where the truth has none of a class."""
    right = np.diag(counts)[:4].astype(float)
    union = counts.sum(1)[:4] + counts.sum(0)[:4] - right
    return np.where(counts.sum(1)[:4] > 0, right / np.maximum(union, 1), np.nan)


def _compare_maps(truth: BlockMap, fused: BlockMap) -> I64:
    """Confusion of the voxels that are occupied in both maps, which classes decide a little: what
    is ground is carved less.
    """
    (ours, our_class, *_), (theirs, their_class, *_) = fused.occupied(), truth.occupied()
    _, own_rows, true_at = np.intersect1d(
        pack(ours), pack(theirs), assume_unique=True, return_indices=True
    )
    return confusion(their_class[true_at], our_class[own_rows])


def measure_labels(logs: Sequence[Path], settings: Resolved) -> Figures:
    """Classes from geometry against the labels of ``logs``, on keyframe points within the fused
    range and on fused voxels.

    LogError when a log has no labels.
    """
    fused = settings.model_copy(
        update={"labels": settings.labels.model_copy(update={"source": "log"})}
    )
    points = np.zeros((5, 5), np.int64)
    voxels = np.zeros((5, 5), np.int64)
    taken: list[float] = []
    sizes: list[int] = []
    with tempfile.TemporaryDirectory(prefix="semloc-labels-") as folder:
        for i, log in enumerate(logs):
            session = SessionMap(Workspace(Path(folder)).session(str(i)))
            fuse_session(FuseTask((log,), session.folder, fused))
            if session.posed:
                voxels += _measure_session(session, settings, points, taken, sizes)
            else:
                raise LogError(
                    f"{log} has no poses, so its labels cannot be fused: "
                    "give a log with a pose stream."
                )
    figures: Figures = {}
    for what, counts in (("points", points), ("voxels", voxels)):
        figures |= _rows(what, counts)
    figures["time"] = {
        "ours": float(np.median(taken)),
        "unit": f"ms of one core a keyframe of {np.mean(sizes):.0f} points, median",
    }
    return figures


def _measure_session(
    session: SessionMap, settings: Resolved, points: I64, taken: list[float], sizes: list[int]
) -> I64:
    """Adds to the confusion of ``points``, to times (ms) and numbers of points; returns the
    confusion of the voxels.
    """
    scale = settings.fusion.voxel_size / STREET_VOXEL
    far = settings.fusion.max_range
    maps = Fuser(settings.fusion), Fuser(settings.fusion)
    for k, pose in enumerate(session.map_T_base):
        frame = read_keyframe(session.folder.keyframes, k)
        level = apply(pose, frame.points)
        origin = apply(pose, session.origins[k][None])[0]
        if not taken:
            classify(level, origin, scale)  # compiles
        start = time.process_time()
        predicted = classify(level, origin, scale)
        taken.append(1e3 * (time.process_time() - start))
        sizes.append(len(level))
        is_inside = np.linalg.norm(level - origin, axis=1) <= far
        points += confusion(frame.label[is_inside], predicted[is_inside])
        for fuser, label in zip(maps, (frame.label, predicted), strict=True):
            fuser.add(level, label, origin)
    return _compare_maps(maps[0].finish(), maps[1].finish())


def _rows(what: str, counts: I64) -> Figures:
    """A row for each true class: its IoU and what share of it was called what; and the mean IoU."""
    iou = intersection_over_union(counts)
    out: Figures = {
        f"{what}: mean": {
            "ours": float(np.nanmean(iou)) if np.isfinite(iou).any() else float("nan"),
            "unit": "IoU",
        }
    }
    for i, name in enumerate((*CLASSES, OTHERS)):
        total = int(counts[i].sum())
        if total:
            shares: dict[str, float | str] = {
                c: float(counts[i, k] / total) for k, c in enumerate((*CLASSES, NONE))
            }
            row: dict[str, float | str] = {"ours": float(iou[i])} if i < 4 else {}
            out[f"{what}: {name}"] = (
                row | {"unit": f"{'IoU; ' if i < 4 else ''}share called each, of {total}"} | shares
            )
    return out

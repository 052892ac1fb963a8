"""How like real sweeps are simulated ones? Shares, distances and heights of both, side by side.

A distance between two histograms is their total variation: half the sum of the absolute
differences, the share that would have to move. That of a real sweep from the other real ones says
how much places differ anyway. Everything is measured in the sensor's axes, level to a degree or
two, one sweep at a time, and then averaged over sweeps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semloc_logs.arrays import F64, U8
from semloc_logs.benchmarks.scans import Scan, log_sweeps, town_sweeps
from semloc_logs.errors import LogError
from semloc_logs.labels.space import cityscapes
from semloc_logs.settings import Resolved, ResolvedFusion
from semloc_logs.subvolumes.cut import SIZE
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE, Fuser

Figures = dict[str, dict[str, float | str]]

ROAD, SIDEWALK, BUILDING, VEGETATION, TERRAIN, UNLABELLED = 0, 1, 2, 8, 9, 255
RANGES = np.concatenate([np.arange(0.0, 20.0, 1.0), np.arange(20.0, 81.0, 5.0)])  # m
# m
HEIGHTS = np.concatenate(
    [
        [-4.0, -1.0, -0.5, -0.25],
        np.arange(-0.15, 0.5, 0.1),
        np.arange(0.5, 4.0, 0.5),
        np.arange(4.0, 17.0, 2.0),
    ]
)
OPEN = np.concatenate([np.arange(0.0, 30.0, 2.0), np.arange(30.0, 81.0, 10.0)])  # m
# occupied voxels of a subvolume
FILLED = np.concatenate([np.arange(0.0, 4000.0, 200.0), [32_768.0]])
_FAR = 79.0  # m: there is nothing in this direction
_LABELLED = 50.0  # m: people label no further
_NEAR = 30.0  # m: voxels further away than that are too few to compare
_SECTORS = 180


@dataclass(frozen=True, slots=True, eq=False)
class Portrait:
    """What one sweep looks like: ``histograms`` by name, each of sum 1, and ``numbers`` by name,
    NaN where there is nothing to measure.
    """

    histograms: dict[str, F64]
    numbers: dict[str, float]


def total_variation(a: F64, b: F64) -> float:
    """Half the sum of absolute differences of two histograms of sum 1."""
    return float(0.5 * np.abs(a - b).sum())


def portrait(scan: Scan, fusion: ResolvedFusion) -> Portrait:
    """Measure a labelled sweep. LogError when none of its points near the sensor is on a road or
    pavement.
    """
    points = scan.points.astype(np.float64)
    label = scan.label
    flat = np.hypot(points[:, 0], points[:, 1])
    on_ground = (label == ROAD) | (label == SIDEWALK)
    if not (on_ground & (flat < 12)).any():
        raise LogError(
            "a sweep has no point of a road or pavement within 12 m, "
            "so its heights cannot be compared: give labelled sweeps"
        )
    height = points[:, 2] - float(np.median(points[on_ground & (flat < 12), 2]))
    distance = np.linalg.norm(points, axis=1)
    histograms = {
        "ranges": _histogram(distance, RANGES),
        "heights over ground": _histogram(height, HEIGHTS),
    }
    histograms["classes of points within 50 m"] = _classes(label[distance < _LABELLED])
    numbers = {"points a sweep": float(len(points))}
    for q in (10, 50, 90, 99):
        numbers[f"range, {q} %: m"] = float(np.percentile(distance, q))
    numbers |= _openness(flat, height, points, label, histograms)
    numbers |= _street(points, flat, height, label)
    _voxels(scan, height, fusion, histograms, numbers)
    return Portrait(histograms, numbers)


def _histogram(values: F64, edges: F64) -> F64:
    counts = np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0].astype(float)
    return np.asarray(counts / max(1.0, counts.sum()))


def _classes(label: U8) -> F64:
    """Shares of the train ids 0 to 19 and, last, of no class."""
    counts = np.bincount(np.minimum(label, 20), minlength=21).astype(float)
    return np.asarray(counts / max(1.0, counts.sum()))


def _openness(
    flat: F64, height: F64, points: F64, label: U8, histograms: dict[str, F64]
) -> dict[str, float]:
    """How far one can go in each of 180 directions until something stands 1 to 2.5 m over the
    ground, and of which class it is.
    """
    stands = np.flatnonzero((height > 1.0) & (height < 2.5) & (flat > 2.0))
    sector = (np.arctan2(points[stands, 1], points[stands, 0]) / (2 * np.pi) * _SECTORS).astype(
        np.int64
    ) % _SECTORS
    order = np.lexsort((flat[stands], sector))
    first = order[np.unique(sector[order], return_index=True)[1]]
    nearest = np.full(_SECTORS, _FAR)
    nearest[sector[first]] = flat[stands[first]]
    histograms["distance to the nearest structure of a direction"] = _histogram(nearest, OPEN)
    histograms["class of the nearest structure of a direction"] = _classes(label[stands[first]])
    return {
        f"first thing in a direction, {q} %: m": float(np.percentile(nearest, q))
        for q in (25, 50, 75)
    }


def _street(points: F64, flat: F64, height: F64, label: U8) -> dict[str, float]:
    """Widths of the street beside the sensor (x ahead); heights of houses, trees and ground."""
    beside = np.abs(points[:, 0]) < 12
    out = {}
    road = points[beside & (label == ROAD), 1]
    out["road beside the sensor, width: m"] = (
        float(np.ptp(np.percentile(road, (2, 98)))) if len(road) > 50 else np.nan
    )
    upright = beside & (height > 1.0) & (height < 2.5)
    for name, ids in (
        ("house", (BUILDING,)),
        ("vegetation", (VEGETATION,)),
        ("wall, fence or hedge", (3, 4)),
    ):
        y = points[upright & np.isin(label, ids), 1]
        sides = [np.percentile(side, 10) for side in (y[y > 0], -y[y < 0]) if len(side) > 30]
        out[f"{name} beside the sensor, distance: m"] = float(np.mean(sides)) if sides else np.nan
    for name, ids in (("houses", (BUILDING,)), ("vegetation", (VEGETATION,))):
        z = height[np.isin(label, ids) & (flat < 40)]
        for q in (50, 95):
            out[f"height of {name} within 40 m, {q} %: m"] = (
                float(np.percentile(z, q)) if len(z) > 50 else np.nan
            )
    ground = np.isin(label, (ROAD, SIDEWALK, TERRAIN))
    out["height of ground at 20-40 m, spread: m"] = _spread(
        height[ground & (flat > 20) & (flat < 40)]
    )
    out["height of pavement and terrain within 15 m, spread: m"] = _spread(
        height[(ground & (label != ROAD)) & (flat < 15)]
    )
    out["points more than 6 m over ground: share"] = float((height > 6).mean())
    return out


def _spread(z: F64) -> float:
    return float(np.ptp(np.percentile(z, (5, 95)))) if len(z) > 50 else np.nan


def _voxels(
    scan: Scan,
    height: F64,
    fusion: ResolvedFusion,
    histograms: dict[str, F64],
    numbers: dict[str, float],
) -> None:
    """The map of the sweep alone: classes of its voxels, content of subvolumes near the sensor."""
    fuser = Fuser(fusion)
    fuser.add(scan.points, scan.label, np.zeros(3))
    blocks = fuser.finish()
    v = fusion.voxel_size
    ijk, state = blocks.occupied()
    is_inside = np.linalg.norm((ijk[:, :2] + 0.5) * v, axis=1) < _NEAR
    numbers["occupied voxels within 30 m"] = float(is_inside.sum())
    histograms["classes of voxels within 30 m"] = _classes(state[is_inside])
    names = [*cityscapes().names, "unlabelled"]
    counts = np.bincount(np.minimum(state[is_inside], 19), minlength=20)
    for k in (*range(10), 13, 19):
        numbers[f"voxels within 30 m: {names[k]}"] = float(counts[k])
    low = np.array([-128, -128, 0], np.int64)
    floor = float(np.median(scan.points[np.abs(height) < 0.3, 2])) - 1.0
    low[2] = int(np.floor(floor / v))
    dense = blocks.dense(low, (256, 256, SIZE))
    filled = []
    free = []
    unseen = []
    for i in range(-64, 65, 16):
        for j in range(-64, 65, 16):
            cube = dense[128 + i - 16 : 128 + i + 16, 128 + j - 16 : 128 + j + 16]
            occupied = int(((cube != FREE_STATE) & (cube != UNOBSERVED_STATE)).sum())
            if occupied >= 40:
                filled.append(occupied)
                free.append(float((cube == FREE_STATE).mean()))
                unseen.append(float((cube == UNOBSERVED_STATE).mean()))
    if filled:
        histograms["occupied voxels of a subvolume"] = _histogram(np.array(filled, float), FILLED)
        histograms["free share of a subvolume"] = _histogram(np.array(free), np.linspace(0, 1, 21))
        numbers["subvolumes within 20 m: occupied voxels"] = float(np.median(filled))
        numbers["subvolumes within 20 m: share free"] = float(np.median(free))
        numbers["subvolumes within 20 m: share unobserved"] = float(np.median(unseen))


def measure_realism(
    logs: Sequence[Path],
    settings: Resolved,
    seeds: Sequence[int] = tuple(range(8)),
    sweeps: int = 3,
) -> Figures:
    """Simulated sweeps of a sensor of 64 beams beside the labelled ones of ``logs``: (``ours``
    simulated, ``real``, ``difference``).

    LogError when a log has no labelled sweep.
    """
    fusion = settings.resolved().fusion
    real = []
    for log in logs:
        for scan in log_sweeps(log, 4, repeat=False):
            if (scan.label == UNLABELLED).all():
                raise LogError(
                    f"{log} has no labels, so its classes cannot be compared: "
                    "give a log with a label field."
                )
            real.append(portrait(scan, fusion))
    simulated = [portrait(scan, fusion) for seed in seeds for scan in town_sweeps(seed, sweeps)]
    return compare(simulated, real)


def compare(simulated: Sequence[Portrait], real: Sequence[Portrait]) -> Figures:
    """Rows of both: distances of histograms, shares of classes, and medians of numbers with the
    range of the middle half.
    """
    out: Figures = {}
    for name in real[0].histograms:
        ours = _pooled(simulated, name)
        theirs = _pooled(real, name)
        others = [
            total_variation(real[k].histograms[name], _pooled([*real[:k], *real[k + 1 :]], name))
            for k in range(len(real) if len(real) > 1 else 0)
        ]
        row: dict[str, float | str] = {
            "ours": total_variation(ours, theirs),
            "unit": "total variation from real; real: from one another",
        }
        out[f"distance: {name}"] = row | ({"real": float(np.mean(others))} if others else {})
    names = [*cityscapes().names, "unlabelled"]
    for name in (
        "classes of points within 50 m",
        "classes of voxels within 30 m",
        "class of the nearest structure of a direction",
    ):
        ours = _pooled(simulated, name)
        theirs = _pooled(real, name)
        for k in np.flatnonzero(np.maximum(ours, theirs) > 0.003):
            out[f"{name}: {names[min(int(k), 19)]}"] = _row(
                float(ours[k]), float(theirs[k]), "share"
            )
    for name in real[0].numbers:
        a, b = (np.array([p.numbers.get(name, np.nan) for p in side]) for side in (simulated, real))
        if np.isfinite(a).any() and np.isfinite(b).any():
            spread = "{:.3g} to {:.3g}".format(*np.nanpercentile(a, (25, 75)))
            out[name] = _row(
                float(np.nanmedian(a)),
                float(np.nanmedian(b)),
                f"median; middle half of ours {spread}",
            )
    return out


def _pooled(side: Sequence[Portrait], name: str) -> F64:
    return np.asarray(np.mean([p.histograms[name] for p in side if name in p.histograms], axis=0))


def _row(ours: float, real: float, unit: str) -> dict[str, float | str]:
    return {"ours": ours, "real": real, "difference": ours - real, "unit": unit}

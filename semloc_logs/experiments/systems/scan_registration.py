"""Peers of today on single scans: places by Scan Context or by MapClosures (Gupta et al. 2024),
poses by generalised ICP (small_gicp) or by KISS-Matcher (Lim et al. 2025).

Similar places give a start, and the registration of the best of them the pose. small_gicp,
kiss-matcher and map-closures are in the extra ``baselines``. Without small_gicp our own fit on
points takes its part.
"""

from __future__ import annotations

import importlib
import logging
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from semloc_logs.alignment.icp import Step, align
from semloc_logs.alignment.surface import surface_of
from semloc_logs.arrays import F32, F64
from semloc_logs.benchmarks.peers.scan_context import nearest_contexts, scan_context
from semloc_logs.experiments.system import MOST_POSES, Query, RankedPose, View
from semloc_logs.experiments.systems.catalogue import SystemOptions
from semloc_logs.experiments.systems.level_maps import level_points
from semloc_logs.mapping.selection import thin
from semloc_logs.numerics.local_shape import shape
from semloc_logs.numerics.transforms import apply, inverse, yaw_transform

# target points, query points, start of target_T_query -> target_T_query and the score
Register = Callable[[F64, F64, F64], tuple[F64, float]]
KEPT_CELL = 0.2  # m: points of a scan are thinned to it
GICP_CELL = 0.5  # m
REACHES = (3.0, 1.0)  # m, of correspondences, one after the other
KISS_VOXEL = 0.5  # m
LEAST_KISS_INLIERS = 5
GICP_CANDIDATES, KISS_CANDIDATES = 20, 10
NORMAL_CELL = 1.0  # m: of the points whose normals MapClosures gets
NORMAL_NEIGHBOURS = 20
APART = 10  # between the numbers of scans: MapClosures compares none closer than 3

logger = logging.getLogger(__name__)


class Places(Protocol):
    """Scans (n, 3) in level frames, metres, by what they look like."""

    def add(self, points: F32) -> None:
        """Learn the next scan."""
        ...

    def nearest(self, points: F32, count: int) -> list[tuple[int, F64]]:
        """The ``count`` most similar scans, best first, each with a ``scan_T_points`` (4, 4)."""
        ...


class Contexts:
    """Scan Context: similar contexts and the turn between them."""

    def __init__(self) -> None:
        self._known: list[F64] = []

    def add(self, points: F32) -> None:
        self._known.append(scan_context(points))

    def nearest(self, points: F32, count: int) -> list[tuple[int, F64]]:
        order = nearest_contexts(scan_context(points), self._known, count)
        return [(number, yaw_transform(yaw)) for number, yaw in order]


class DensityMaps:
    """MapClosures: matches of ORB features of density maps, seen from above.

    The library puts what it searches for into its database; such scans are left out of answers. Its
    own normals of thinned points may turn the ground upside down: it gets normals that point up.
    """

    def __init__(self) -> None:
        library = importlib.import_module("map_closures.map_closures")
        self._closures = library.MapClosures()
        self._count = 0
        self._asked = 0

    def add(self, points: F32) -> None:
        self._closures.get_closures(APART * self._count, *_with_normals(points))
        self._count += 1

    def nearest(self, points: F32, count: int) -> list[tuple[int, F64]]:
        self._asked += 1
        closures = self._closures.get_closures(
            APART * (self._count + self._asked), *_with_normals(points)
        )
        known = [c for c in closures if c.source_id < APART * self._count]
        known.sort(key=lambda c: -c.number_of_inliers)
        # its pose leads from the scan to the points
        return [(c.source_id // APART, inverse(np.asarray(c.pose))) for c in known[:count]]


def _with_normals(points: F32) -> tuple[F64, F64, F64]:
    """Points (n, 3), and some of them (m, 3) with unit normals (m, 3) that point up."""
    centre = points[thin(points, NORMAL_CELL)].astype(np.float64)
    normal = shape(centre, NORMAL_NEIGHBOURS).normal.astype(np.float64)
    return points.astype(np.float64), centre, normal * np.where(normal[:, 2:] < 0, -1.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Scan:
    """A scan of the database: the file of its level points, and ``world_T_scan`` (4, 4)."""

    path: Path
    world_T_scan: F64


class ScanSystem:
    """The ``candidates`` most similar of the ``places``, each registered.

    Scans of the database lie in files in ``folder`` as long as it is used.
    """

    def __init__(
        self,
        name: str,
        places: Callable[[], Places],
        register: Register,
        candidates: int,
        folder: Path,
    ) -> None:
        self.name = name
        self._make_places = places
        self._places = places()
        self._register = register
        self._candidates = candidates
        self._folder = tempfile.TemporaryDirectory(prefix=".scratch.", dir=folder)
        self._scans: list[_Scan] = []

    def fit(self, database: Sequence[View]) -> None:
        self._scans = []
        self._places = self._make_places()
        for number in range(len(database)):
            view = database[number]
            world_T_scan = level_pose(view.world_T_base)
            points = _thinned(apply(inverse(world_T_scan) @ view.world_T_base, view.points))
            path = Path(self._folder.name) / f"{number:06d}.npy"
            np.save(path, points)
            self._scans.append(_Scan(path, world_T_scan))
            self._places.add(points)

    def localise(self, query: Query) -> list[RankedPose]:
        points, query_T_base = level_points(query.views)
        query_T_scan = level_pose(query_T_base)
        scan = _thinned(apply(inverse(query_T_scan), points))
        scan_T_base = inverse(query_T_scan) @ query_T_base
        answers = []
        for number, start in self._places.nearest(scan, self._candidates):
            stored = self._scans[number]
            pose, score = self._register(
                np.load(stored.path).astype(np.float64), scan.astype(np.float64), start
            )
            if score > 0:
                answers.append(RankedPose(stored.world_T_scan @ pose @ scan_T_base, score))
        return sorted(answers, key=lambda pose: -pose.score)[:MOST_POSES]


def level_pose(level_T_base: F64) -> F64:
    """The pose (4, 4) of a base without its roll and pitch."""
    yaw = float(np.arctan2(level_T_base[1, 0], level_T_base[0, 0]))
    return yaw_transform(yaw, level_T_base[:3, 3])


def _thinned(points: F64) -> F32:
    kept = points.astype(np.float32)
    return np.asarray(kept[thin(kept, KEPT_CELL)])


def fit_on_points(target: F64, query: F64, start: F64) -> tuple[F64, float]:
    """Our point-to-plane fit; the score is the share of points with a partner."""
    kept = thin(query, GICP_CELL)
    surface = surface_of(target, GICP_CELL)
    fit = align(query[kept], surface, start, tuple(Step(reach, 30) for reach in REACHES))
    return fit.target_T_query, fit.inliers


def gicp() -> Register:
    """Generalised ICP by small_gicp, or our own fit where that is not installed."""
    try:
        small_gicp = importlib.import_module("small_gicp")
    except ModuleNotFoundError:
        logger.warning("small_gicp is not installed: our own fit on points takes its part.")
        return fit_on_points

    def register(target: F64, query: F64, start: F64) -> tuple[F64, float]:
        clouds = [
            small_gicp.preprocess_points(points, downsampling_resolution=GICP_CELL, num_threads=1)
            for points in (target, query)
        ]
        pose = start
        for reach in REACHES:
            fit = small_gicp.align(
                clouds[0][0],
                clouds[1][0],
                clouds[0][1],
                pose,
                max_correspondence_distance=reach,
                num_threads=1,
                max_iterations=30,
            )
            pose = fit.T_target_source
        return np.asarray(pose), fit.num_inliers / max(1, clouds[1][0].size())

    return register


def kiss_matcher() -> Register:
    """KISS-Matcher, which takes no start; the score is the number of its inliers."""
    library = importlib.import_module("kiss_matcher")

    def register(target: F64, query: F64, start: F64) -> tuple[F64, float]:
        matcher = library.KISSMatcher(library.KISSMatcherConfig(KISS_VOXEL))
        result = matcher.estimate(query.astype(np.float32), target.astype(np.float32))
        inliers = int(matcher.get_num_final_inliers())
        if not result.valid or inliers < LEAST_KISS_INLIERS:
            return start, 0.0
        pose = np.eye(4)
        pose[:3, :3] = np.asarray(result.rotation)
        pose[:3, 3] = np.asarray(result.translation).ravel()
        return pose, float(inliers)

    return register


def make_scan_context(options: SystemOptions) -> ScanSystem:
    """Scan Context and generalised ICP."""
    return ScanSystem("scan-context", Contexts, gicp(), GICP_CANDIDATES, options.folder)


def make_kiss_matcher(options: SystemOptions) -> ScanSystem:
    """Scan Context and KISS-Matcher."""
    return ScanSystem("kiss-matcher", Contexts, kiss_matcher(), KISS_CANDIDATES, options.folder)


def make_map_closures(options: SystemOptions) -> ScanSystem:
    """MapClosures and generalised ICP."""
    return ScanSystem("map-closures", DensityMaps, gicp(), GICP_CANDIDATES, options.folder)

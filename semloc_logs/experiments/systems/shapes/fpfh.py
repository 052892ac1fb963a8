"""FPFH in place of our descriptor: 33 dimensions, with the radius of our subvolumes."""

from __future__ import annotations

import numpy as np

from semloc_logs.experiments.systems.catalogue import SystemOptions
from semloc_logs.experiments.systems.level_maps import LevelMap
from semloc_logs.experiments.systems.shapes.feature_histograms import feature_histograms
from semloc_logs.experiments.systems.shapes.shape_matching import (
    STRIDE,
    Described,
    ShapeSystem,
    keypoints_of,
)
from semloc_logs.experiments.systems.shapes.training_views import Training, simulated_training
from semloc_logs.mapping.selection import thin
from semloc_logs.settings import Resolved
from semloc_logs.subvolumes.cut import SIZE

THINNED = 2.0  # voxels: of the cells that keep one point; with all it takes ten times as long


class FeatureHistograms:
    """FPFH of the centres of occupied voxels."""

    turns = False

    def fit(self, training: Training, settings: Resolved) -> None:
        """Nothing is learnt."""

    def describe(self, level_map: LevelMap, yaw: float) -> Described:
        v = level_map.voxel_size
        kept = thin(level_map.points, THINNED * v)
        points = level_map.points[kept]
        rows = keypoints_of(points, STRIDE * v)
        histograms = feature_histograms(points, level_map.normals[kept], rows, SIZE / 2 * v)
        return Described(points[rows], histograms.astype(np.float32))


def make_fpfh(options: SystemOptions) -> ShapeSystem:
    """FPFH in our pipeline."""
    return fpfh_system(options, simulated_training(quick=options.quick))


def fpfh_system(options: SystemOptions, training: Training) -> ShapeSystem:
    """The same, with words learnt from ``training``."""
    return ShapeSystem("fpfh", FeatureHistograms(), options.settings, training, options.folder)

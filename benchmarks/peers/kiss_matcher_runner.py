"""KISS-Matcher for `semloc benchmark localisation`: JOB. Voxels of 0.5 m; the score is the number
of final inliers.

Needs kiss-matcher and numpy.
"""

import sys
from pathlib import Path

import kiss_matcher
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from local_maps import run_pairs, thinned

VOXEL = 0.5


def prepare(points):
    return thinned(points, 0.2).astype(np.float32)


def register(database, query, yaw):
    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(VOXEL))
    found = matcher.estimate(query, database)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.asarray(found.rotation), np.asarray(found.translation).ravel()
    return (float(matcher.get_num_final_inliers()), pose) if found.valid else (0.0, pose)


run_pairs(prepare, register)

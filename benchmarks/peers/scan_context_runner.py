"""small_gicp for `semloc benchmark localisation`: JOB; generalised ICP from the headings that Scan
Context gives.

From 3 m down to 1 m, clouds thinned to 0.5 m. The score is the share of the query's points with a
partner. Needs small_gicp and numpy.
"""

import sys
from pathlib import Path

import numpy as np
import small_gicp

sys.path.insert(0, str(Path(__file__).parent))
from local_maps import run_pairs, turned

CELL = 0.5


def prepare(cloud):
    return small_gicp.preprocess_points(
        cloud, downsampling_resolution=CELL, num_neighbors=20, num_threads=1
    )


def register(database, query, yaw):
    pose = turned(yaw)
    for reach in (3.0, 1.0):
        found = small_gicp.align(
            database[0],
            query[0],
            database[1],
            pose,
            max_correspondence_distance=reach,
            num_threads=1,
            max_iterations=30,
        )
        pose = found.T_target_source
    return found.num_inliers / max(1, query[0].size()), np.asarray(pose)


run_pairs(prepare, register)

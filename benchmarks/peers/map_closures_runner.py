"""MapClosures for `semloc benchmark localisation`: JOB; its own settings, refined on the points as
KISS-SLAM does, here by generalised ICP.

Every query is put into its database too: what it finds among them is left out. The score is the
number of inliers. It gets normals that point up: those it makes of a thinned cloud turn the ground
over. Needs map-closures, small-gicp and numpy.
"""

import sys
from pathlib import Path

import numpy as np
import small_gicp
from map_closures.map_closures import MapClosures

sys.path.insert(0, str(Path(__file__).parent))
from local_maps import run

APART = 10  # of ids: neighbours closer than 3 would not be compared
REFINED = 3
NORMAL_CELL = 1.0  # m: of the points whose normals it gets


def prepare(cloud):
    return small_gicp.preprocess_points(
        cloud, downsampling_resolution=0.5, num_neighbors=20, num_threads=1
    )


def with_normals(cloud):
    """The cloud, and some of its points with normals that point up."""
    part, _ = small_gicp.preprocess_points(
        cloud, downsampling_resolution=NORMAL_CELL, num_neighbors=20, num_threads=1
    )
    normals = part.normals()[:, :3]
    return cloud, part.points()[:, :3], normals * np.where(normals[:, 2:] < 0, -1.0, 1.0)


class Database:
    def __init__(self, clouds):
        self.closer = MapClosures()
        self.parts = []
        for k, cloud in enumerate(clouds):
            self.closer.get_best_closure(APART * k, *with_normals(cloud))
            self.parts.append(prepare(cloud))
        self.next = APART * (len(self.parts) + 1)

    def answer(self, cloud, _):
        found = [
            c
            for c in self.closer.get_closures(self.next, *with_normals(cloud))
            if c.source_id < APART * len(self.parts)
        ]
        self.next += APART
        found.sort(key=lambda c: -c.number_of_inliers)
        query = prepare(cloud) if found else None
        return [self._refined(c, query) for c in found[:REFINED]]

    def _refined(self, closure, query):
        number = closure.source_id // APART
        database = self.parts[number]
        pose = np.linalg.inv(closure.pose)
        for reach in (2.0, 1.0):
            fit = small_gicp.align(
                database[0],
                query[0],
                database[1],
                pose,
                max_correspondence_distance=reach,
                num_threads=1,
            )
            pose = fit.T_target_source
        return number, closure.number_of_inliers, pose


run(Database, Database.answer)

"""FPFH + RANSAC + ICP (Open3D) for `semloc benchmark localisation`: JOB; the steps of Open3D's
tutorial on global registration.

Voxels of 0.8 m, normals in 2, features in 5, correspondences in 1.5 voxels, 20,000 iterations where
the tutorial has 100,000; point-to-plane ICP within 0.4 voxels. The score is RANSAC's fitness. Needs
open3d and numpy.
"""

import sys
from pathlib import Path

import numpy as np
import open3d as o3d

sys.path.insert(0, str(Path(__file__).parent))
from local_maps import run_pairs

R = o3d.pipelines.registration
VOXEL = 0.8


def prepare(points):
    fine = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(VOXEL / 2)
    cloud = fine.voxel_down_sample(VOXEL)
    for part in (fine, cloud):
        part.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=2 * VOXEL, max_nn=30))
        part.orient_normals_towards_camera_location(np.array([0.0, 0.0, 2.0]))
    return (
        fine,
        cloud,
        R.compute_fpfh_feature(
            cloud, o3d.geometry.KDTreeSearchParamHybrid(radius=5 * VOXEL, max_nn=100)
        ),
    )


def register(database, query, yaw):
    near = 1.5 * VOXEL
    checks = [
        R.CorrespondenceCheckerBasedOnEdgeLength(0.9),
        R.CorrespondenceCheckerBasedOnDistance(near),
    ]
    found = R.registration_ransac_based_on_feature_matching(
        query[1],
        database[1],
        query[2],
        database[2],
        True,
        near,
        R.TransformationEstimationPointToPoint(False),
        3,
        checks,
        R.RANSACConvergenceCriteria(20_000, 0.999),
    )
    better = R.registration_icp(
        query[0],
        database[0],
        0.4 * VOXEL,
        found.transformation,
        R.TransformationEstimationPointToPlane(),
    )
    return found.fitness, better.transformation


run_pairs(prepare, register)

"""FPFH (Open3D) for `semloc benchmark retrieval`: FOLDER RADIUS CELL; features of the points
nearest to given centres.

For every K with points_K.npy ((n, 3), metres), track_K.npy ((k, 3), where the sensor was) and
centres_K.npy ((m, 3)) it writes features_K.npy ((m, 33) float32). Normals are of all points
within a metre, seen from the sensor's nearest place; features come from the points thinned to cells
of CELL metres (0: all of them) within RADIUS. Needs open3d and numpy only.
"""

import os
import sys
from pathlib import Path

import numpy as np
import open3d as o3d


def features(points, track, centres, radius, cell):
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=1.0, max_nn=60))
    if cell > 0:
        cloud = cloud.voxel_down_sample(cell)
    places = o3d.geometry.KDTreeFlann(o3d.geometry.PointCloud(o3d.utility.Vector3dVector(track)))
    kept = np.asarray(cloud.points)
    normals = np.asarray(cloud.normals)
    sensor = track[[places.search_knn_vector_3d(p, 1)[1][0] for p in kept]]
    away = np.einsum("nd,nd->n", normals, sensor - kept) < 0
    normals[away] *= -1
    cloud.normals = o3d.utility.Vector3dVector(normals)
    tree = o3d.geometry.KDTreeFlann(cloud)
    nearest = np.array([tree.search_knn_vector_3d(c, 1)[1][0] for c in centres])
    used, row = np.unique(nearest, return_inverse=True)
    search = o3d.geometry.KDTreeSearchParamRadius(radius)
    found = o3d.pipelines.registration.compute_fpfh_feature(cloud, search, used.tolist())
    return np.asarray(found.data).T[row].astype(np.float32)


def main():
    folder = Path(sys.argv[1])
    radius = float(sys.argv[2])
    cell = float(sys.argv[3])
    for path in sorted(folder.glob("points_*.npy")):
        key = path.stem.removeprefix("points_")
        points, track, centres = (
            np.load(folder / f"{name}_{key}.npy").astype(float)
            for name in ("points", "track", "centres")
        )
        part = folder / f"part_{key}.npy"
        np.save(part, features(points, track, centres, radius, cell))
        os.replace(part, folder / f"features_{key}.npy")


main()

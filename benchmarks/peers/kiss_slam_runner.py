"""KISS-SLAM's OccupancyGridMapper (Bonxai) for `semloc benchmark fusion`: FOLDER VOXEL_SIZE
MAX_RANGE; a line in, a line of JSON out.

Needs kiss-slam and numpy only: what its mapper imports to write pictures and point clouds is not
used here and may be missing. It thins each scan to one point a voxel and leaves out points beyond
the range.
"""

import json
import sys
import time
import types
from pathlib import Path

import numpy as np

for unused in ("open3d", "PIL"):
    sys.modules[unused] = types.ModuleType(unused)
sys.modules["PIL"].Image = None

from kiss_slam.config.config import OccupancyMapperConfig  # noqa: E402
from kiss_slam.occupancy_mapper import OccupancyGridMapper  # noqa: E402


def main():
    folder = Path(sys.argv[1])
    voxel_size = float(sys.argv[2])
    max_range = float(sys.argv[3])
    poses = np.load(folder / "poses.npy")
    scans = [np.load(folder / f"points_{k}.npy").astype(float) for k in range(len(poses))]
    content = None
    for _ in sys.stdin:
        mapper = OccupancyGridMapper(
            OccupancyMapperConfig(resolution=voxel_size, max_range=max_range)
        )
        ms = []
        cpu = []
        for points, pose in zip(scans, poses, strict=True):
            start = time.perf_counter()
            start_cpu = time.process_time()
            mapper.integrate_frame(points, pose)
            ms.append(1e3 * (time.perf_counter() - start))
            cpu.append(1e3 * (time.process_time() - start_cpu))
        if content is None:
            mapper.compute_3d_occupancy_information()
            occupied = int((mapper.occupancies > 0.5).sum())
            content = {"free": len(mapper.occupancies) - occupied, "occupied": occupied}
        print(json.dumps({"ms": ms, "cpu_ms": cpu, "finish_ms": 0.0, **content}), flush=True)


main()

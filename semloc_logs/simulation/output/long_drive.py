"""Drive logs of any length at little cost: one short simulated drive, replayed with its poses
carried on.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.simulation.drives.drive import DriveFrame, mounting
from semloc_logs.simulation.drives.trajectory import START_NS, Trajectory, poses_along, smooth_line
from semloc_logs.simulation.meshes.world import Scene
from semloc_logs.simulation.output.drive_log import write_session
from semloc_logs.simulation.sensors.lidar import Sweep, SweepOptions, full_sweep
from semloc_logs.simulation.sensors.lidar_models import MODELS
from semloc_logs.simulation.town.road_network import lane_path, path_network
from semloc_logs.simulation.town.street import build_street, street_ground

LAP_M = 250.0
_SPACING = 2.0  # m between sweeps
_POSES = 6  # poses of the odometry from one sweep to the next
_STEP_NS = 48_000_000  # between poses: 7 m/s


class Lap:
    """A simulated drive along one road: poses (n + 1, 4, 4), the last one the next lap's first, and
    a sweep every 2 m.
    """

    def __init__(self, seed: int = 0, columns: int = 600, length_m: float = LAP_M) -> None:
        rng = np.random.default_rng([seed, 91])
        along = np.linspace(0.0, length_m + 120.0, 200)
        network = path_network(rng, np.column_stack([along, 6.0 * np.sin(along / 60.0)]))
        line = smooth_line(
            lane_path(
                network,
                [
                    (road, True)
                    for road in range(len(network.roads))
                    if _ahead(network.roads[road].path)
                ],
            )
        )
        count = int(length_m / _SPACING)
        distances = 30.0 + _SPACING / _POSES * np.arange(count * _POSES + 1, dtype=np.float64)
        self.poses = poses_along(line, distances, street_ground(network, seed).slope_height, rng)
        self.base_T_lidar = mounting(MODELS["hdl32"])
        scene = Scene(build_street(network, seed))
        self.sweeps = []
        for pose in self.poses[:-1:_POSES]:
            turn = full_sweep(
                scene, pose @ self.base_T_lidar, rng, MODELS["hdl32"], SweepOptions(columns)
            )
            # all points at once: no motion has to be undone, whichever way the lap is driven
            self.sweeps.append(Sweep(turn.points, turn.labels, turn.ring, np.zeros_like(turn.turn)))

    def write(self, path: Path, laps: int, *, onwards: bool) -> int:
        """The lap ``laps`` times as the log ``path`` (.mcap or .bag): the road going on, or the
        same one there and back; sweeps written.
        """
        steps = len(self.poses) - 1
        first = self.poses[0]
        after = self.poses[-1]
        turned = np.arctan2(after[1, 0], after[0, 0]) - np.arctan2(first[1, 0], first[0, 0])
        again = yaw_transform(float(turned))
        again[:3, 3] = after[:3, 3] - again[:3, :3] @ first[:3, 3]
        poses = [
            np.linalg.matrix_power(again, lap) @ self.poses[:-1]
            if onwards
            else self.poses[:-1][:: -1 if lap % 2 else 1]
            for lap in range(laps)
        ]
        track = np.concatenate(poses)
        stamps = START_NS + _STEP_NS * np.arange(len(track), dtype=np.int64)
        return write_session(
            path, Trajectory(stamps, track, track), self._frames(track, steps, laps, onwards)
        )

    def _frames(self, track: F64, steps: int, laps: int, onwards: bool) -> Iterator[DriveFrame]:
        for lap in range(laps):
            back = not onwards and lap % 2 == 1
            for k in range(len(self.sweeps) - 1, -1, -1) if back else range(len(self.sweeps)):
                i = lap * steps + (steps - 1 - k * _POSES if back else k * _POSES)
                yield DriveFrame(
                    START_NS + _STEP_NS * i, track[i], track[i], self.base_T_lidar, self.sweeps[k]
                )


def _ahead(path: F64) -> bool:
    """Whether a road belongs to the driven line, which lies along x, and not to a side street."""
    return bool(abs(path[-1, 0] - path[0, 0]) > abs(path[-1, 1] - path[0, 1]))

"""Streets of simulated towns that no training has seen, mapped by a camera and by a LIDAR, with
queries from other drives through them.

The retrieval benchmark uses them. Databases are fused from a drive along each street in summer, by
a camera that looks ahead and by a LIDAR. Queries are fused from one or five frames of another
drive: another line in the lane, other parked cars and traffic; with the camera turned by 0, 90 or
180 degrees, or with the LIDAR in snow. Each query map is turned by the paper's heading that is
nearest to the true one, of a frame of unknown heading, so that the rest is anything up to half a
step. Streets are kept in a folder.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from semloc_logs.arrays import F32, F64, U8
from semloc_logs.benchmarks.descriptors.places import (
    HEADINGS,
    Place,
    Street,
    map_place,
    read_street,
    turned_place,
    write_street,
)
from semloc_logs.benchmarks.versions import simulation_version
from semloc_logs.errors import SettingsError, WorkspaceError
from semloc_logs.numerics.transforms import apply, inverse, yaw_transform
from semloc_logs.settings import Resolved
from semloc_logs.simulation.conditions import Condition
from semloc_logs.simulation.drives.traffic import Traffic, random_traffic
from semloc_logs.simulation.drives.trajectory import poses_along, smooth_line
from semloc_logs.simulation.meshes.world import Scene
from semloc_logs.simulation.sensors.camera import CAMERAS, camera_points
from semloc_logs.simulation.sensors.lidar import SweepOptions, full_sweep
from semloc_logs.simulation.sensors.lidar_models import MODELS
from semloc_logs.simulation.town.road_network import RoadNetwork, grid_network, lane_path
from semloc_logs.simulation.town.street import build_street, street_ground
from semloc_logs.simulation.town.terrain import Ground
from semloc_logs.tables.metadata import SCHEMA_VERSION
from semloc_logs.tables.table import read_metadata
from semloc_logs.voxels.grid import BlockMap, Fuser

# points and sensor (base frame, m), labels, standard deviation of the range
Cloud = tuple[F32, F32, U8, F32 | None]

TOWNS = 9001  # seed of the first town; seeds of training count from 0
APART = 10_000.0  # m between the towns in the common frame
SENSORS = ("camera", "lidar")
# and the sensor of the query
SCENARIOS = {"0": "camera", "90": "camera", "180": "camera", "season": "lidar"}
SPACING, QUERY_SPACING = 1.5, 1.0  # m between frames
FRAMES = (1, 5)  # of queries
LIDAR = MODELS["hdl64"]
COLUMNS = 900
MAX_RANGE = 60.0  # m
SUMMER = Condition(0)
LATER = Condition(1)
SNOW = Condition(2, "snow")


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Held-out streets in a folder, as many as give ``database`` descriptors of each sensor, and
    others in memory; ``queries`` words of each scenario.
    """

    paths: tuple[Path, ...]
    settings: Resolved
    database: int
    queries: int
    others: tuple[Street, ...] = ()

    def streets(self) -> Iterator[Street]:
        """One street after the other."""
        yield from map(read_street, self.paths)
        yield from self.others


@dataclass(frozen=True, slots=True)
class Extent:
    """How large the held-out towns are: crossings of a side, metres between them, queries of each
    kind and number of frames a street.
    """

    side: int = 4
    block: float = 85.0
    queries: int = 3


@dataclass(frozen=True, slots=True)
class Size:
    """How many held-out streets are made: descriptors of the database, query words of each
    scenario, and the towns.
    """

    database: int = 100_000
    queries: int = 2000
    extent: Extent = Extent()


def held_out(
    folder: Path,
    settings: Resolved,
    count: Callable[[Place], int],
    size: Size = Size(),
    on_progress: Callable[[str], None] = lambda _: None,
) -> HeldOut:
    """Streets with ``size.database`` descriptors of each sensor by ``count``.

    They are simulated where ``folder`` lacks them. Another version of the simulation has files of
    its own. SettingsError when the towns have fewer descriptors.
    """
    database = size.database
    extent = size.extent
    folder = folder / simulation_version()
    note = {
        "schema_version": SCHEMA_VERSION,
        "fusion": settings.fingerprint("fusion"),
        "headings": HEADINGS,
        "extent": repr(extent),
    }
    paths: list[Path] = []
    counts = dict.fromkeys(SENSORS, 0)
    for town in range(8):
        roads = len(_network(town, extent).roads)
        for road in np.random.default_rng([TOWNS + town, 91]).permutation(roads):
            if min(counts.values()) >= database:
                break
            path = folder / f"street-{town}-{road:03d}.parquet"
            if not _is_made(path, note):
                street = simulate_street(town, int(road), settings, extent)
                held = {kind: count(place) for kind, place in street.database}
                write_street(path, street, {**note, "count": held})
            for kind, held in read_metadata(path)["count"].items():
                counts[kind] += held
            paths.append(path)
            on_progress(
                f"streets with {min(min(counts.values()), database)} of {database} descriptors "
                "are simulated"
            )
    _scene.cache_clear()  # a town takes hundreds of megabytes
    if min(counts.values()) < database:
        raise SettingsError(
            f"The held-out towns have {min(counts.values())} descriptors, not {database}: "
            "give a smaller --database."
        )
    return HeldOut(tuple(paths), settings, database, size.queries)


def _is_made(path: Path, note: dict[str, Any]) -> bool:
    try:
        content = read_metadata(path)
    except WorkspaceError:
        return False
    return {k: content.get(k) for k in note} == note


# -- simulation


@lru_cache(maxsize=8)
def _network(town: int, extent: Extent) -> RoadNetwork:
    return grid_network(
        np.random.default_rng([TOWNS + town, 61]), extent.side, extent.side, extent.block
    )


@lru_cache(maxsize=1)
def _ground(town: int, extent: Extent) -> Ground:
    return street_ground(_network(town, extent), TOWNS + town)


@lru_cache(maxsize=3)  # the conditions of one town
def _scene(town: int, extent: Extent, condition: Condition) -> Scene:
    return Scene(build_street(_network(town, extent), TOWNS + town, condition))


@dataclass(frozen=True, slots=True, eq=False)
class _Drive:
    """A drive along a line, in one condition of the town."""

    scene: Scene
    line: F64
    height: Callable[[F64, F64], F64]
    traffic: Traffic
    rng: np.random.Generator

    @property
    def length(self) -> float:
        return 0.5 * (len(self.line) - 1)

    def poses(self, distances: F64) -> F64:
        return poses_along(self.line, distances, self.height, self.rng)

    def camera(self, pose: F64, yaw: float) -> Cloud:
        model = replace(CAMERAS["stereo"], yaw=yaw)
        return camera_points(self.scene, pose, self.rng, model, traffic=self._moving(pose))

    def lidar(self, pose: F64) -> Cloud:
        mounted = np.eye(4)
        mounted[2, 3] = LIDAR.height
        options = SweepOptions(COLUMNS, MAX_RANGE, traffic=self._moving(pose))
        seen = full_sweep(self.scene, pose @ mounted, self.rng, LIDAR, options)
        origin = mounted[:3, 3].astype(np.float32)
        return seen.points + origin, origin, seen.labels, None

    def _moving(self, pose: F64) -> Scene | None:
        return self.traffic.scene(float(self.rng.uniform(0, 60)), pose)


def simulate_street(town: int, road: int, settings: Resolved, extent: Extent = Extent()) -> Street:
    """The maps and queries of one road of a town."""
    network = _network(town, extent)
    rng = np.random.default_rng([TOWNS + town, 92, road])
    lane = smooth_line(lane_path(network, [(road, True)]))
    across = np.gradient(lane, axis=0)[:, ::-1] * [1, -1]
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    common = np.eye(4)
    common[0, 3] = APART * town

    def drive(condition: Condition, beside: float) -> _Drive:
        ground = _ground(town, extent)
        line = lane + beside * across
        return _Drive(
            _scene(town, extent, condition),
            line,
            ground.slope_height,
            random_traffic(rng, ground, [line], 0.4),
            np.random.default_rng(rng),
        )

    first = drive(SUMMER, 0.0)
    poses = first.poses(np.arange(0.0, first.length, SPACING))
    database = [
        ("camera", _mapped(settings, [first.camera(p, 0.0) for p in poses], poses, common)),
        ("lidar", _mapped(settings, [first.lidar(p) for p in poses], poses, common)),
    ]
    queries: dict[str, list[Place]] = {}
    for name, sensor in SCENARIOS.items():
        again = drive(
            SNOW if name == "season" else LATER, float(rng.choice([-1, 1]) * rng.uniform(0.4, 1.2))
        )
        query_frames = queries.setdefault(name, [])
        for frames in FRAMES:
            for _ in range(extent.queries):
                middle = rng.uniform(0.2, 0.8) * again.length
                poses = again.poses(
                    middle + QUERY_SPACING * (np.arange(frames, dtype=np.float64) - frames // 2)
                )
                yaw = np.radians(float(name)) * rng.choice([-1, 1]) if sensor == "camera" else 0.0
                clouds = [
                    again.camera(p, yaw) if sensor == "camera" else again.lidar(p) for p in poses
                ]
                query_frames.append(
                    _query(settings, clouds, poses, common, float(rng.uniform(0, 2 * np.pi)))
                )
    return Street(database, queries)


def _fuse(
    settings: Resolved, clouds: list[Cloud], poses: F64, radius: float = np.inf
) -> tuple[BlockMap, F64]:
    """The map of some clouds and the sensor's places (n, 3)."""
    fuser = Fuser(settings.fusion)
    track = []
    for (points, origin, labels, sigma), pose in zip(clouds, poses, strict=True):
        is_inside = np.linalg.norm(points - origin, axis=1) < radius
        fuser.add(
            points[is_inside],
            labels[is_inside],
            origin,
            None if sigma is None else sigma[is_inside],
            pose,
        )
        track.append(apply(pose, origin[None])[0])
    return fuser.finish(), np.array(track, np.float64)


def _mapped(settings: Resolved, clouds: list[Cloud], poses: F64, common_T_map: F64) -> Place:
    blocks, track = _fuse(settings, clouds, poses)
    return map_place(blocks, track, float(np.median(poses[:, 2, 3])), common_T_map)


def _query(
    settings: Resolved, clouds: list[Cloud], poses: F64, common_T_map: F64, heading: float
) -> Place:
    """A query in a frame of some ``heading`` in the map, its origin in the middle of the drive."""
    map_T_query = yaw_transform(heading, tuple(poses[len(poses) // 2][:3, 3]))
    blocks, track = _fuse(settings, clouds, inverse(map_T_query) @ poses, settings.query.radius)
    return turned_place(blocks, track, 0.0, common_T_map @ map_T_query, settings)

"""Three short drives over one crossing, with known poses and known session frames, in three
encodings.

Monday goes east, Tuesday west in the other lane, Wednesday north along the crossing street. The
odometry of a drive does not drift: it is the true pose in a session frame that is shifted, turned
and, on Monday, tilted.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.engines import Engine, Serial
from semloc_logs.logs.poses.trajectory_file import TrajectoryFile
from semloc_logs.numerics.transforms import exp_se3, interpolate, yaw_transform
from semloc_logs.settings import Resolved, load
from semloc_logs.simulation.drives.drive import simulate_drive
from semloc_logs.simulation.drives.trajectory import Trajectory, drive, smooth_line
from semloc_logs.simulation.meshes.world import (
    BUILDING,
    CAR,
    POLE,
    ROAD,
    VEGETATION,
    MeshBuilder,
    World,
    box,
    ellipsoid,
    place,
)
from semloc_logs.simulation.output.drive_log import write_session
from semloc_logs.simulation.sensors.sensor import Sensor
from semloc_logs.stages import close as close_stage
from semloc_logs.stages import describe as describe_stage
from semloc_logs.stages import fuse as fuse_stage
from semloc_logs.stages.inputs import Redo, SessionInput
from semloc_logs.stages.report import Report
from semloc_logs.workspace import Workspace
from tests.pipeline.fusions import Fuse

START_NS = 1_760_000_000_123_456_789
DAY_NS = 86_400_000_000_000
LANE = 1.8  # m from the middle of the street
HALF = 10.0  # m driven on either side of the crossing

QUICK = {  # large voxels, few words, few hypotheses
    "fusion.voxel_size": "0.5",
    "descriptor.reach": "12",
    "descriptor.headings": "8",
    "query.every": "6",
    "closures.hypotheses": "16",
    "closures.places": "4",
}


def quick_settings(**changes: str) -> Resolved:
    """Settings under which the three drives take seconds; ``changes`` are keys with ``__`` for the
    dot.
    """
    return load(
        assignments=QUICK | {key.replace("__", "."): value for key, value in changes.items()}
    ).resolved()


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A log and the truth of it; ``session_T_world`` (4, 4) is the frame of its odometry."""

    name: str
    log: Path
    session_T_world: F64
    trajectory: Trajectory

    def world_T_base(self, stamp_ns: int) -> F64:
        """True pose (4, 4) of the base."""
        return np.asarray(
            interpolate(
                self.trajectory.stamps_ns, self.trajectory.world_T_base, np.array([stamp_ns])
            )[0]
        )


def crossing() -> World:
    """Two streets that cross at the origin; each side has other houses, trees, poles and cars."""
    rng = np.random.default_rng(4)
    builder = MeshBuilder(lambda x, y: 0 * x)
    builder.add(box(120.0, 120.0, 1.0, z=-1.0), ROAD, ground="none")
    for east in (-1, 1):
        for north in (-1, 1):
            for k, (along, across) in enumerate(((12.0, 12.0), (27.0, 12.0), (12.0, 27.0))):
                length = rng.uniform(5, 9)
                width = rng.uniform(5, 9)
                height = rng.uniform(3, 9)
                house = box(
                    length,
                    width,
                    height,
                    x=east * (along + rng.uniform(-2, 2)),
                    y=north * (across + rng.uniform(-2, 2)),
                )
                builder.add(house, BUILDING, ground="none")
                for _ in range(2):
                    x, y = (
                        (rng.uniform(5.0, 6.5), rng.uniform(6, 30))
                        if k == 2
                        else (rng.uniform(6, 30), rng.uniform(5.0, 6.5))
                    )
                    kind = rng.integers(3)
                    if kind == 0:
                        builder.add(
                            box(0.3, 0.3, rng.uniform(3, 7), x=east * x, y=north * y),
                            POLE,
                            ground="none",
                        )
                    elif kind == 1:
                        tree = ellipsoid((1.2, 1.2, rng.uniform(1.5, 2.5)), z=rng.uniform(2.5, 4))
                        builder.add(place(tree, east * x, north * y), VEGETATION, ground="none")
                    else:
                        turned = rng.uniform(0, np.pi)
                        builder.add(
                            place(box(4.2, 1.8, 1.5), east * x, north * y, yaw=turned),
                            CAR,
                            ground="none",
                        )
    return builder.build()


LINES = {
    "monday": [[-HALF, -LANE], [HALF, -LANE]],  # east
    "tuesday": [[HALF, LANE], [-HALF, LANE]],  # west
    "wednesday": [[LANE, -HALF], [LANE, HALF]],  # north
}
FORMATS = {"monday": "mcap", "tuesday": "bag", "wednesday": "protobuf"}
# headings of the base in these frames: 40, 80 and 290 degrees
SESSION_T_WORLD = {
    "monday": exp_se3(np.array([100.0, -50.0, 2.0]), np.array([0.05, 0.0, 0.0]))
    @ yaw_transform(np.radians(40)),
    "tuesday": yaw_transform(np.radians(-100), (-20.0, 300.0, 5.0)),
    "wednesday": yaw_transform(np.radians(200), (7.0, 8.0, -9.0)),
}


def simulate(folder: Path, name: str, world: World, format_: str) -> Drive:
    """One of the drives, written to ``folder``."""
    number = list(LINES).index(name)
    line = smooth_line(np.array(LINES[name]))
    rng = np.random.default_rng(number)
    driven = drive(line, lambda x, y: 0 * x, rng, start_ns=START_NS + number * DAY_NS, drift=0.0)
    driven = replace(driven, odom_T_base=SESSION_T_WORLD[name] @ driven.world_T_base)
    log = folder / f"{name}{'.bag' if format_ == 'bag' else '.mcap'}"
    write_session(
        log,
        driven,
        simulate_drive(world, driven, Sensor("hdl32", columns=300), seed=number),
        format=format_,
    )
    return Drive(name, log, SESSION_T_WORLD[name], driven)


@pytest.fixture(scope="session")
def drives(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Drive]:
    """The three drives by name; their logs must not be changed."""
    folder = tmp_path_factory.mktemp("logs")
    world = crossing()
    return {name: simulate(folder, name, world, FORMATS[name]) for name in LINES}


COARSE = {  # few keyframes, near points, few queries
    "fusion.keyframe_distance": "5",
    "fusion.max_range": "25",
    "query.every": "8",
    "closures.hypotheses": "4",
    "closures.places": "2",
    "closures.every": "8",  # each query by itself
}


def coarse_settings(**changes: str) -> Resolved:
    """Settings for tests of repeated work; ``changes`` as above."""
    return quick_settings(
        **{key.replace(".", "__"): value for key, value in COARSE.items()} | changes
    )


def files(folder: Path) -> dict[str, str]:
    """Digest of every table and JSON file under ``folder``."""
    paths = sorted(p for p in folder.rglob("*") if p.suffix in (".parquet", ".json"))
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in paths}


def write_times(folder: Path) -> dict[str, int]:
    """When every file under ``folder`` was written, the pictures and the index too; ns."""
    return {
        str(p.relative_to(folder)): p.stat().st_mtime_ns
        for p in sorted(folder.rglob("*"))
        if p.is_file() and p.name != ".lock"
    }


class Interrupted(Exception):
    """Stands for whatever ends a program in the middle of its work."""


def renames(
    monkeypatch: pytest.MonkeyPatch, work: Callable[[], Any], stop_at: int | None = None
) -> int:
    """Do ``work`` and count how often a file or folder was put in its place; instead of the one
    with the number ``stop_at`` it is interrupted.
    """
    count = 0
    replace_ = os.replace

    def counted(source: Any, target: Any, **options: Any) -> None:
        nonlocal count
        count += 1
        if count - 1 == stop_at:
            raise Interrupted
        replace_(source, target, **options)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", counted)
        if stop_at is None:
            work()
        else:
            with pytest.raises(Interrupted):
                work()
    return count


def inputs_of(drives: dict[str, Drive], *names: str) -> list[SessionInput]:
    """Each drive as a session of its own."""
    return [SessionInput(name, (drives[name].log,)) for name in names]


def whole(
    folder: Path, drives: dict[str, Drive], settings: Resolved, engine: Engine | None = None
) -> Workspace:
    """A workspace with the closures of ``drives``."""
    work = Workspace(folder)
    engine = engine or Serial()
    fuse_stage.fuse(inputs_of(drives, *drives), work, settings, engine)
    describe_stage.describe(work, [], settings, engine)
    close_stage.close(work, settings, engine)
    return work


@pytest.fixture(scope="session")
def tools() -> SimpleNamespace:
    """The functions of this file, for tests that cannot import it."""
    return SimpleNamespace(
        quick_settings=quick_settings,
        coarse_settings=coarse_settings,
        COARSE=QUICK | COARSE,
        files=files,
        write_times=write_times,
        renames=renames,
        inputs=inputs_of,
        whole=whole,
        crossing=crossing,
    )


@pytest.fixture(scope="session")
def labelled(tmp_path_factory: pytest.TempPathFactory, drives: dict[str, Drive]) -> Workspace:
    """Closures of all drives, with the labels of the logs; must not be changed."""
    return whole(tmp_path_factory.mktemp("labelled"), drives, quick_settings())


@pytest.fixture(scope="session")
def unlabelled(tmp_path_factory: pytest.TempPathFactory, drives: dict[str, Drive]) -> Workspace:
    """Closures of all drives, with labels from the geometry; must not be changed."""
    return whole(
        tmp_path_factory.mktemp("unlabelled"), drives, quick_settings(labels__source="geometry")
    )


@pytest.fixture(scope="session")
def _coarse(tmp_path_factory: pytest.TempPathFactory, drives: dict[str, Drive]) -> Workspace:
    """Monday and Tuesday under coarse settings."""
    return whole(
        tmp_path_factory.mktemp("coarse"),
        {name: drives[name] for name in ("monday", "tuesday")},
        coarse_settings(),
    )


@pytest.fixture
def coarse(_coarse: Workspace, tmp_path: Path) -> Iterator[Workspace]:
    """Monday and Tuesday, closed under coarse settings; a copy that belongs to the test."""
    yield Workspace(Path(shutil.copytree(_coarse.path, tmp_path / "work")))
    shutil.rmtree(tmp_path / "work")


@pytest.fixture
def fuse(tools: SimpleNamespace, drives: dict[str, Drive], coarse: Workspace) -> Fuse:
    """Fuses Monday into the workspace ``coarse``, where it was fused before, with whatever differs
    from then.
    """

    def again(
        logs: list[Path] | None = None,
        settings: Resolved | None = None,
        topics: dict[str, str] | None = None,
        poses: TrajectoryFile | None = None,
        overwrite: bool = False,
    ) -> Report:
        monday = tuple(logs or [drives["monday"].log])
        session = SessionInput("monday", monday, topics or {}, poses)
        settings = settings or tools.coarse_settings()
        return fuse_stage.fuse(
            [session], coarse, settings, Serial(), redo=Redo.of(overwrite=overwrite)
        )

    return again

"""Simulated towns that no training has seen, as workspaces of a folder: simulated, fused, described
and queried, each step once.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer

from semloc_logs.engines import make_engine
from semloc_logs.evaluation.judged_alignments import judge_town, read_judged
from semloc_logs.settings import load
from semloc_logs.simulation import drive_plan
from semloc_logs.simulation.sensors.sensor import Sensor
from semloc_logs.simulation.sessions import simulate_sessions
from semloc_logs.stages.close import close
from semloc_logs.stages.describe import describe
from semloc_logs.stages.fuse import fuse
from semloc_logs.stages.inputs import SessionInput
from semloc_logs.tables.table import read_metadata
from semloc_logs.workspace import Workspace

CLOUD = "sensor_msgs/msg/PointCloud2"
LATCHED = ("/tf_static", "/lidar/label_space")
AROUND_NS = 300_000_000  # of a single sweep: its poses
FIRST_SEED = 200  # training has the seeds below


@dataclass(frozen=True, slots=True)
class Town:
    """A town of ``seed``, driven ``sessions`` times about ``length`` metres with each of the
    ``sensors``.

    ``trajectory``: number of a recorded drive that the streets lie along, driven there and back.
    ``labels`` is the source of the classes. With ``sweeps`` single sweeps so many metres apart are
    sessions of their own, instead of the drives.
    """

    name: str
    seed: int
    sensors: tuple[str, ...] = ("hdl32",)
    labels: str = "auto"
    noise: float = 0.0
    drift: float = 0.007
    seasons: tuple[str, ...] = ("summer",)
    roadworks: float = 0.0
    repeating: bool = False
    trajectory: str = ""
    start: float = 0.0
    sessions: int = 3
    length: float = 130.0
    sweeps: float = 0.0


def short_towns(first: int, count: int) -> list[Town]:
    """Short-driven towns by number, so that many streets of each are never seen by the other
    drives; two of three are cities of copied blocks, and their names begin with ``repeating``.
    """
    sensors = ("hdl32", "hdl64", "vlp16", "hdl32", "stereo")
    labels = ("auto", "geometry", "auto", "uniform")
    return [
        Town(
            f"{'repeating' if k % 3 else 'plain'}-{k:02d}",
            100 + k,
            (sensors[k % len(sensors)],),
            labels[k % len(labels)],
            noise=0.1,
            repeating=k % 3 > 0,
            sessions=4,
            length=160.0,
        )
        for k in range(first, first + count)
    ]


@dataclass(frozen=True, slots=True)
class Place:
    """Where the towns of a benchmark live, and the folder of recorded drives, if there is one."""

    folder: Path
    drives: Path | None = None

    def has(self, town: Town) -> bool:
        """Whether the town can be built here."""
        return not town.trajectory or (self.drives is not None and self._drive(town).exists())

    def _drive(self, town: Town) -> Path:
        return (self.drives or Path()) / f"kitti_{town.trajectory}.txt"

    def _part(self, town: Town) -> Path:
        """The driven part of a recorded drive as a file: streets along all of it would take minutes
        to build.
        """
        lines = self._drive(town).read_text().splitlines()
        at = np.array([[float(word) for word in line.split()] for line in lines])[:, [3, 11]]
        away = (
            np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(at, axis=0), axis=1))])
            - town.start
        )
        part = self.folder / town.name / "drive.txt"
        part.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(
            "".join(
                f"{line}\n" for line, m in zip(lines, away, strict=True) if 0 <= m <= town.length
            )
        )
        return part

    def simulate(self, town: Town) -> dict[str, Path]:
        """Logs by session name, with truth.json for all of them; existing ones are kept."""
        home = self.folder / town.name
        logs = {}
        truth = {}
        for sensor in town.sensors:
            place = home / sensor
            if not (place / "truth.json").exists():
                streets = drive_plan.Town(
                    FIRST_SEED + town.seed,
                    town.repeating,
                    town.seasons,
                    roadworks=town.roadworks,
                )
                trajectory = self._part(town) if town.trajectory else None
                route = drive_plan.Route(
                    town.sessions,
                    town.length,
                    trajectory,
                    there_and_back=trajectory is not None,
                )
                carried = Sensor(sensor, label_noise=town.noise, drift=town.drift)
                simulate_sessions(place, streets, route, carried, overwrite=True)
            for k in range(town.sessions):
                logs[f"{sensor}_{k}"] = place / f"session_{k}.mcap"
                truth[f"{sensor}_{k}"] = {"trajectory": f"{sensor}/session_{k}.tum"}
        if town.sweeps:
            drives = logs
            logs = {}
            for name, log in drives.items():
                cut = single_sweeps(log, home / "sweeps", name, town.sweeps)
                logs |= cut
                truth |= dict.fromkeys(cut, truth.pop(name))
        (home / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")
        return logs

    def query(self, town: Town) -> Workspace:
        """The town's workspace with the alignments of every session with every session."""
        work = Workspace(self.folder / town.name / "work")
        engine = make_engine("serial")
        logs = self.simulate(town)
        settings = load(assignments={"labels.source": town.labels}).resolved()
        fuse([SessionInput(name, (log,)) for name, log in logs.items()], work, settings, engine)
        describe(work, [], settings, engine)
        close(work, settings, engine)
        return work


def single_sweeps(log: Path, folder: Path, name: str, every: float) -> dict[str, Path]:
    """Logs by name of single sweeps of a drive, ``every`` so many metres: each with its poses."""
    folder.mkdir(exist_ok=True)
    track = np.loadtxt(log.with_suffix(".tum"))
    steps = np.linalg.norm(np.diff(track[:, 1:4], axis=0), axis=1)
    road = np.concatenate([[0.0], np.cumsum(steps)])
    wanted = np.interp(np.arange(every / 4, road[-1], every), road, track[:, 0])
    with log.open("rb") as stream:
        messages = list(make_reader(stream).iter_messages())
    times = np.array([m.log_time for s, _, m in messages if s and s.name == CLOUD])
    made = {}
    for number, second in enumerate(wanted):
        at = int(times[np.argmin(np.abs(times / 1e9 - second))])
        made[f"{name}_{number:02d}"] = path = folder / f"{name}_{number:02d}.mcap"
        with path.open("wb") as stream:
            writer = Writer(stream)
            writer.start(profile="ros2")
            channels: dict[int, int] = {}
            for schema, channel, message in messages:
                if schema and _belongs(schema.name, channel.topic, message.log_time - at):
                    if channel.id not in channels:
                        known = writer.register_schema(schema.name, schema.encoding, schema.data)
                        channels[channel.id] = writer.register_channel(
                            channel.topic, channel.message_encoding, known, channel.metadata
                        )
                    writer.add_message(
                        channels[channel.id],
                        message.log_time,
                        message.data,
                        message.publish_time,
                    )
            writer.finish()
    return made


def _belongs(kind: str, topic: str, later_ns: int) -> bool:
    """Whether a message, so much later than a sweep, belongs to the log of this sweep."""
    if topic in LATCHED:
        return True
    return later_ns == 0 if kind == CLOUD else abs(later_ns) < AROUND_NS


@dataclass(frozen=True, slots=True)
class TownTask:
    """One town to simulate, query and judge; picklable."""

    place: Place
    town: Town


def judged_table(task: TownTask) -> tuple[Path, float]:
    """DIR/TOWN/judged.parquet, made unless it is there, and the seconds that took."""
    start = time.perf_counter()
    table = task.place.folder / task.town.name / "judged.parquet"
    if not table.exists():
        work = task.place.query(task.town)
        judge_town(work, table.with_name("truth.json"), task.town.name, table)
    return table, time.perf_counter() - start


def collect(
    place: Place, towns: Sequence[Town], jobs: int, queries: float = math.inf
) -> list[Path]:
    """Tables of the towns that can be built, one town a process, until they have ``queries``.

    Existing tables are kept.
    """
    possible = [town for town in towns if place.has(town)]
    tables = []
    done = 0
    engine = make_engine("processes", jobs)
    print(f"{len(possible)} towns at most, {jobs} at a time", flush=True)
    for number, (table, seconds) in enumerate(
        engine.map(judged_table, [TownTask(place, town) for town in possible]), 1
    ):
        judged = read_judged([table])
        done += int(read_metadata(table)["queries"])
        tables.append(table)
        figures = (
            f"{len(judged)} alignments, {int(judged.right.sum())} right, {done} queries so far"
        )
        print(f"{number}: {table.parent.name}: {figures}, {seconds:.0f} s", flush=True)
        if done >= queries:
            break
    engine.stop()
    return tables

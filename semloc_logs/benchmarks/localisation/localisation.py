"""`semloc benchmark localisation`: whole localisation beside its peers, on the same keyframes of an
unseen simulated city.

Worlds, clouds and answers are kept in a folder, so that an interrupted run continues; other
weights, or another version of the code of a system, have answers of their own.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from semloc_logs.benchmarks.fused_sessions import fuse_sessions
from semloc_logs.benchmarks.localisation.city import (
    CONDITIONS,
    DATABASE,
    SENSORS,
    UNSEEN,
    WorldDrive,
    simulate_drive_log,
    world_drives,
)
from semloc_logs.benchmarks.localisation.judged_answers import UNITS, Answer, figures_of, read_world
from semloc_logs.benchmarks.localisation.our_method import (
    OURS,
    WHOLE,
    OurSystem,
    OurTask,
    link_workspace,
    settings_of,
    write_random,
)
from semloc_logs.benchmarks.localisation.peer_methods import PEERS, PeerSystem, PeerTask
from semloc_logs.benchmarks.peers.peer_process import runner
from semloc_logs.benchmarks.versions import code_version, files_version, simulation_version
from semloc_logs.engines import Engine, make_engine
from semloc_logs.errors import SettingsError
from semloc_logs.settings import Resolved
from semloc_logs.stages.describe import describe
from semloc_logs.tables.table import read_json, write_json
from semloc_logs.workspace import Workspace

Figures = dict[str, dict[str, float | str]]
Note = Callable[[str], None]
Task = OurTask | PeerTask
# packages that decide about fused maps
FUSION = ("labels", "mapping", "numerics", "settings", "voxels")
LOCALISATION = (*FUSION, "subvolumes", "words", "alignment", "closures")
TIMED = ("ours", "ours, one frame", "ours, every heading described")


@dataclass(frozen=True, slots=True)
class Unit:
    """The queries of one drive by one system; the answers are kept in ``path``."""

    task: Task
    path: Path

    @property
    def is_done(self) -> bool:
        return self.path.exists()


def run_unit(unit: Unit) -> str:
    """Run the queries and keep the answers; returns the name of the unit."""
    write_json(unit.path, {"answers": [a.to_json() for a in unit.task.answers()]})
    return f"{unit.task.drive.name}: {unit.task.system.name}"


def read_unit(unit: Unit) -> list[Answer]:
    """The answers of a unit that is done."""
    return [Answer(**row) for row in read_json(unit.path)["answers"]]


def profile_unit(unit: Unit) -> dict[str, float]:
    """Seconds a query of each part of ours."""
    return unit.task.profile() if isinstance(unit.task, OurTask) else {}


@dataclass(frozen=True)
class Localisation:
    """The benchmark in the folder ``work``, with ``queries`` for each condition, run by an engine.

    ``peers``: the Python of each runner.
    """

    work: Path
    queries: int
    peers: Mapping[str, str]
    settings: Resolved
    engine: Engine
    note: Note

    def figures(self) -> Figures:
        """Make everything that is missing; the figures of all. SettingsError for unknown peers."""
        unknown = set(self.peers) - {p.runner for p in PEERS}
        if unknown:
            known = ", ".join(sorted({p.runner for p in PEERS}))
            raise SettingsError(
                f"Unknown peer '{min(unknown)}' of localisation: give one of {known}."
            )
        for name in self.engine.map(simulate_drive_log, self.drives):
            self.note(f"{name} is simulated")
        self._map()
        units = self.units()
        for name in self.engine.map(run_unit, [u for u in units if not u.is_done]):
            self.note(f"{name} is measured")
        return self._summary(units)

    @cached_property
    def folder(self) -> Path:
        """Of this version of the simulation and of fusion."""
        return (
            self.work
            / f"localisation-{simulation_version()}-{self.settings.fingerprint('fusion')[:8]}"
        )

    @cached_property
    def drives(self) -> list[WorldDrive]:
        return world_drives(self.folder / "logs")

    def _map(self) -> None:
        """Fuse all drives for each source of labels, describe the database for each network."""
        for system in OURS:
            fused = self._fused(system)
            settings = settings_of(system, self.settings, self.folder / f"random-{our_version()}")
            sessions = {drive.name: [drive.log] for drive in self.drives}
            fuse_sessions(sessions, fused, settings, self.engine)
            write_random(fused, settings)
            work = self._workspace(system)
            link_workspace(fused, work)
            describe(work, [DATABASE], settings, self.engine)
            self.note(f"{system.name}: the database is described")

    def _workspace(self, system: OurSystem) -> Workspace:
        return Workspace(
            self.folder / f"described-{system.labels}-{system.weights}-{our_version()}"
        )

    def _fused(self, system: OurSystem) -> Workspace:
        return Workspace(self.folder / f"fused-{system.labels}-{code_version(FUSION)}")

    def units(self) -> list[Unit]:
        """Every system under every condition.

        All systems of one condition follow each other, so that their times compare.
        """
        reference = self._fused(OURS[0]).path
        units: list[Unit] = []
        for drive in self.drives[1:]:
            keyframes = tuple(read_world(reference, drive).keyframes(self.settings, self.queries))
            if keyframes:
                units += self._our_units(drive, keyframes)
                units += self._peer_units(drive, keyframes, reference)
        return units

    def _our_units(self, drive: WorldDrive, keyframes: tuple[int, ...]) -> Iterator[Unit]:
        version = our_version()
        for system in OURS:
            settings = settings_of(system, self.settings, self.folder / f"random-{version}")
            work = self._workspace(system).path
            yield self._unit(OurTask(work, drive, system, keyframes, settings), version)

    def _peer_units(
        self, drive: WorldDrive, keyframes: tuple[int, ...], work: Path
    ) -> Iterator[Unit]:
        for peer in PEERS:
            if peer.runner in self.peers and not (peer.told and drive.condition == UNSEEN):
                python = self.peers[peer.runner]
                task = PeerTask(work, self.folder, drive, peer, python, keyframes, self.settings)
                yield self._unit(task, files_version([runner(peer.runner)]))

    def _unit(self, task: Task, version: str) -> Unit:
        name = "".join(c if c.isalnum() else "-" for c in task.system.name)
        return Unit(
            task,
            self.folder / f"answers-{self.queries}" / f"{task.drive.name}-{name}-{version}.json",
        )

    def _summary(self, units: Sequence[Unit]) -> Figures:
        answers = {
            (u.task.drive.condition, u.task.drive.sensor, u.task.system.name): read_unit(u)
            for u in units
        }
        systems: list[OurSystem | PeerSystem] = [*OURS, *PEERS]
        figures: Figures = {}
        for sensor in SENSORS:
            for condition in (c for c in CONDITIONS if c != UNSEEN):
                for name in (system.name for system in systems):
                    unseen = answers.get((UNSEEN, sensor, name), [])
                    values = figures_of(answers.get((condition, sensor, name), []), unseen)
                    for figure, value in values.items():
                        row = figures.setdefault(
                            f"{condition}, {sensor}: {figure}",
                            {"unit": UNITS.get(figure, "share of queries")},
                        )
                        row[name] = value
        return figures | self._speed(units)

    def _speed(self, units: Sequence[Unit]) -> Figures:
        """Queries a second of ours with all cores at work, and the parts of a query's time."""
        figures: Figures = {}
        jobs = self.engine.jobs
        with_jobs = f"with {jobs} processes"
        for sensor in SENSORS:
            for system in (s for s in OURS if s.name in TIMED):
                of_system = [
                    u
                    for u in units
                    if u.task.system == system
                    and u.task.drive.sensor == sensor
                    and u.task.drive.condition != UNSEEN
                ]
                seconds = [a.seconds for u in of_system for a in read_unit(u)]
                if not seconds:
                    continue
                # as many processes as jobs, all at once
                profiles = list(self.engine.map(profile_unit, of_system[:1] * jobs))
                far_apart = len(seconds) / sum(seconds)
                along = jobs / sum(parts[WHOLE] for parts in profiles)
                rows = {
                    "queries far apart a second": (with_jobs, jobs * far_apart),
                    "queries along the road a second": (with_jobs, jobs * along),
                }
                for part in (p for p in profiles[0] if p != WHOLE):
                    taken = sum(parts[part] for parts in profiles) / jobs
                    rows[part] = "s a query along the road, under the profiler", taken
                for name, (unit, value) in rows.items():
                    figures.setdefault(f"{sensor}: {name}", {"unit": unit})[system.name] = value
        return figures


@contextmanager
def all_cores() -> Iterator[Engine]:
    """An engine with a process for each core."""
    engine = make_engine("processes")
    try:
        yield engine
    finally:
        engine.close()


def localisation_benchmark(
    work: Path | None, queries: int, peers: Mapping[str, str], settings: Resolved, note: Note
) -> Figures:
    """Whole localisation beside ``peers`` (runner -> Python), ``queries`` for each condition.

    On all cores; everything is kept in ``work``, if given.
    """
    with (
        tempfile.TemporaryDirectory(prefix="semloc-localisation-") as folder,
        all_cores() as engine,
    ):
        return Localisation(
            work or Path(folder), queries, peers, settings.resolved(), engine, note
        ).figures()


def our_version() -> str:
    """Of the code, weights and vocabularies of our localisation."""
    return code_version(LOCALISATION)

"""`semloc benchmark localisation`: whole localisation beside its peers, on the same keyframes of an
unseen simulated city.

Worlds, clouds and answers are kept in a folder, so that a run goes on where it was stopped; other
weights, or another version of what a system consists of, have answers of their own.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import semloc_logs
from semloc_logs.benchmarks.descriptors.held_out import simulation_version
from semloc_logs.benchmarks.localisation.answers import UNITS, Answer, figures_of, read_world
from semloc_logs.benchmarks.localisation.city import (
    CONDITIONS,
    DATABASE,
    SENSORS,
    UNSEEN,
    WorldDrive,
    simulate_drive_log,
    world_drives,
)
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
from semloc_logs.errors import SettingsError
from semloc_logs.settings import Resolved
from semloc_logs.tables.table import read_json, write_json
from semloc_logs.workspace import Workspace

Figures = dict[str, dict[str, float | str]]
Note = Callable[[str], None]
Task = OurTask | PeerTask
FUSION = ("labels", "voxels")
TIMED = ("ours", "ours, one frame", "ours, every heading described")


class Run(Protocol):
    """An engine's ``map`` and number of ``jobs``."""

    jobs: int

    def map(self, function: Callable[[Any], Any], tasks: Iterable[Any]) -> Iterator[Any]: ...


class Prepare(Protocol):
    """Fuses ``logs`` (session -> log) into a workspace, or describes its sessions ``names``."""

    def fuse(self, logs: Mapping[str, Path], work: Workspace, settings: Resolved) -> None: ...

    def describe(self, work: Workspace, names: Sequence[str], settings: Resolved) -> None: ...


@dataclass(frozen=True, slots=True)
class Unit:
    """What one system answers to one drive; the answers are kept in ``path``."""

    task: Task
    path: Path

    @property
    def is_done(self) -> bool:
        return self.path.exists()


def run_unit(unit: Unit) -> str:
    """Ask, and keep the answers; returns what was done."""
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
    """The benchmark in the folder ``work`` with ``queries`` for each condition, run by an engine;
    ``peers``: the Python of each runner.
    """

    work: Path
    queries: int
    peers: Mapping[str, str]
    settings: Resolved
    engine: Run
    prepare: Prepare
    note: Note

    def figures(self) -> Figures:
        """Everything that is missing is made; then the figures of all. SettingsError for unknown
        peers.
        """
        unknown = set(self.peers) - {p.runner for p in PEERS}
        if unknown:
            known = ", ".join(sorted({p.runner for p in PEERS}))
            raise SettingsError(
                f"There is no peer '{min(unknown)}' to localise with: there are {known}."
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
            self.prepare.fuse({d.name: d.log for d in self.drives}, fused, settings)
            write_random(fused, settings)
            work = self._workspace(system)
            link_workspace(fused, work)
            self.prepare.describe(work, [DATABASE], settings)
            self.note(f"{system.name}: the database is described")

    def _workspace(self, system: OurSystem) -> Workspace:
        return Workspace(
            self.folder / f"described-{system.labels}-{system.weights}-{our_version()}"
        )

    def _fused(self, system: OurSystem) -> Workspace:
        return Workspace(self.folder / f"fused-{system.labels}-{code_version(FUSION)}")

    def units(self) -> list[Unit]:
        """Every system under every condition; all systems of one condition after each other, so
        that times compare.
        """
        reference = self._fused(OURS[0]).path
        out = []
        for drive in self.drives[1:]:
            keyframes = tuple(read_world(reference, drive).keyframes(self.settings, self.queries))
            if not keyframes:
                continue
            for ours in OURS:
                settings = settings_of(ours, self.settings, self.folder / f"random-{our_version()}")
                task = OurTask(self._workspace(ours).path, drive, ours, keyframes, settings)
                out.append(self._unit(task, our_version()))
            for peer in PEERS:
                if peer.runner in self.peers and not (peer.told and drive.condition == UNSEEN):
                    python = self.peers[peer.runner]
                    out.append(
                        self._unit(
                            PeerTask(
                                reference,
                                self.folder,
                                drive,
                                peer,
                                python,
                                keyframes,
                                self.settings,
                            ),
                            _hash([runner(peer.runner)]),
                        )
                    )
        return out

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
            for condition in CONDITIONS:
                for system in systems:
                    elsewhere = answers.get((UNSEEN, sensor, system.name), [])
                    found = (
                        figures_of(answers.get((condition, sensor, system.name), []), elsewhere)
                        if condition != UNSEEN
                        else {}
                    )
                    for figure, value in found.items():
                        row = figures.setdefault(
                            f"{condition}, {sensor}: {figure}",
                            {"unit": UNITS.get(figure, "share of queries")},
                        )
                        row[system.name] = value
        return figures | self._speed(units)

    def _speed(self, units: Sequence[Unit]) -> Figures:
        """Queries a second of ours with all cores at work, and where the time of a query goes."""
        figures: Figures = {}

        def say(name: str, unit: str, system: str, value: float) -> None:
            figures.setdefault(name, {"unit": unit})[system] = value

        jobs = self.engine.jobs
        for sensor in SENSORS:
            for system in (s for s in OURS if s.name in TIMED):
                mine = [
                    u
                    for u in units
                    if u.task.system == system
                    and u.task.drive.sensor == sensor
                    and u.task.drive.condition != UNSEEN
                ]
                seconds = [a.seconds for u in mine for a in read_unit(u)]
                if not seconds:
                    continue
                said = list(self.engine.map(profile_unit, mine[:1] * jobs))  # all at once
                apart = len(seconds) / sum(seconds)
                along = jobs / sum(parts[WHOLE] for parts in said)
                say(
                    f"{sensor}: queries far apart a second",
                    f"with {jobs} processes",
                    system.name,
                    jobs * apart,
                )
                say(
                    f"{sensor}: queries along the road a second",
                    f"with {jobs} processes",
                    system.name,
                    jobs * along,
                )
                for part in (p for p in said[0] if p != WHOLE):
                    taken = sum(parts[part] for parts in said) / jobs
                    say(
                        f"{sensor}: {part}",
                        "s a query along the road, under the profiler",
                        system.name,
                        taken,
                    )
        return figures


def our_version() -> str:
    """Of what our localisation consists of: code, weights, vocabularies."""
    return code_version((*FUSION, "subvolumes", "words", "alignment", "closures"))


def code_version(packages: Sequence[str]) -> str:
    """A hash of the files of some of our packages."""
    folders = [Path(semloc_logs.__file__).parent / name for name in packages]
    return _hash(
        path
        for folder in folders
        for path in sorted(folder.rglob("*"))
        if path.suffix in (".py", ".json", ".safetensors")
    )


def _hash(paths: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]

"""The peers' localisation in the benchmark: the same keyframes as clouds, given to each peer in a
Python environment of its own.

A cloud holds the points of the keyframes within some length of road, in the level frame of its
middle one, x along the drive. The database has one every quarter of that length. Peers that
register pairs get their candidates from Scan Context, with its heading, and once more, as "NAME,
place told", the database's clouds that are truly nearest: the limit of a perfect retrieval.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.benchmarks.localisation.city import WorldDrive
from semloc_logs.benchmarks.localisation.judged_answers import Answer, World, read_world
from semloc_logs.benchmarks.peers.peer_process import run_peer
from semloc_logs.benchmarks.peers.scan_context import nearest_contexts, scan_context
from semloc_logs.closures.query import query_members
from semloc_logs.errors import SemlocError
from semloc_logs.mapping.selection import thin
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply, inverse
from semloc_logs.settings import Resolved
from semloc_logs.tables.atomic_files import replacing_file
from semloc_logs.voxels.store import read_keyframe

SECONDS = 3600.0
CELL = 0.2  # m: points of a cloud are thinned to it
CANDIDATES, TOLD = 5, 3
ANSWER_SHOWN = 200  # characters of a malformed answer


@dataclass(frozen=True, slots=True)
class PeerSystem:
    """A peer: the script ``runner``, metres of road in a cloud, whether it looks for the place
    itself or is ``told``.
    """

    name: str
    runner: str
    length: float = 20.0
    needs_candidates: bool = True
    told: bool = False


PEERS = (
    PeerSystem("Scan Context + GICP", "scan_context"),
    PeerSystem("FPFH + RANSAC", "fpfh_ransac"),
    PeerSystem("FPFH + RANSAC, place told", "fpfh_ransac", told=True),
    PeerSystem("KISS-Matcher", "kiss_matcher"),
    PeerSystem("KISS-Matcher, place told", "kiss_matcher", told=True),
    PeerSystem("MapClosures, 20 m", "map_closures", needs_candidates=False),
    PeerSystem("MapClosures, 100 m", "map_closures", 100.0, needs_candidates=False),
)


@dataclass(frozen=True, slots=True)
class PeerTask:
    """Queries of one drive by one peer of ``python``; clouds are kept in ``folder``; picklable."""

    work: Path
    folder: Path
    drive: WorldDrive
    system: PeerSystem
    python: str
    keyframes: tuple[int, ...]
    settings: Resolved

    def answers(self) -> list[Answer]:
        """One for each keyframe. SemlocError when the peer fails or its answer is malformed."""
        world = read_world(self.work, self.drive)
        folder = self.folder / f"clouds-{self.system.length:g}"
        centres = database_keyframes(world.database, self.system.length / 4)
        write_clouds(folder, world.database, centres, self.system.length, self.settings)
        write_clouds(folder, world.query, self.keyframes, self.system.length, self.settings)
        candidates, seconds = self._candidates(world, folder, centres)
        queries = [
            {"cloud": _cloud_name(world.query, k), "candidates": rows}
            for k, rows in zip(self.keyframes, candidates, strict=True)
        ]
        job = {
            "folder": str(folder.absolute()),
            "database": [_cloud_name(world.database, k) for k in centres],
            "queries": queries,
        }
        path = (
            folder
            / f"{self.system.runner}-{self.drive.name}{'-told' if self.system.told else ''}.json"
        )
        path.write_text(json.dumps(job))
        output = run_peer(self.system.runner, self.python, [str(path)], SECONDS)
        try:
            rows = json.loads(output.splitlines()[-1])["queries"]
            return [
                self._answer(world, centres, k, f, s)
                for k, f, s in zip(self.keyframes, rows, seconds, strict=True)
            ]
        except (ValueError, KeyError, IndexError, TypeError) as problem:
            raise SemlocError(
                f"Peer {self.system.runner} answered {output[-ANSWER_SHOWN:]!r} ({problem}): "
                "see benchmarks/README.md."
            ) from None

    def _candidates(
        self, world: World, folder: Path, centres: Sequence[int]
    ) -> tuple[list[list[tuple[int, float]]], list[float]]:
        """For each query numbers of the database's clouds and headings, and the seconds that
        finding them took.
        """
        if not self.system.needs_candidates:
            return [[] for _ in self.keyframes], [0.0] * len(self.keyframes)
        if self.system.told:
            order = [
                [
                    centres.index(min(centres, key=lambda c: abs(c - place)))
                    for place in self._near(world, k)
                ]
                for k in self.keyframes
            ]
            return [[(k, 0.0) for k in dict.fromkeys(row)][:TOLD] for row in order], [0.0] * len(
                self.keyframes
            )
        database = [scan_context(_load(folder, world.database, k)) for k in centres]
        nearest_contexts(database[0], database, CANDIDATES)
        out = []
        seconds = []
        for k in self.keyframes:
            cloud = _load(folder, world.query, k)
            begin = time.perf_counter()
            out.append(nearest_contexts(scan_context(cloud), database, CANDIDATES))
            seconds.append(time.perf_counter() - begin)
        return out, seconds

    def _near(self, world: World, keyframe: int) -> list[int]:
        return world.nearest(keyframe, 6 * TOLD)

    def _answer(
        self,
        world: World,
        centres: Sequence[int],
        keyframe: int,
        answer: dict[str, Any],
        extra: float,
    ) -> Answer:
        seconds = float(answer["seconds"]) + extra
        if not answer["found"]:
            return Answer(keyframe, seconds)
        number, score, pose = answer["found"][0]
        map_T_cloud = cloud_frame(world.database, centres[number]) @ np.array(pose, float).reshape(
            4, 4
        )
        query_T_base = (
            inverse(cloud_frame(world.query, keyframe)) @ world.query.map_T_base[keyframe]
        )
        return Answer(
            keyframe, seconds, float(score), *world.errors(keyframe, map_T_cloud @ query_T_base)
        )


def database_keyframes(session: SessionMap, every: float) -> list[int]:
    """The first keyframe in each ``every`` metres of road."""
    return [int(k) for k in np.unique(np.floor(session.distance / every), return_index=True)[1]]


def cloud_frame(session: SessionMap, keyframe: int) -> F64:
    """``map_T_cloud`` (4, 4): at the keyframe's base, z up, x along its heading."""
    pose = session.map_T_base[keyframe]
    out: F64 = np.eye(4)
    heading = np.arctan2(pose[1, 0], pose[0, 0])
    out[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
    out[:3, 3] = pose[:3, 3]
    return out


def write_clouds(
    folder: Path, session: SessionMap, keyframes: Sequence[int], length: float, settings: Resolved
) -> None:
    """The clouds about ``keyframes`` as NAME.npy, (n, 3) float32, where they are missing."""
    folder.mkdir(parents=True, exist_ok=True)
    stretch = settings.model_copy(
        update={"query": settings.query.model_copy(update={"length": length})}
    )
    for keyframe in keyframes:
        path = folder / f"{_cloud_name(session, keyframe)}.npy"
        if path.exists():
            continue
        cloud_T_map = inverse(cloud_frame(session, keyframe))
        parts = [
            apply(
                cloud_T_map @ session.map_T_base[i],
                read_keyframe(session.folder.keyframes, i).points,
            )
            for i in query_members(session, keyframe, stretch)
        ]
        with replacing_file(path) as temporary, temporary.open("wb") as file:
            points = np.concatenate(parts).astype(np.float32)
            np.save(file, points[thin(points, CELL)])


def _cloud_name(session: SessionMap, keyframe: int) -> str:
    return f"{session.folder.name}-{keyframe:05d}"


def _load(folder: Path, session: SessionMap, keyframe: int) -> NDArray[np.float32]:
    cloud: NDArray[np.float32] = np.load(folder / f"{_cloud_name(session, keyframe)}.npy")
    return cloud

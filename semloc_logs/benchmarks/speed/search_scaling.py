"""How the look-up of words grows with the map: its time, what it finds, memory and files, and the
time to add and to remove a session.

The first session holds words of held-out simulated streets, mapped by a LIDAR in summer; words of
drives along them in snow ask. Further sessions are as long and stand for other places. Their words
are drawn from 100,000 descriptors of the streets, each moved by a difference of two others as far
as the median descriptor lies from the nearest one of another street, and encoded; of a drawn code
each bit is turned with a chance of 1/16, so that no two are the same. They go the way of all
sessions: tables of words, segments of the index. A query *finds* its place when one of its five
nearest words lies in the first session within the radius of the retrieval benchmark. Times are of
one process: a query's of the processor, the others by the clock.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semloc_logs.arrays import F32, F64
from semloc_logs.benchmarks.descriptors.held_out import HeldOut, Size, held_out
from semloc_logs.benchmarks.descriptors.recall import (
    Describe,
    count_subvolumes,
    network_describes,
    true_radius,
)
from semloc_logs.benchmarks.speed.search_speed import timed
from semloc_logs.errors import SettingsError
from semloc_logs.numerics.transforms import apply
from semloc_logs.settings import Resolved
from semloc_logs.subvolumes.describe import load_encoder
from semloc_logs.tables.table import write_json
from semloc_logs.voxels.store import blocks_path
from semloc_logs.words.index import Allowed, Index, Part
from semloc_logs.words.segment_catalogue import segments
from semloc_logs.words.submap_words import write_words
from semloc_logs.words.vocabulary import Vocabulary, load_vocabulary
from semloc_logs.workspace import Workspace

Figures = dict[str, dict[str, float | str]]
LENGTHS = (10, 100, 1000)  # km
SESSION = 10  # km
WORDS_A_KM = 50_000
POOL = 100_000
DATABASE = 50_000  # words of the streets
QUERIES = 1600  # look-ups of one query


@dataclass(frozen=True, slots=True, eq=False)
class Streets:
    """Words of streets and query words: ``centre`` (n, 3) and ``query_centre`` (m, 3), metres in
    a common frame, descriptors (n, N) and (m, N), the number of each word's ``street`` (n,); a word
    within ``radius`` metres is the true one.
    """

    centre: F64
    descriptor: F32
    street: NDArray[np.integer]
    query_centre: F64
    query: F32
    radius: float

    def queries(self) -> Streets:
        """These streets with those words alone that have a true one, at most :data:`QUERIES`."""
        possible = np.flatnonzero(cKDTree(self.centre).query(self.query_centre)[0] < self.radius)
        if not len(possible):
            raise SettingsError("None of the query words has a true one among the streets' words.")
        chosen = np.sort(np.random.default_rng(1).permutation(possible)[:QUERIES])
        return Streets(
            self.centre,
            self.descriptor,
            self.street,
            self.query_centre[chosen],
            self.query[chosen],
            self.radius,
        )

    def apart(self) -> float:
        """Median distance of a descriptor to the nearest one of another street."""
        some = np.random.default_rng(2).permutation(len(self.street))[:500]
        similarity = self.descriptor[some] @ self.descriptor.T
        similarity[self.street[some, None] == self.street] = -1.0
        return float(np.median(np.sqrt(np.maximum(2 - 2 * similarity.max(1), 0.0))))

    def moved(self, n: int) -> F32:
        """Descriptors (n, N) of other places."""
        rng = np.random.default_rng(3)
        one, first, second = (
            self.descriptor[rng.integers(0, len(self.descriptor), n)] for _ in range(3)
        )
        step = first - second
        moved = one + step * (
            self.apart() / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
        )
        return np.asarray(moved / np.linalg.norm(moved, axis=1, keepdims=True), np.float32)


class _World:
    """A workspace of sessions that have words and nothing else."""

    def __init__(
        self, folder: Path, streets: Streets, vocabulary: Vocabulary, variant: str, words: int
    ) -> None:
        self.work = Workspace(folder)
        self.streets = streets
        self.vocabulary = vocabulary
        self.variant = variant
        self.words = words
        self._other = vocabulary.words(streets.moved(POOL))
        self._first = vocabulary.words(streets.descriptor)
        self.names: list[str] = []

    def describe(self) -> None:
        """One session more."""
        number = len(self.names)
        place = self.streets.centre
        folder = self.work.session(f"session-{number:04d}")
        rng = np.random.default_rng([4, number])
        rows = rng.integers(0, POOL, self.words if number else max(0, self.words - len(place)))
        turned = np.bitwise_and.reduce(rng.integers(0, 2**64, (4, len(rows)), np.uint64))
        word = self._other[0][rows]
        code = self._other[1][rows] ^ turned
        centre = np.full((len(rows), 3), 1e6)
        if not number:  # the streets, filled up
            word = np.r_[self._first[0], word]
            code = np.r_[self._first[1], code]
            centre = np.r_[place, centre]
        write_words(blocks_path(folder.words, 0), 0, [(self.variant, 0.0, centre, word, code)], {})
        write_json(folder.session_json, {"submaps": [{"id": 0}]})
        write_json(folder.words_json, {"variants": [self.variant], "fingerprint": str(number)})
        self.names.append(folder.name)

    def forget(self) -> None:
        """The last session is removed."""
        shutil.rmtree(self.work.session(self.names.pop()).path)

    def index(self) -> Index:
        numbers = {(name, 0): g for g, name in enumerate(self.names)}
        parts = [
            Part(segment, segment.numbered(numbers, served))
            for segment, served in segments(self.work, self.variant, self.names)
        ]
        return Index(self.vocabulary, parts)

    def found(self, index: Index, probes: int) -> float:
        """Share of the words that ask whose place is among their five nearest."""
        s = self.streets
        m = index.search(s.query, 5, probes, Allowed(np.ones(len(self.names), bool)))
        is_right = (m.group == 0) & (
            np.linalg.norm(m.centre - s.query_centre[m.query], axis=1) < s.radius
        )
        return len(np.unique(m.query[is_right])) / len(s.query)


def scaling_benchmark(
    settings: Resolved, work: Path | None, note: Callable[[str], None]
) -> Figures:
    """Figures of :func:`search_scaling` on simulated streets, kept in the folder ``work`` where one
    is given.
    """
    variant = "semantic"
    describe = network_describes(load_encoder(variant, settings.descriptor.weights), settings)
    with ExitStack() as stack:
        folder = work or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="semloc-")))
        streets = described(
            held_out(
                folder / "streets", settings, count_subvolumes(settings), Size(DATABASE), note
            ),
            describe,
        )
    return search_scaling(
        settings, streets, load_vocabulary(variant, settings.descriptor.vocabulary), note=note
    )


def described(world: HeldOut, describe: Describe) -> Streets:
    """The words of the LIDAR's maps, and of its last query of each street in snow."""
    parts: dict[str, list[NDArray[Any]]] = {
        name: [] for name in ("centre", "descriptor", "street", "query_centre", "query")
    }
    for number, s in enumerate(world.streets()):
        places = [(place, False) for kind, place in s.database if kind == "lidar"] + [
            (place, True) for place in s.queries["season"][-1:]
        ]
        for place, is_query in places:
            words = describe(place, is_query)
            points = apply(
                place.common_T_map,
                words.centre.astype(np.float64) * world.settings.fusion.voxel_size,
            )
            parts["query_centre" if is_query else "centre"].append(points)
            parts["query" if is_query else "descriptor"].append(words.descriptor)
            parts["street"].append(np.full(0 if is_query else len(points), number))
    joined: dict[str, Any] = {name: np.concatenate(arrays) for name, arrays in parts.items()}
    return Streets(radius=true_radius(world.settings), **joined)


def search_scaling(
    settings: Resolved,
    streets: Streets,
    vocabulary: Vocabulary,
    lengths: Sequence[int] = LENGTHS,
    words_a_km: int = WORDS_A_KM,
    note: Callable[[str], None] = lambda _: None,
) -> Figures:
    """Figures of maps of ``lengths`` kilometres, multiples of 10, rising, and the exponents of
    growth between the first and the last.

    The index is made in the folder for temporary files: about 32 bytes a word, and the words
    themselves.
    """
    figures: Figures = {}
    streets = streets.queries()
    with tempfile.TemporaryDirectory(prefix="semloc-") as folder:
        world = _World(Path(folder), streets, vocabulary, "semantic", SESSION * words_a_km)
        taken = []
        for length in lengths:
            while SESSION * (len(world.names) + 1) < length:
                world.describe()
                note(f"{SESSION * len(world.names)} of {max(lengths)} km")
            if world.names:
                world.index()
            world.describe()
            adding, index = _timed(world.index)
            opening, index = _timed(world.index)
            least, median = timed(partial(world.found, index, settings.closures.probes))
            share = world.found(index, settings.closures.probes)
            taken.append(least)
            rows = {
                "segments": len(index.parts),
                "bytes": sum(p.stat().st_size for p in Path(folder).glob("index/*/*.segment")),
            }
            world.forget()
            removing, _ = _timed(world.index)
            world.describe()
            returning, _ = _timed(world.index)
            figures |= _shown(length, len(index), (least, median, share), rows)
            figures[f"{length} km: a session added"] = {
                "ours": adding,
                "unit": "s",
                "again": returning,
            }
            figures[f"{length} km: a session removed"] = {"ours": removing, "unit": "s"}
            figures[f"{length} km: index opened"] = {"ours": opening, "unit": "s"}
            del index
    growth = (
        np.log(taken[-1] / taken[0]) / np.log(lengths[-1] / lengths[0]) if len(lengths) > 1 else 0.0
    )
    figures["exponent of the time of a look-up"] = {
        "ours": float(growth),
        "unit": f"{lengths[0]} to {lengths[-1]} km; 0.5 is a square root",
    }
    return figures


def _shown(
    length: int, words: int, search: tuple[float, float, float], files: dict[str, int]
) -> Figures:
    least, median, share = search
    return {
        f"{length} km: a query": {
            "ours": least,
            "unit": f"processor ms, {QUERIES} look-ups",
            "median": median,
            "words": words,
            "found": share,
        },
        f"{length} km: files": {
            "ours": files["bytes"] / 1e6,
            "unit": "MB",
            "segments": files["segments"],
        },
        f"{length} km: memory": {
            "ours": _private_bytes() / 1e6,
            "unit": "MB of the process beside the files",
        },
    }


def _timed(action: Callable[[], Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    result = action()
    return time.perf_counter() - start, result


def _private_bytes() -> int:
    """Memory of this process without the files that it maps."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return 1024 * int(line.split()[1])
    return 0

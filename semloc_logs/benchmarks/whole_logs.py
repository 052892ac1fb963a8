"""Figures of whole logs: where the time of `semloc run` and `semloc fuse` goes, how memory grows,
and what the words are worth.
"""

from __future__ import annotations

import cProfile
import pstats
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from unittest.mock import patch

import numpy as np

from semloc_logs.benchmarks.descriptors.places import Street
from semloc_logs.benchmarks.descriptors.word_matches import real_street, true_queries, word_recall
from semloc_logs.benchmarks.localisation.localisation import Localisation
from semloc_logs.closures.query import SessionMap
from semloc_logs.engines import Engine, make_engine
from semloc_logs.errors import SemlocError
from semloc_logs.evaluation.truth import read_truth
from semloc_logs.logs.session.session import SessionOptions, open_session
from semloc_logs.settings import Resolved
from semloc_logs.stages.pipeline import describe, fuse, run, session_name
from semloc_logs.subvolumes.describe import load_encoder, random_encoder
from semloc_logs.subvolumes.network import Encoder
from semloc_logs.tables.table import read_metadata
from semloc_logs.voxels.grid import Fuser
from semloc_logs.voxels.store import read_keyframe
from semloc_logs.words.vocabulary import Vocabulary, load_vocabulary
from semloc_logs.workspace import Workspace

Figures = dict[str, dict[str, float | str]]
Rows = list[tuple[float, int, str]]

# parts of fusing: the functions whose time they are, and the one whose time within them is not
# theirs
_PARTS: dict[str, tuple[tuple[str, ...], str]] = {
    "fingerprint": (("annotate.py content_fingerprint",), ""),
    "read": (("session.py clouds",), ""),
    "thin": (("selection.py thin",), ""),
    "scratch files": (("keyframes.py _save", "keyframes.py load"), ""),
    "direction of gravity": (("levelling.py level",), ""),
    "ground": (
        (
            "gravity.py ground_height",
            "surface.py ground_surface",
            "ground.py add",
            "ground.py finish",
        ),
        "",
    ),
    "labels": (("labeller.py labels", "labeller.py take"), ""),
    "keyframes written": (("store.py keep_keyframes",), "fusing.py _labelled"),
    "integrate": (("grid.py take", "carve.py marks"), ""),
    "finish of maps": (("grid.py finish",), ""),
    "blocks written": (("store.py write_blocks",), ""),
    "voxel merge": (("store.py write_voxels",), "fusing.py _kept_submaps"),
    "picture": (("picture.py draw_map",), ""),
}


def profile_pipeline(
    logs: Sequence[Path], settings: Resolved, functions: int = 12
) -> tuple[Figures, Rows]:
    """Run the pipeline on ``logs`` in this process in a fresh workspace.

    Returns the figures (seconds of each stage, seconds a query, peak resident memory in MB) and,
    for the ``functions`` that took most time themselves, seconds, calls and where they are. The
    profiler adds some percent to code that calls many small functions.
    """
    with tempfile.TemporaryDirectory(prefix="semloc-profile-") as folder:
        work = Workspace(Path(folder))
        profiler = cProfile.Profile()
        report = profiler.runcall(
            run,
            {session_name(log): [log] for log in logs},
            work,
            settings,
            {},
            make_engine("serial"),
            lambda _: None,
        )
        queries = int(read_metadata(work.closures)["queries"])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (
        1024 if sys.platform.startswith("linux") else 1024**2
    )
    figures: Figures = {
        f"{stage}": {"ours": seconds, "unit": "s"} for stage, seconds in report.seconds.items()
    }
    figures["query"] = {"ours": report.seconds["close"] / max(queries, 1), "unit": "s a query"}
    figures["memory"] = {"ours": round(peak, 1), "unit": "MB peak"}
    figures["closures"] = {"ours": float(report.closures), "unit": ""}
    return figures, _busiest(_stats(profiler), functions)


def profile_fuse(
    logs: Sequence[Path], settings: Resolved, rounds: int = 3, functions: int = 12
) -> tuple[Figures, Rows]:
    """`semloc fuse` of ``logs`` (one session) beside what it cannot do without: reading all clouds,
    and integrating all keyframes once.

    ``rounds`` times in turn each: wall-clock seconds, median and least, and processor seconds,
    median. ``ratio`` is whole / (reading + integrating). The parts come from one more run, in one
    thread and under the profiler, which adds some percent, as do the returned ``functions``, those
    that took most time themselves.
    """
    fusion = settings.fusion
    times: dict[str, list[tuple[float, float]]] = {"whole": [], "reading": [], "integrating": []}

    def whole(folder: Path, profiler: cProfile.Profile | None = None) -> Workspace:
        work = Workspace(folder)
        with profiler or nullcontext():
            fuse({"session": logs}, work, settings, {}, make_engine("serial"), lambda _: None)
        return work

    def reading() -> int:
        options = SessionOptions(min_range=fusion.min_range, max_range=2.0 * fusion.max_range)
        session = open_session([*logs], options)
        try:
            return sum(1 for _ in session.clouds())
        finally:
            session.close()

    clouds = reading()  # to warm up
    for _ in range(rounds):
        with tempfile.TemporaryDirectory(prefix="semloc-fuse-") as folder:
            start = _clocks()
            work = whole(Path(folder))
            times["whole"].append(_since(start))
            start = _clocks()
            reading()
            times["reading"].append(_since(start))
            times["integrating"].append(_integrating(SessionMap(work.session("session")), settings))
            keyframes = len(SessionMap(work.session("session")).map_T_base)
    profiler = cProfile.Profile()
    with (
        tempfile.TemporaryDirectory(prefix="semloc-fuse-") as folder,
        # the profiler sees one thread
        patch("semloc_logs.mapping.session_fusion.ahead", lambda items, depth=2: items),
        patch("semloc_logs.mapping.keyframes.ahead", lambda items, depth=2: items),
    ):
        whole(Path(folder), profiler)
    stats = _stats(profiler)
    value = {
        name: {
            "ours": float(np.median([wall for wall, _ in taken])),
            "least": min(wall for wall, _ in taken),
            "cpu": float(np.median([processor for _, processor in taken])),
        }
        for name, taken in times.items()
    }
    figures: Figures = {name: {**seconds, "unit": "s"} for name, seconds in value.items()}
    ratio = {
        kind: value["whole"][kind] / (value["reading"][kind] + value["integrating"][kind])
        for kind in value["whole"]
    }
    figures["ratio"] = {**ratio, "unit": "whole / (reading + integrating)"}
    figures["clouds"] = {"ours": float(clouds), "unit": ""}
    figures["keyframes"] = {"ours": float(keyframes), "unit": ""}
    parts = _parts(stats)
    figures |= {
        f"part: {part}": {"ours": seconds, "unit": "s, under the profiler"}
        for part, seconds in parts.items()
    }
    return figures, _busiest(stats, functions)


def _clocks() -> tuple[float, float]:
    return time.perf_counter(), time.process_time()


def _since(start: tuple[float, float]) -> tuple[float, float]:
    """Seconds of the wall clock and of the processor."""
    wall, processor = _clocks()
    return wall - start[0], processor - start[1]


def _integrating(session: SessionMap, settings: Resolved) -> tuple[float, float]:
    """Seconds (wall clock, processor) of Fuser.add for every keyframe once, a new map every submap
    length of road.
    """
    length = settings.fusion.submap_length
    taken = np.zeros(2)
    begun = np.floor(np.asarray(session.frames["distance"].to_numpy()) / length)
    fuser = Fuser(settings.fusion)
    for k, pose in enumerate(session.map_T_base):
        if k and begun[k] != begun[k - 1]:
            fuser = Fuser(settings.fusion)
        frame = read_keyframe(session.folder.keyframes, k)
        origin = np.array([session.frames[f"origin_{c}"][k].as_py() for c in "xyz"])
        start = _clocks()
        fuser.add(frame.points, frame.label, origin, frame.sigma, pose)
        taken += _since(start)
    return float(taken[0]), float(taken[1])


def _stats(
    profiler: cProfile.Profile,
) -> dict[tuple[str, int, str], tuple[int, int, float, float, object]]:
    return pstats.Stats(profiler).stats  # type: ignore[attr-defined,no-any-return]


def _busiest(
    stats: dict[tuple[str, int, str], tuple[int, int, float, float, object]], functions: int
) -> Rows:
    """Own seconds, calls and place of the functions that took most time themselves."""
    return sorted(
        ((own, calls, _place(where)) for where, (_, calls, own, _, _) in stats.items()),
        reverse=True,
    )[:functions]


def _parts(
    stats: dict[tuple[str, int, str], tuple[int, int, float, float, object]],
) -> dict[str, float]:
    """Seconds of the parts of fusing; ``rest`` is what no part names."""
    total: dict[str, float] = {}
    for (path, _, name), (_, _, _, cumulative, _) in stats.items():
        key = f"{Path(path).name} {name}"
        total[key] = total.get(key, 0.0) + cumulative
    parts = {}
    for part, (functions, without) in _PARTS.items():
        if any(f in total for f in functions):
            parts[part] = sum(total.get(f, 0.0) for f in functions) - total.get(without, 0.0)
    # thinning for gravity counts twice
    parts["rest"] = max(0.0, total.get("stages.py fuse", 0.0) - sum(parts.values()))
    return parts


def memory_curve(lengths: Sequence[int], settings: Resolved) -> Figures:
    """Peak resident memory of `semloc fuse`, in a process of its own, for a drive of 250 m and its
    multiples ``lengths``.

    The road goes on (new places), or is driven there and back (the same places again). SemlocError
    when fusing fails.
    """
    from semloc_logs.simulation.output.long_drive import LAP_M, Lap

    figures: Figures = {}
    lap = Lap()
    with tempfile.TemporaryDirectory(prefix="semloc-memory-") as folder:
        (Path(folder) / "settings.yaml").write_text(settings.dump())
        for onwards in (True, False):
            for laps in lengths:
                log = Path(folder) / "drive.mcap"
                sweeps = lap.write(log, laps, onwards=onwards)
                command = [
                    "fuse",
                    str(log),
                    "-w",
                    str(Path(folder) / "work"),
                    "--config",
                    str(Path(folder) / "settings.yaml"),
                    "-q",
                ]
                start = time.perf_counter()
                peak = peak_memory([*command, "--overwrite"])
                figures[f"{laps}x, {'new places' if onwards else 'the same again'}"] = {
                    "ours": round(peak, 1),
                    "unit": f"MB peak, {laps * LAP_M:.0f} m",
                    "sweeps": float(sweeps),
                    "seconds": round(time.perf_counter() - start, 1),
                }
    return figures


# a process inherits the peak of the one that forks it: a small one stands between
_LAUNCH = """
import resource, subprocess, sys
code = subprocess.call([sys.executable, "-c", "from semloc_logs.cli.main import main; main()", *sys.argv[1:]])
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
sys.exit(code)
"""


def peak_memory(arguments: Sequence[str]) -> float:
    """Peak resident memory (MB) of `semloc` with ``arguments``. SemlocError when it fails."""
    done = subprocess.run(
        [sys.executable, "-c", _LAUNCH, *arguments], capture_output=True, text=True, check=False
    )
    if done.returncode not in (0, 3):
        raise SemlocError(f"semloc {' '.join(arguments)} failed: {done.stderr.strip()}")
    return int(done.stdout.split()[-1]) / (1024 if sys.platform.startswith("linux") else 1024**2)


def _place(where: tuple[str, int, str]) -> str:
    path, line, name = where
    return name if line == 0 else f"{'/'.join(Path(path).parts[-2:])}:{line} {name}"


def word_recalls(logs: Sequence[Path], truth: Path, settings: Resolved) -> Figures:
    """Recall at 5 of word matches within 1.5 m between two logs whose true alignment is known:
    trained weights beside random ones.

    Every query of the second log is put to the map of the first one, in the search's heading
    nearest to the true one; queries farther than 10 m from the first log's road do not count.
    ``random`` is the mean over three seeds, with a vocabulary of their own.
    """
    with tempfile.TemporaryDirectory(prefix="semloc-words-") as folder:
        work = Workspace(Path(folder))
        sessions = {session_name(log): [log] for log in logs}
        fuse(sessions, work, settings, {}, make_engine("serial"), lambda _: None)
        maps = {name: SessionMap(work.session(name)) for name in sessions}
        target, query = maps.values()
        tracks = read_truth(truth, maps)
        pairs = true_queries(query, target, tracks, settings)
        figures: Figures = {}
        for variant in ("semantic", "geometric"):
            trained = (
                load_encoder(variant, settings.descriptor.weights),
                load_vocabulary(variant, settings.descriptor.vocabulary),
            )
            random: list[tuple[Encoder, Vocabulary | None]] = [
                (random_encoder(variant, seed), None) for seed in range(3)
            ]
            rows: dict[str, list[tuple[Encoder, Vocabulary | None]]] = {
                "ours": [trained],
                "random weights": random,
            }
            found = {
                who: [
                    word_recall(query, k, target, T, settings, e, words)
                    for e, words in networks
                    for k, T in pairs
                ]
                for who, networks in rows.items()
            }
            for how in ("exact", "coded"):
                row: dict[str, float | str] = {
                    who: float(np.mean([getattr(r, how) for r in rs]))
                    for who, rs in found.items()
                    if rs
                }
                figures[
                    f"{variant}, {'by descriptor' if how == 'exact' else 'by word and code'}"
                ] = row | {"unit": "recall at 5"}
        return figures


def real_streets(logs: Sequence[Path], truth: Path, settings: Resolved) -> dict[str, Street]:
    """For `semloc benchmark retrieval`: what the first log's queries and the second one's map are,
    with the log's labels and with those from geometry, by the names of
    :data:`semloc_logs.benchmarks.descriptors.retrieval.REAL`.
    """
    out: dict[str, Street] = {}
    for source, names in (
        ("auto", ("real_log", "real_geometric")),
        ("geometry", ("real_geometry_labels",)),
    ):
        labelled = settings.model_copy(
            update={"labels": settings.labels.model_copy(update={"source": source})}
        )
        with tempfile.TemporaryDirectory(prefix="semloc-real-") as folder:
            work = Workspace(Path(folder))
            sessions = {session_name(log): [log] for log in logs}
            fuse(sessions, work, labelled, {}, make_engine("serial"), lambda _: None)
            maps = {name: SessionMap(work.session(name)) for name in sessions}
            query, target = maps.values()
            tracks = read_truth(truth, maps)
            out |= {name: real_street(query, target, tracks, name, labelled) for name in names}
    return out


class _Prepare:
    """The stages as the localisation benchmark needs them."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    def fuse(self, logs: Mapping[str, Path], work: Workspace, settings: Resolved) -> None:
        fuse(
            {name: [log] for name, log in logs.items()},
            work,
            settings,
            {},
            self._engine,
            lambda _: None,
        )

    def describe(self, work: Workspace, names: Sequence[str], settings: Resolved) -> None:
        describe(work, names, settings, self._engine, lambda _: None)


def localisation(
    work: Path | None,
    queries: int,
    peers: Mapping[str, str],
    settings: Resolved,
    note: Callable[[str], None],
) -> Figures:
    """Whole localisation beside ``peers`` (runner -> Python), ``queries`` for each condition, on
    all cores; kept in ``work``.
    """
    engine = make_engine("processes")
    with tempfile.TemporaryDirectory(prefix="semloc-localisation-") as folder:
        try:
            return Localisation(
                work or Path(folder),
                queries,
                peers,
                settings.resolved(),
                engine,
                _Prepare(engine),
                note,
            ).figures()
        finally:
            engine.close()

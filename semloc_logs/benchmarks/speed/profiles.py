"""`semloc benchmark pipeline` and `fuse`: where the time of whole logs goes."""

from __future__ import annotations

import cProfile
import resource
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semloc_logs.benchmarks.fused_sessions import fuse_sessions
from semloc_logs.benchmarks.spans import FunctionTimes, Rows, Span, span_seconds
from semloc_logs.benchmarks.speed.fusion_memory import PEAKS_PER_MB
from semloc_logs.engines import make_engine
from semloc_logs.labels.recorded_labels import RecordedLabels
from semloc_logs.labels.sweep_ground import ground_surface
from semloc_logs.logs.annotation.annotate import content_fingerprint
from semloc_logs.logs.session.session import Session, SessionOptions, open_session
from semloc_logs.mapping import map_tables
from semloc_logs.mapping.fit.fit_check import check_session
from semloc_logs.mapping.ground import GroundMapper, ground_height
from semloc_logs.mapping.keyframes import Collected
from semloc_logs.mapping.levelling import level
from semloc_logs.mapping.selection import thin
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics import prefetch
from semloc_logs.pictures.map_picture import draw_map
from semloc_logs.settings import Resolved
from semloc_logs.stages.fuse import fuse
from semloc_logs.stages.inputs import SessionInput, session_name
from semloc_logs.stages.run import run
from semloc_logs.tables.table import read_metadata
from semloc_logs.voxels.carve import Carver
from semloc_logs.voxels.grid import Fuser
from semloc_logs.voxels.store import keep_keyframes, read_keyframe, write_blocks, write_voxels
from semloc_logs.workspace import Workspace

Figures = dict[str, dict[str, float | str]]
BUSIEST = 12  # functions that are shown
SPANS = (  # of fusing
    Span("fingerprint", (content_fingerprint,)),
    Span("read", (Session.clouds,)),
    Span("thin", (thin,)),  # the thinning for gravity is in its direction, too
    Span("scratch files", (Collected.add, Collected.load)),
    Span("direction of gravity", (level,)),
    Span("ground", (ground_height, ground_surface, GroundMapper.add, GroundMapper.finish)),
    Span("check of poses", (check_session,)),
    Span("labels", (RecordedLabels.labels, RecordedLabels.take, RecordedLabels.conclude)),
    Span("keyframes written", (keep_keyframes,), pulled=map_tables),
    Span("integrate", (Fuser.take, Carver.marks)),
    Span("finish of maps", (Fuser.finish,)),
    Span("blocks written", (write_blocks,)),
    Span("voxel merge", (write_voxels,), pulled=prefetch),
    Span("picture", (draw_map,)),
)


def profile_pipeline(
    logs: Sequence[Path], settings: Resolved, functions: int = BUSIEST
) -> tuple[Figures, Rows]:
    """Run the pipeline on ``logs`` in this process in a fresh workspace, under the profiler.

    Returns the figures (seconds of each stage, seconds a query, peak resident memory in MB) and,
    for the ``functions`` that took most time themselves, seconds, calls and where they are. The
    profiler adds some percent to code that calls many small functions.
    """
    with tempfile.TemporaryDirectory(prefix="semloc-profile-") as folder:
        work = Workspace(Path(folder))
        profiler = cProfile.Profile()
        report = profiler.runcall(
            run,
            [SessionInput(session_name(log), (log,)) for log in logs],
            work,
            settings,
            make_engine("serial"),
        )
        queries = int(read_metadata(work.closures)["queries"])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / PEAKS_PER_MB
    figures: Figures = {
        stage: {"ours": seconds, "unit": "s"} for stage, seconds in report.seconds.items()
    }
    figures["query"] = {"ours": report.seconds["close"] / max(queries, 1), "unit": "s a query"}
    figures["memory"] = {"ours": round(peak, 1), "unit": "MB peak"}
    figures["closures"] = {"ours": float(report.closures), "unit": ""}
    return figures, FunctionTimes(profiler).busiest(functions)


@dataclass(frozen=True, slots=True)
class Clocks:
    """Seconds of the wall clock and of the processor, since some moment."""

    wall: float
    processor: float

    @staticmethod
    def now() -> Clocks:
        return Clocks(time.perf_counter(), time.process_time())

    def __sub__(self, start: Clocks) -> Clocks:
        return Clocks(self.wall - start.wall, self.processor - start.processor)

    def __add__(self, more: Clocks) -> Clocks:
        return Clocks(self.wall + more.wall, self.processor + more.processor)


def profile_fuse(
    logs: Sequence[Path], settings: Resolved, rounds: int = 3, functions: int = BUSIEST
) -> tuple[Figures, Rows]:
    """`semloc fuse` of ``logs`` (one session) beside its two necessary parts alone.

    These are reading all clouds, and integrating all keyframes once. ``rounds`` times in turn each:
    wall-clock seconds, median and least, and processor seconds, median. ``ratio`` is whole /
    (reading + integrating). The parts come from one more run, in one thread and under the profiler,
    which adds some percent, as do the returned ``functions``, those that took most time themselves.
    """
    times: dict[str, list[Clocks]] = {"whole": [], "reading": [], "integrating": []}
    clouds = _read(logs, settings)  # to warm up
    for _ in range(rounds):
        with tempfile.TemporaryDirectory(prefix="semloc-fuse-") as folder:
            work = Workspace(Path(folder))
            start = Clocks.now()
            fuse_sessions({"session": logs}, work, settings)
            times["whole"].append(Clocks.now() - start)

            start = Clocks.now()
            _read(logs, settings)
            times["reading"].append(Clocks.now() - start)

            session = SessionMap(work.session("session"))
            times["integrating"].append(_integrating(session, settings))
            keyframes = len(session.map_T_base)

    profiler = cProfile.Profile()
    with (
        tempfile.TemporaryDirectory(prefix="semloc-fuse-") as folder,
        prefetch.in_callers_thread(),  # the profiler sees one thread
    ):
        profiler.runcall(fuse_sessions, {"session": logs}, Workspace(Path(folder)), settings)
    profile = FunctionTimes(profiler)

    value = {
        name: {
            "ours": float(np.median([clocks.wall for clocks in taken])),
            "least": min(clocks.wall for clocks in taken),
            "cpu": float(np.median([clocks.processor for clocks in taken])),
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
    figures |= {
        f"part: {part}": {"ours": seconds, "unit": "s, under the profiler"}
        for part, seconds in span_seconds(SPANS, profile, fuse).items()
    }
    return figures, profile.busiest(functions)


def _read(logs: Sequence[Path], settings: Resolved) -> int:
    """Read all clouds of ``logs``; their number."""
    fusion = settings.fusion
    options = SessionOptions(min_range=fusion.min_range, max_range=2.0 * fusion.max_range)
    session = open_session([*logs], options)
    try:
        return sum(1 for _ in session.clouds())
    finally:
        session.close()


def _integrating(session: SessionMap, settings: Resolved) -> Clocks:
    """Seconds of Fuser.add for every keyframe once, a new map every submap length of road."""
    total = Clocks(0.0, 0.0)
    submap = np.floor(
        np.asarray(session.frames["distance"].to_numpy()) / settings.fusion.submap_length
    )
    fuser = Fuser(settings.fusion)
    for k, pose in enumerate(session.map_T_base):
        if k and submap[k] != submap[k - 1]:
            fuser = Fuser(settings.fusion)
        frame = read_keyframe(session.folder.keyframes, k)
        origin = np.array([session.frames[f"origin_{c}"][k].as_py() for c in "xyz"])
        start = Clocks.now()
        fuser.add(frame.points, frame.label, origin, frame.sigma, pose)
        total += Clocks.now() - start
    return total

"""Speed of semantic fusion, beside mappers without labels that get the same points in the same run,
and beside what the machine allows.

Scans along a drive go one after the other into one map, which is then thrown away: a round. Rounds
of ours and of the peers alternate (A B C A B C ...), so that noise of the machine meets all alike.
A scan's time is the median (or the least) over the rounds, a figure the mean over the scans, the
first left out. Ours has one thread, because sessions are fused in parallel processes, and
integrates labels; peers have one thread, and two in columns NAME_2.

The limit of the machine, two ways:

* ``limit_ms``: bytes that must be touched over the memory's bandwidth (measured by a large copy,
read and written bytes counted). Points are read once (16 bytes: x y z and a label) and each voxel
that the scan touches is read and written (one byte of log-odds). No method that keeps these voxels
can be faster; it leaves out the work of finding them. * ``limit_walk_ms``: every ray walked
voxel by voxel at one clock cycle a step, on one core (the clock is measured by a chain of dependent
operations, four cycles each). A method that walks each ray cannot be faster; one that walks a ray
for each end voxel, as ours, can.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.benchmarks.peers.peer_process import Round, open_peers, write_scans
from semloc_logs.benchmarks.scans import Scan, depth_images, log_sweeps, street_sweeps
from semloc_logs.numerics.transforms import apply
from semloc_logs.settings import Resolved, ResolvedFusion
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE, BlockMap, Fuser

Figures = dict[str, dict[str, float | str]]


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """Scans to fuse in so many rounds; figures are called after ``name``."""

    name: str
    scans: Sequence[Scan]
    voxel_size: float
    max_range: float
    rounds: int
    what: str


def fusion_speed(
    settings: Resolved, logs: Sequence[Path] = (), peers: Mapping[str, str] | None = None
) -> Figures:
    """Figures of a 120,000-point sweep, of a depth image and, if named, of the sweeps of a log;
    ``peers`` is name -> Python executable.

    SettingsError for a peer that there is not, SemlocError for one that fails.
    """
    cases = [
        Case(
            "sweep",
            street_sweeps(),
            0.30,
            50.0,
            5,
            "a sweep of 120,000 points, 0.30 m, carved to 50 m",
        ),
        Case(
            "depth",
            depth_images(),
            0.05,
            8.0,
            3,
            "a depth image of 640 x 480, every pixel, 0.05 m, carved to 8 m",
        ),
    ]
    for k, log in enumerate(logs):
        scans = log_sweeps(log)
        points = np.mean([len(s.points) for s in scans])
        what = f"a sweep of {points:.0f} points, 0.30 m, carved to 50 m"
        cases.append(Case(f"log{k + 1}" if len(logs) > 1 else "log", scans, 0.30, 50.0, 5, what))
    bandwidth = memory_bandwidth()
    clock = clock_rate()
    figures: Figures = {}
    for case in cases:
        figures |= measure(case, settings, peers or {})
        figures |= _limits(case, settings, bandwidth, clock)
    figures["bandwidth"] = {"ours": bandwidth / 1e9, "unit": "GB/s copied, read and written"}
    figures["clock"] = {"ours": clock / 1e9, "unit": "GHz"}
    return figures


def measure(case: Case, settings: Resolved, peers: Mapping[str, str]) -> Figures:
    """Rounds of all, in turn: times of a scan, of the work at the end, and the content of the
    map.
    """
    fusion = _fusion(settings, case)
    with tempfile.TemporaryDirectory(prefix="semloc-fusion-") as folder, ExitStack() as stack:
        write_scans(Path(folder), case.scans)
        others = open_peers(
            stack, peers, Path(folder), case.voxel_size, case.max_range, os.cpu_count() or 1
        )
        rounds: dict[str, list[Round]] = {name: [] for name in ("ours", *others)}
        for _ in range(case.rounds + 1):  # the first one warms up
            rounds["ours"].append(our_round(case.scans, fusion))
            for name, peer in others.items():
                rounds[name].append(peer.round())
    rows: dict[str, dict[str, float]] = {}
    for who, done in rounds.items():
        wall, cpu = (
            np.array([getattr(r, kind) for r in done[1:]])[:, 1:] for kind in ("ms", "cpu_ms")
        )
        values = {
            "ms": float(np.median(wall, 0).mean()),
            "min_ms": float(wall.min(0).mean()),
            "cpu_ms": float(np.median(cpu, 0).mean()),
            "finish_ms": float(np.median([r.finish_ms for r in done[1:]])),
            "free": float(done[-1].free),
            "occupied": float(done[-1].occupied),
        }
        for key, value in values.items():
            rows.setdefault(f"{case.name}_{key}", {})[who] = value
    count = len(case.scans)
    units = {
        "ms": f"ms, {case.what}, median of {case.rounds}",
        "min_ms": "ms, the least",
        "cpu_ms": "ms of processor time, all threads",
        "finish_ms": f"ms once after {count} scans",
        "free": f"voxels after {count} scans",
        "occupied": f"voxels after {count} scans",
    }
    return {
        f"{case.name}_{key}": {**rows[f"{case.name}_{key}"], "unit": unit}
        for key, unit in units.items()
    }


def our_round(scans: Sequence[Scan], fusion: ResolvedFusion) -> Round:
    """Our fusion of ``scans`` with their labels."""
    fuser = Fuser(fusion)
    here = np.zeros(3)
    ms = []
    cpu = []
    for scan in scans:
        start = time.perf_counter()
        start_cpu = time.process_time()
        fuser.add(scan.points, scan.label, here, None, scan.map_T_sensor)
        ms.append(1e3 * (time.perf_counter() - start))
        cpu.append(1e3 * (time.process_time() - start_cpu))
    start = time.perf_counter()
    blocks = fuser.finish()
    return Round(ms, cpu, 1e3 * (time.perf_counter() - start), *_content(blocks))


def _fusion(settings: Resolved, case: Case) -> ResolvedFusion:
    return settings.fusion.model_copy(
        update={"voxel_size": case.voxel_size, "max_range": case.max_range}
    )


def _content(blocks: BlockMap) -> tuple[int, int]:
    """Free and occupied voxels."""
    free = int((blocks.state == FREE_STATE).sum())
    unobserved = int((blocks.state == UNOBSERVED_STATE).sum())
    return free, blocks.state.size - free - unobserved


def _limits(case: Case, settings: Resolved, bandwidth: float, clock: float) -> Figures:
    """What the middle scan needs at least, and its content beside the walk of all its rays."""
    scan = case.scans[len(case.scans) // 2]
    points = apply(scan.map_T_sensor, scan.points)
    steps, free, occupied = walk_all(
        points, scan.map_T_sensor[:3, 3], case.voxel_size, case.max_range
    )
    fuser = Fuser(_fusion(settings, case))
    fuser.add(scan.points, scan.label, np.zeros(3), None, scan.map_T_sensor)
    ours = _content(fuser.finish())
    own = "" if case.name == "sweep" else f"{case.name}_"
    touched = len(points) * 16 + sum(ours) * 2
    return {
        f"{own}steps": {"ours": float(steps), "unit": "voxel steps if each ray is walked"},
        f"{case.name}_one_free": {
            "ours": float(ours[0]),
            "unit": "voxels after one scan",
            "every_ray": float(free),
        },
        f"{case.name}_one_occupied": {
            "ours": float(ours[1]),
            "unit": "voxels after one scan",
            "every_ray": float(occupied),
        },
        f"{own}limit_ms": {
            "ours": 1e3 * touched / bandwidth,
            "unit": f"ms, {touched / 1e6:.2f} MB at the memory's bandwidth",
        },
        f"{own}limit_walk_ms": {
            "ours": 1e3 * steps / clock,
            "unit": "ms, each ray walked, a cycle a step",
        },
    }


def memory_bandwidth(size: int = 1 << 28) -> float:
    """Bytes read and written a second by a copy of ``size`` bytes, the best of five."""
    source = np.ones(size, np.uint8)
    target = np.zeros(size, np.uint8)
    best = np.inf
    for _ in range(5):
        start = time.perf_counter()
        np.copyto(target, source)
        best = min(best, time.perf_counter() - start)
    return float(2 * size / best)


def clock_rate(turns: int = 20_000_000) -> float:
    """Clock cycles a second, by a chain of exclusive ors (1 cycle) and multiplications (3 cycles on
    today's x86-64 and ARM cores).
    """
    _chain(1000, 1)
    best = np.inf
    for _ in range(5):
        start = time.perf_counter()
        _chain(turns, 1)
        best = min(best, time.perf_counter() - start)
    return float(4 * turns / best)


@njit(cache=True)
def _chain(turns: int, value: int) -> int:
    for _ in range(turns):
        # a compiler cannot shorten it, as it can a sum and a product
        value = (value ^ 1442695040888963407) * 6364136223846793005
    return value


def walk_all(
    points: NDArray[np.float64], origin: NDArray[np.float64], voxel_size: float, max_range: float
) -> tuple[int, int, int]:
    """Voxel steps, free and occupied voxels when the ray to every point (n, 3) is walked from
    ``origin`` (3,) up to ``max_range`` metres.

    The digital differential analyser of Amanatides and Woo (1987); hits win over passes.
    """
    reach = np.linalg.norm(points - origin, axis=1)
    hit = reach <= max_range
    ends = np.where(
        hit[:, None],
        points,
        origin + (points - origin) * (max_range / np.maximum(reach, 1e-9))[:, None],
    )
    low = np.floor(np.minimum(ends.min(0), origin) / voxel_size) - 1
    start = origin / voxel_size - low
    ends = ends / voxel_size - low
    grid = np.zeros(tuple((np.maximum(ends.max(0), start) + 2).astype(int)), np.uint8)
    steps = int(_walk(grid, start, ends, hit))
    return steps, int((grid == 1).sum()), int((grid == 2).sum())


@njit(cache=True)
def _walk(
    grid: NDArray[np.uint8],
    origin: NDArray[np.float64],
    ends: NDArray[np.float64],
    hit: NDArray[np.bool_],
) -> int:
    steps = 0
    cell = np.empty(3, np.int64)
    last = np.empty(3, np.int64)
    step = np.empty(3, np.int64)
    next_t = np.empty(3)
    delta = np.empty(3)
    for r in range(len(ends)):
        left = 0
        for k in range(3):
            d = ends[r, k] - origin[k]
            cell[k], last[k] = int(np.floor(origin[k])), int(np.floor(ends[r, k]))
            step[k] = 1 if d > 0 else -1
            delta[k] = 1.0 / abs(d) if d != 0 else np.inf
            border = cell[k] + (1 if d > 0 else 0)
            next_t[k] = abs(border - origin[k]) * delta[k] if cell[k] != last[k] else np.inf
            left += abs(last[k] - cell[k])
        steps += left + 1
        for _ in range(left):
            if grid[cell[0], cell[1], cell[2]] == 0:
                grid[cell[0], cell[1], cell[2]] = 1
            k = (
                0
                if next_t[0] <= next_t[1] and next_t[0] <= next_t[2]
                else (1 if next_t[1] <= next_t[2] else 2)
            )
            cell[k] += step[k]
            next_t[k] = next_t[k] + delta[k] if cell[k] != last[k] else np.inf
        if hit[r]:
            grid[last[0], last[1], last[2]] = 2
        elif grid[last[0], last[1], last[2]] == 0:
            grid[last[0], last[1], last[2]] = 1
    return steps

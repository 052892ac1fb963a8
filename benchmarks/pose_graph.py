"""How well `semloc optimize` tells false closures of drifting sessions, at the level of the graph.

    python -P benchmarks/pose_graph.py FIRST.tum SECOND.tum --sessions 20 --false 0 0.1 0.3

Sessions drive the routes of the TUM files in turn, with odometry of 1 % drift as the simulator
makes it. Closures come from the truth, 5 cm and 0.2 degrees off. Half of the false ones come in
runs of ten that agree with each other, as copies of a block of houses make them.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from semloc_logs.arrays import F64
from semloc_logs.evaluation.trajectory_errors import aligned_distances, relative_errors, rms
from semloc_logs.evaluation.truth import read_tum
from semloc_logs.numerics.transforms import exp_se3, inverse, yaw_transform
from semloc_logs.pose_graph.graph import Chain, Loops, PoseGraph
from semloc_logs.pose_graph.optimisation import optimise_graph
from semloc_logs.settings import load
from semloc_logs.simulation.drives.trajectory import drifting_odometry

KEYFRAME_M = 4.0
DRIFT = 0.01
SIGMA_M = 0.05
SIGMA_RAD = np.radians(0.2)
NEAR_M = 5.0  # a session is closed with another where its road is so near
RUN = 10  # false closures that agree with each other
RUN_M = 12.0  # road between two of them
RPE_M = 100.0


class Match(NamedTuple):
    """A closure between keyframes of two sessions, by number, and whether it is right."""

    target: int
    target_keyframe: int
    query: int
    query_keyframe: int
    target_T_query: F64
    is_true: bool


def road(poses: F64) -> F64:
    """Metres travelled (n,) up to each pose."""
    return np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))]


def thinned(path: Path) -> F64:
    """Poses of a TUM file, KEYFRAME_M apart."""
    poses = read_tum(path).common_T_base
    travelled = road(poses)
    rows = np.searchsorted(travelled, np.arange(0.0, travelled[-1], KEYFRAME_M))
    return poses[rows]


def noise(rng: np.random.Generator) -> F64:
    """The error of a closure."""
    return exp_se3(rng.normal(0, SIGMA_M, 3), rng.normal(0, SIGMA_RAD, 3))


def true_matches(truth: list[F64], every_m: float, rng: np.random.Generator) -> list[Match]:
    """A closure of each session in an earlier one, drawn at random, every so much road."""
    trees = [cKDTree(poses[:, :3, 3]) for poses in truth]
    matches = []
    for query in range(1, len(truth)):
        for k in range(0, len(truth[query]), max(1, round(every_m / KEYFRAME_M))):
            target = int(rng.integers(query))
            off, j = trees[target].query(truth[query][k, :3, 3])
            if off < NEAR_M:
                pose = inverse(truth[target][j]) @ truth[query][k] @ noise(rng)
                matches.append(Match(target, int(j), query, k, pose, True))
    return matches


def false_matches(truth: list[F64], count: int, rng: np.random.Generator) -> list[Match]:
    """Stretches of a session laid somewhere into another: half in runs, half alone."""
    matches: list[Match] = []
    step = round(RUN_M / KEYFRAME_M)
    while len(matches) < count:
        query = int(rng.integers(1, len(truth)))
        target = int(rng.integers(query))
        length = RUN if len(matches) < count // 2 else 1
        k = int(rng.integers(len(truth[query]) - RUN * step))
        j = int(rng.integers(len(truth[target])))
        turn = rng.choice([0.0, np.pi]) + rng.normal(0, 0.1)
        placed = truth[target][j] @ yaw_transform(turn, tuple(rng.normal(0, [2, 2, 0.2])))
        target_T_world = placed @ inverse(truth[query][k])
        for i in range(k, k + length * step, step):
            pose = target_T_world @ truth[query][i]
            near = int(np.argmin(np.linalg.norm(truth[target][:, :3, 3] - pose[:3, 3], axis=1)))
            wrong = inverse(truth[target][near]) @ pose @ noise(rng)
            matches.append(Match(target, near, query, i, wrong, False))
    return matches[:count]


def pose_graph(odometry: list[F64], matches: list[Match]) -> PoseGraph:
    """The graph of sessions a second a keyframe, with covariances as the noise is."""
    chains = [
        Chain(f"session_{k}", np.arange(len(poses)) * 10**9, poses, road(poses))
        for k, poses in enumerate(odometry)
    ]
    first = np.r_[0, np.cumsum([len(poses) for poses in odometry])]
    covariance = np.diag(np.repeat([SIGMA_M, SIGMA_RAD], 3) ** 2)
    loops = Loops(
        np.array([first[m.target] + m.target_keyframe for m in matches]),
        np.array([first[m.query] + m.query_keyframe for m in matches]),
        np.array([m.target_T_query for m in matches]),
        np.tile(covariance, (len(matches), 1, 1)),
        np.full(len(matches), 0.99),
    )
    return PoseGraph(chains, loops)


def measured(files: list[Path], sessions: int, every_m: float, share: float) -> dict[str, object]:
    """The figures of one case."""
    rng = np.random.default_rng(0)
    routes = [thinned(path) for path in files]
    truth = [routes[k % len(routes)] for k in range(sessions)]
    odometry = [drifting_odometry(poses, rng, DRIFT) for poses in truth]
    matches = true_matches(truth, every_m, rng)
    matches += false_matches(truth, round(share / (1 - share) * len(matches)), rng)
    graph = pose_graph(odometry, matches)

    begun = time.perf_counter()
    begun_cpu = time.process_time()
    result = optimise_graph(graph, load().resolved().optimize)
    seconds = time.perf_counter() - begun
    cpu_seconds = time.process_time() - begun_cpu
    poses = result.common_T_base
    parts = np.split(poses, graph.first[1:])
    is_true = np.array([m.is_true for m in matches])
    alone = [aligned_distances(t, p) for t, p in zip(truth, parts, strict=True)]
    before = [aligned_distances(t, p) for t, p in zip(truth, odometry, strict=True)]
    steps = [
        [relative_errors(t, p, RPE_M)[0] for t, p in zip(truth, estimate, strict=True)]
        for estimate in (odometry, parts)
    ]
    return {
        "sessions": sessions,
        "keyframes": graph.vertices,
        "true": int(is_true.sum()),
        "false": int((~is_true).sum()),
        "false_kept": int((result.kept & ~is_true).sum()),
        "true_dropped": int((~result.kept & is_true).sum()),
        "method": result.method.value,
        "frames": int(result.component.max()) + 1,
        "ate_before_m": rms(np.concatenate(before)),
        "ate_after_m": rms(aligned_distances(np.concatenate(truth), poses)),
        "ate_alone_after_m": rms(np.concatenate(alone)),
        "rpe_before_m": rms(np.concatenate(steps[0])),
        "rpe_after_m": rms(np.concatenate(steps[1])),
        "seconds": round(seconds, 1),
        "cpu_seconds": round(cpu_seconds, 1),
    }


def main() -> None:
    """One JSON line for each share of false closures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("routes", type=Path, nargs="+", metavar="FILE.tum")
    parser.add_argument("--sessions", type=int, default=20)
    parser.add_argument("--every", type=float, default=30.0, help="metres between closures")
    parser.add_argument("--false", type=float, nargs="+", default=[0.0, 0.1, 0.3], dest="shares")
    options = parser.parse_args()
    for share in options.shares:
        figures = measured(options.routes, options.sessions, options.every, share)
        print(json.dumps({"false_share": share, **figures}), flush=True)


if __name__ == "__main__":
    main()

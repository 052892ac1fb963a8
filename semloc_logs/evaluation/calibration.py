"""How probable is it that an alignment is right? Learnt from queries in simulated towns, of which most have never been visited.

Several towns are driven twice each, under other parked cars and with a network's label errors; every query is put to every session, so
that streets that were never seen are asked about far more often than streets that were. A logistic model of the features of the
best and of the rejected alignments gives the probability.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from semloc_logs.alignment.verify import FEATURES
from semloc_logs.closures.acceptance import fit_logistic
from semloc_logs.closures.closing import Alignment, CloseTask, close_queries
from semloc_logs.closures.queries import SessionMap, query_keyframes
from semloc_logs.evaluation.truth import CORRECT_DEG, CORRECT_M, TrueTrack, read_tum
from semloc_logs.geometry import inverse, rotation_angle
from semloc_logs.settings import Settings
from semloc_logs.simulation.sessions import simulate_sessions
from semloc_logs.workspace import Workspace

F64 = NDArray[np.float64]
Map = Callable[[Callable[[CloseTask], list[list[Alignment]]], Iterable[CloseTask]], Iterator[list[list[Alignment]]]]


@dataclass(frozen=True, slots=True)
class Town:
    """One simulated town: ``label_source`` as the setting, ``sensor`` a name of the simulator's models."""

    seed: int
    sensor: str
    label_noise: float
    label_source: str


TOWNS = (
    Town(201, "hdl32", 0.12, "auto"),
    Town(202, "hdl64", 0.0, "geometry"),
    Town(203, "hdl32", 0.12, "auto"),
    Town(204, "vlp32", 0.12, "geometry"),
)
LENGTH = 260.0  # of each drive (m)


def simulate_towns(folder: Path, towns: Sequence[Town] = TOWNS) -> dict[str, Path]:
    """Two drives through each town, by session name SEED_NUMBER; what is there already is kept."""
    out: dict[str, Path] = {}
    for town in towns:
        place = folder / str(town.seed)
        if not (place / "truth.json").exists():
            simulate_sessions(
                place, seed=town.seed, sessions=2, length_m=LENGTH, sensor=town.sensor, label_noise=town.label_noise, overwrite=True
            )
        out |= {f"{town.seed}_{k}": place / f"session_{k}.mcap" for k in range(2)}
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """An alignment with its errors; infinite where the two sessions are of different towns."""

    alignment: Alignment
    error_m: float
    error_deg: float
    nees: float  # squared error over the covariance, 6 degrees of freedom

    @property
    def right(self) -> bool:
        return self.error_m <= CORRECT_M and self.error_deg <= CORRECT_DEG


def judge(a: Alignment, query: TrueTrack, target: TrueTrack) -> Judged:
    """Errors of an alignment between sessions of one town."""
    q = query.at(np.array([a.query_stamp_ns]))[0][0]
    t = target.at(np.array([a.target_stamp_ns]))[0][0]
    true = inverse(t) @ q
    turn = a.target_T_query[:3, :3] @ true[:3, :3].T
    x = np.r_[a.target_T_query[:3, 3] - true[:3, 3], Rotation.from_matrix(turn).as_rotvec()]
    nees = float(x @ np.linalg.solve(a.covariance, x))
    return Judged(a, float(np.linalg.norm((inverse(true) @ a.target_T_query)[:3, 3])), float(np.degrees(rotation_angle(turn))), nees)


def collect(work: Workspace, logs: dict[str, Path], settings: Settings, run: Map, every: int) -> list[Judged]:
    """All alignments of every ``every``-th query of every session with every other session; ``run`` is an engine's ``map``."""
    tracks = {name: read_tum(log.with_suffix(".tum")) for name, log in logs.items()}
    tasks = []
    for name in logs:
        keyframes = query_keyframes(SessionMap(work.session(name)), settings)[::every]
        others = tuple(sorted(n for n in logs if n != name))
        tasks += [CloseTask(work.path.absolute(), name, (k,), others, settings.model_dump_json()) for k in keyframes]
    out = []
    for task, results in zip(tasks, run(close_queries, tasks), strict=True):
        for a in results[0]:
            same_town = a.target_session.split("_")[0] == task.session.split("_")[0]
            wrong = Judged(a, np.inf, 180.0, np.inf)
            out.append(judge(a, tracks[a.query_session], tracks[a.target_session]) if same_town else wrong)
    return out


# The sign with which evidence may count. The plane distances of fitting points (rmse) say more about the sensor than about the place.
SIGNS = {"structure": 1, "coverage": 1, "contradiction": -1, "fit": 1, "rmse": 0, "distinct": -1, "support": 1, "stiffness": 1}


def calibrate(rows: Sequence[Judged], ridge: float = 0.3) -> dict[str, Any]:
    """The content of calibration.json from judged alignments; alignments between 1 and 3 metres off teach neither side.

    Features whose weight would have the wrong sign are left out one by one: in few towns they stand for something else.
    """
    clear = [r for r in rows if r.right or r.error_m > 3 * CORRECT_M or r.error_deg > 3 * CORRECT_DEG]
    x = np.array([[getattr(r.alignment.features, n) for n in FEATURES] for r in clear])
    right = np.array([r.right for r in clear])
    low, high = np.quantile(x, 0.01, axis=0), np.quantile(x, 0.99, axis=0)
    signs = np.array([SIGNS[n] for n in FEATURES])
    used = np.flatnonzero(signs)
    while True:
        fitted, bias = fit_logistic(np.clip(x, low, high)[:, used], right, ridge)
        strength = fitted * signs[used] * x[:, used].std(0)
        if len(used) == 1 or strength.min() > 0:
            break
        used = np.delete(used, int(np.argmin(strength)))
    weights = np.zeros(len(FEATURES))
    weights[used] = fitted
    features = {
        n: {"weight": round(float(weights[i]), 4), "low": round(float(low[i]), 4), "high": round(float(high[i]), 4)}
        for i, n in enumerate(FEATURES)
    }
    return {"bias": round(bias, 4), "features": features, "alignments": len(clear), "right": int(right.sum())}


def reliability(rows: Sequence[Judged], edges: Sequence[float] = (0.0, 0.1, 0.5, 0.9, 0.99, 0.999, 1.0)) -> list[dict[str, float]]:
    """How often alignments of each range of probability are right."""
    p = np.array([r.alignment.probability for r in rows])
    right = np.array([r.right for r in rows])
    out = []
    for a, b in pairwise(edges):
        mine = (p >= a) & ((p < b) | (b == edges[-1]))
        if mine.any():
            out.append(
                {"from": a, "to": b, "alignments": int(mine.sum()), "said": float(p[mine].mean()), "right": float(right[mine].mean())}
            )
    return out

"""Closures of two sessions that agree with each other: pairwise consistent measurement sets.

Mangelson, Dominic, Eustice, Vasudevan: Pairwise Consistent Measurement Set Maximization for Robust
Multi-Robot Map Merging, ICRA 2018. Two closures are consistent when the way around the loop of both
and of the odometry between their ends leads back, within its uncertainty. The largest set in which
all agree is a maximum clique; it is found by a greedy search, as there. Closures of one stretch of
road see the same houses, whose copies mislead all of them alike: together they count as one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64, I64, Bools
from semloc_logs.numerics.transforms import inverse
from semloc_logs.pose_graph.graph import Loops, PoseGraph
from semloc_logs.pose_graph.odometry_noise import OdometryNoise
from semloc_logs.settings import ResolvedOptimize

# standard deviations that a way around may be off; 3.5 of a normal distribution in 3 axes: 0.7 %
GATE = 3.5
STARTS = 32  # closures of most agreement from which a set is grown
STRETCH = 20.0  # vertex spacings of road in which closures count as one; 100 m outdoors
ROWS = 256  # closures that are compared with all others at once


@dataclass(frozen=True, slots=True, eq=False)
class ConsistentSet:
    """The closures ``members`` (k,) of the sessions ``a`` <= ``b`` that agree, most central first.

    ``others`` are the remaining closures of these sessions, ``support`` the number of stretches of
    road that the members are of.
    """

    a: int
    b: int
    members: I64
    others: I64
    support: float


def consistent_sets(graph: PoseGraph, settings: ResolvedOptimize) -> list[ConsistentSet]:
    """The largest consistent set of each pair of sessions that have closures."""
    noise = OdometryNoise.of(settings)
    loops = _ordered(graph)
    sets = []
    for a, b, rows in _pairs(graph, loops):
        agree = _agreement(graph, loops.part(rows), noise, settings)
        weight = _independence(graph, loops.part(rows), STRETCH * settings.vertex_spacing)
        clique = largest_clique(agree, weight)
        central = clique[np.argsort(-(agree[clique] @ weight), kind="stable")]
        others = np.setdiff1d(np.arange(len(rows)), clique)
        support = float(weight[clique].sum())
        sets.append(ConsistentSet(a, b, rows[central], rows[others], support))
    return sets


def _ordered(graph: PoseGraph) -> Loops:
    """The closures with the target in the session of lower number, of one session the earlier."""
    loops = graph.loops
    swap = loops.target > loops.query
    back = inverse(loops.target_T_query)
    return Loops(
        np.where(swap, loops.query, loops.target),
        np.where(swap, loops.target, loops.query),
        np.where(swap[:, None, None], back, loops.target_T_query),
        loops.covariance,
        loops.probability,
    )


def _pairs(graph: PoseGraph, loops: Loops) -> Iterator[tuple[int, int, I64]]:
    """The rows of the closures of each pair of sessions."""
    count = max(len(graph.chains), 1)
    key = graph.chain_of[loops.target] * count + graph.chain_of[loops.query]
    order = np.argsort(key, kind="stable")
    keys, starts = np.unique(key[order], return_index=True)
    for pair, rows in zip(keys, np.split(order, starts[1:]), strict=bool(len(keys))):
        yield int(pair // count), int(pair % count), rows


def _agreement(
    graph: PoseGraph, loops: Loops, noise: OdometryNoise, settings: ResolvedOptimize
) -> Bools:
    """Which closures (m, m) of one pair of sessions are consistent; each is with itself."""
    sigma_m, sigma_rad = _own_sigma(loops, settings)
    target = graph.map_T_base[loops.target]
    query = graph.map_T_base[loops.query]
    # each closure as the pose of one map in the other
    map_T_map = target @ loops.target_T_query @ inverse(query)
    target_road = graph.distance[loops.target]
    query_road = graph.distance[loops.query]
    agree = np.zeros((len(loops), len(loops)), bool)
    for first in range(0, len(loops), ROWS):
        rows = slice(first, first + ROWS)
        # error of the way around, at the query's end of the rows
        other = inverse(target[rows])[:, None] @ map_T_map[None] @ query[rows][:, None]
        error = inverse(loops.target_T_query[rows])[:, None] @ other
        off_m = np.linalg.norm(error[..., :3, 3], axis=-1)
        off_rad = Rotation.from_matrix(error[..., :3, :3].reshape(-1, 3, 3)).magnitude()
        off_rad = off_rad.reshape(off_m.shape)

        road_a = np.abs(target_road[rows, None] - target_road)
        road_b = np.abs(query_road[rows, None] - query_road)
        lever = np.linalg.norm(query[rows, None, :3, 3] - query[None, :, :3, 3], axis=-1)
        turn = sigma_rad[rows, None] ** 2 + sigma_rad**2
        moved = sigma_m[rows, None] ** 2 + sigma_m**2 + (lever * sigma_rad) ** 2
        for road in (road_a, road_b):
            turn = turn + noise.turn_variance(road)
            moved = moved + noise.position_variance(road)
        agree[rows] = (off_m < GATE * np.sqrt(moved)) & (off_rad < GATE * np.sqrt(turn))
    both = agree | agree.T
    np.fill_diagonal(both, True)
    return both


def _own_sigma(loops: Loops, settings: ResolvedOptimize) -> tuple[F64, F64]:
    """Largest standard deviations of position (m) and rotation (rad) of each closure."""
    position = np.linalg.eigvalsh(loops.covariance[:, :3, :3])[:, -1]
    rotation = np.linalg.eigvalsh(loops.covariance[:, 3:, 3:])[:, -1]
    floor_rad = np.radians(settings.closure_sigma_deg)
    return (
        np.sqrt(position + settings.closure_sigma**2),
        np.sqrt(rotation + floor_rad**2),
    )


def _independence(graph: PoseGraph, loops: Loops, stretch: float) -> F64:
    """Weights (m,) of the closures of one pair: one, shared by closures of the same road."""
    ends = np.stack([graph.distance[loops.target], graph.distance[loops.query]], axis=1)
    _, place, counts = np.unique(
        np.floor(ends / stretch), axis=0, return_inverse=True, return_counts=True
    )
    return np.asarray(1.0 / counts[place.ravel()])


def largest_clique(agree: Bools, weight: F64 | None = None) -> I64:
    """Rows (k,), ascending, of a heavy set in which all agree: greedy from the best starts."""
    weight = np.ones(len(agree)) if weight is None else weight
    degree = agree @ weight
    order = np.argsort(-degree, kind="stable")
    best = np.zeros(0, np.int64)
    most = 0.0
    for start in order[:STARTS]:
        if degree[start] <= most:
            break
        clique = _grown(agree, int(start), order)
        if weight[clique].sum() > most:
            best = clique
            most = float(weight[clique].sum())
    return np.sort(best)


def _grown(agree: Bools, start: int, order: I64) -> I64:
    """A clique with ``start``: the next in ``order`` that agrees with all so far, to the end."""
    members = [start]
    left = agree[start].copy()
    left[start] = False
    for candidate in order:
        if left[candidate]:
            members.append(int(candidate))
            left &= agree[candidate]
            left[candidate] = False
    return np.array(members, np.int64)

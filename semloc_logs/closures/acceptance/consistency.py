"""Votes of neighbouring queries: right ones lie where odometry and one transform put them.

Two alignments of a session with the same target agree when the first one and the odometry between
the two queries predict the second one, to within their standard deviations and what odometry may
drift (pairwise consistency as in Mangelson et al., PCM, ICRA 2018, section III, over a stretch of
road instead of all pairs).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from semloc_logs.alignment.hypotheses import ODOMETRY_DRIFT, SAME_PLACE_VOXELS
from semloc_logs.arrays import F64, I64
from semloc_logs.closures.acceptance.ambiguity import ambiguity
from semloc_logs.closures.acceptance.placements import (
    ARM,
    FAR,
    Pairs,
    Placed,
    posed_pairs,
    query_roads,
)
from semloc_logs.closures.closure import Agreement
from semloc_logs.numerics.transforms import inverse
from semloc_logs.settings import STREET_VOXEL

# constants, not settings: the models in calibration.json were fitted to votes counted with them
NEAR = 25.0  # m of road from a query to its neighbours, at voxels of 0.30 m
# voxels between two alignments of one place, without and with their standard deviations
SLACK = 1.7
MOST_SLACK = SAME_PLACE_VOXELS
# rad, and rad a metre
TURN = np.radians(4.0)
TURN_DRIFT = np.radians(0.02)
# voxels of road between two places of a target that may be one, driven again
DRIVEN_AGAIN = 50
MIN_VOTE = 0.02  # alignments less probable than this do not vote


def count_votes(
    placed: Placed,
    pairs: Pairs,
    own_probability: F64,
    voxel_size: float,
    roads: Mapping[str, F64] | None = None,
) -> Agreement[F64]:
    """The votes on each alignment (n,); the order of the alignments does not matter.

    ``pairs`` are the rows of the alignments by :func:`.placements.pairs_of`; ``own_probability``
    (n,) is the share of each in its :func:`place_odds`. ``roads`` are of each session's queries, by
    default of those that have alignments.
    """
    n = len(placed)
    votes = Agreement(own_probability, *np.zeros((6, n)))
    support = np.zeros(n)
    pairs = posed_pairs(placed, pairs)
    roads = query_roads(placed) if roads is None else roads
    for (query, _), rows in pairs.items():
        group = placed.part(rows)
        road = roads[query]
        reach = NEAR * voxel_size / STREET_VOXEL
        votes.neighbours[rows] = (
            np.searchsorted(road, group.road + reach, "right")
            - np.searchsorted(road, group.road - reach, "left")
            - 1.0
        )
        sums, sums_ignoring_rivals = _sums(
            group, (own_probability[rows], group.probability_ignoring_rivals), voxel_size
        )
        votes.support[rows] = sums[0]
        votes.conflict[rows] = sums[1]
        votes.far_support[rows] = sums[2]
        votes.far_conflict[rows] = sums[3]
        support[rows] = (
            group.probability_ignoring_rivals
            * sums_ignoring_rivals[0]
            / np.maximum(votes.neighbours[rows], 1)
        )
    lone = placed.posed & (votes.neighbours == 0)
    return replace(votes, ambiguity=ambiguity(placed, pairs, roads, support, lone, voxel_size))


def _sums(group: Placed, probabilities: Sequence[F64], voxel_size: float) -> list[F64]:
    """Sums of votes on each alignment, by each of the ``probabilities`` (n,) of the voters.

    Each is (4, n): near support, near conflict, far support, far conflict. The ``group`` is ordered
    by query, and so by road. Of each query the most probable alignment of either kind votes, and
    as a conflict only if it is more probable than a supporting one.
    """
    scale = voxel_size / STREET_VOXEL
    p = np.where(np.array(probabilities) >= MIN_VOTE, np.array(probabilities), 0.0)
    voting = np.flatnonzero(p.max(axis=0) >= MIN_VOTE)
    voters = group.part(voting)
    first = np.searchsorted(voters.road, group.road - FAR * scale, "left")
    end = np.searchsorted(voters.road, group.road + FAR * scale, "right")
    out = np.zeros((len(p), 4, len(group)))
    target_T_map = group.target_T_query @ inverse(group.map_T_query)  # as each alignment has it
    _add_votes(
        out,
        (group.query, group.road, group.target_road, target_T_map, group.sigma),
        (
            voters.query,
            voters.road,
            voters.target_road,
            voters.map_T_query,
            voters.target_T_query,
            voters.sigma,
            np.ascontiguousarray(p[:, voting]),
        ),
        (first, end),
        voxel_size,
        scale,
    )
    return list(out)


@njit(cache=True, nogil=True)
def most_apart(sigma: F64, other_sigma: F64, road: F64, target_road: F64, voxel_size: float) -> F64:
    """Metres by which two alignments that agree may differ: floats or arrays (n,).

    Their positions have the standard deviations ``sigma`` and ``other_sigma``; ``road`` and
    ``target_road`` metres lie between them in the two sessions.
    """
    slack = SLACK * voxel_size + 2 * np.hypot(sigma, other_sigma)
    drift = ODOMETRY_DRIFT * (road + target_road) + ARM * road
    return np.minimum(slack, MOST_SLACK * voxel_size) + drift


@njit(cache=True, nogil=True)
def _add_votes(
    out: F64,
    group: tuple[I64, F64, F64, F64, F64],
    voters: tuple[I64, F64, F64, F64, F64, F64, F64],
    stretch: tuple[I64, I64],
    voxel_size: float,
    scale: float,
) -> None:
    """Add to ``out`` (probabilities, 4, n) the votes of each alignment's stretch of road.

    The voters of alignment k are numbers ``stretch[0][k]`` to ``stretch[1][k]``.
    """
    query, road, target_road, target_T_map, sigma = group
    voter_query, voter_road, voter_target_road, map_T_query, target_T_query, voter_sigma, p = voters
    first, end = stretch
    support = np.zeros(len(p))
    conflict = np.zeros(len(p))
    for k in range(len(query)):
        for n in range(first[k], end[k]):
            if voter_query[n] != query[k]:
                along = abs(voter_road[n] - road[k])
                target_along = abs(voter_target_road[n] - target_road[k])
                most = most_apart(sigma[k], voter_sigma[n], along, target_along, voxel_size)
                agrees = _agrees(
                    target_T_map[k],
                    map_T_query[n],
                    target_T_query[n],
                    float(most),
                    TURN + TURN_DRIFT * along / scale,
                )
                for i in range(len(p)):
                    if agrees:
                        support[i] = max(support[i], p[i, n])
                    else:
                        conflict[i] = max(conflict[i], p[i, n])
            if n + 1 == end[k] or voter_query[n + 1] != voter_query[n]:  # the last one of a query
                far = 2 if abs(voter_road[n] - road[k]) > NEAR * scale else 0
                for i in range(len(p)):
                    out[i, far, k] += support[i]
                    out[i, far + 1, k] += conflict[i] if conflict[i] > support[i] else 0.0
                    support[i] = conflict[i] = 0.0


@njit(cache=True, nogil=True)
def _agrees(
    target_T_map: F64, map_T_query: F64, target_T_query: F64, most: float, turn: float
) -> bool:
    """Whether the query lies where ``target_T_map`` and its odometry put it.

    To within ``most`` metres and ``turn`` radians.
    """
    squared, trace = 0.0, 0.0
    for i in range(3):
        p = target_T_map[i, 3] - target_T_query[i, 3]
        for m in range(3):
            p += target_T_map[i, m] * map_T_query[m, 3]
            r = 0.0
            for j in range(3):
                r += target_T_map[i, j] * map_T_query[j, m]
            trace += r * target_T_query[i, m]
        squared += p * p
    return bool(squared <= most * most and np.arccos(min(max((trace - 1) / 2, -1.0), 1.0)) <= turn)


@dataclass(frozen=True, slots=True, eq=False)
class PlaceOdds:
    """Odds of the alignments (n,) of a query with a target: one of them is right, or none.

    ``own`` belong to the alignment, ``place`` to all poses of its place, ``rivals`` to all other
    places, and ``none`` to no place at all.
    """

    own: F64
    place: F64
    rivals: F64
    none: F64

    @property
    def share(self) -> F64:
        """The probability of the alignment (n,)."""
        return self.own / (self.none + self.place + self.rivals)

    @property
    def place_probability(self) -> F64:
        """The probability of its place (n,)."""
        return self.place / (self.none + self.place + self.rivals)

    @property
    def mode_share(self) -> F64:
        """Its share (n,) in the odds of all poses of its place."""
        return self.own / self.place


def place_odds(placed: Placed, pairs: Pairs, log_odds: F64, voxel_size: float) -> PlaceOdds:
    """What alignments with ``log_odds`` (n,) leave to each other; ``pairs`` are their rows.

    Poses of one place are modes: a metre along the road, where each camera saw the other sides of
    things. A place that the target passed twice is not its own rival.
    """
    out = np.ones((4, len(placed)))
    for rows in pairs.values():
        out[:, rows] = _place_odds(
            placed.query[rows],
            placed.target_T_query[rows],
            placed.target_road[rows],
            log_odds[rows],
            (2 * MOST_SLACK * voxel_size, 2 * TURN, DRIVEN_AGAIN * voxel_size),
        )
    return PlaceOdds(*out)


@njit(cache=True, nogil=True)
def _place_odds(
    query: I64,
    target_T_query: F64,
    target_road: F64,
    log_odds: F64,
    bounds: tuple[float, float, float],
) -> F64:
    """The fields of :class:`PlaceOdds` (4, n), ordered by ``query`` (n,).

    In one place are poses within ``bounds[0]`` metres and ``bounds[1]`` radians about z. From
    ``bounds[2]`` metres of road on they may also be apart by the drift of the target's odometry.
    """
    most, turn, again = bounds
    out = np.ones((4, len(query)))
    first = 0
    for k in range(len(query)):
        first = first if query[first] == query[k] else k
        end = first
        largest = 0.0
        while end < len(query) and query[end] == query[k]:
            largest = max(largest, log_odds[end])
            end += 1
        # in units of the largest odds, so that nothing overflows
        own = np.exp(log_odds[k] - largest)
        place = 0.0
        rivals = 0.0
        T = target_T_query[k]
        for n in range(first, end):
            U = target_T_query[n]
            distance = np.sqrt(
                (T[0, 3] - U[0, 3]) ** 2 + (T[1, 3] - U[1, 3]) ** 2 + (T[2, 3] - U[2, 3]) ** 2
            )
            # the yaw of U inv(T); the axes of the base may point anywhere
            sine, cosine = 0.0, 0.0
            for m in range(3):
                sine += U[1, m] * T[0, m] - U[0, m] * T[1, m]
                cosine += U[0, m] * T[0, m] + U[1, m] * T[1, m]
            turned = abs(np.arctan2(sine, cosine))
            road = abs(target_road[k] - target_road[n])
            odds = np.exp(log_odds[n] - largest)
            if distance <= most and turned <= turn:
                place += odds
            elif not (
                road > again
                and distance <= most + ODOMETRY_DRIFT * road
                and turned <= turn + TURN_DRIFT * road
            ):
                rivals += odds
        out[0, k] = own
        out[1, k] = place
        out[2, k] = rivals
        out[3, k] = np.exp(-largest)
    return out

"""Initial poses from a spanning tree of sessions, and which sessions hang together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semloc_logs.arrays import F64, I64
from semloc_logs.numerics.transforms import inverse
from semloc_logs.pose_graph.consistent_sets import ConsistentSet
from semloc_logs.pose_graph.graph import PoseGraph


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Where each map lies: ``common_T_map`` (k, 4, 4), and the ``component`` (k,) of its frame."""

    common_T_map: F64
    component: I64


def place_sessions(graph: PoseGraph, sets: Sequence[ConsistentSet]) -> Placement:
    """The tree takes pairs of sessions in the order of how many stretches of road agree.

    The frame of a component is the map frame of its first session. A pair is placed by the closure
    that agrees with most others.
    """
    count = len(graph.chains)
    component = np.arange(count)
    common_T_map = np.tile(np.eye(4), (count, 1, 1))
    loops = graph.loops
    for pair in sorted(sets, key=lambda s: (-s.support, -len(s.members), s.a, s.b)):
        if component[pair.a] == component[pair.b]:
            continue
        row = pair.members[0]
        target_chain = graph.chain_of[loops.target[row]]
        query_chain = graph.chain_of[loops.query[row]]
        targetmap_T_querymap = (
            graph.map_T_base[loops.target[row]]
            @ loops.target_T_query[row]
            @ inverse(graph.map_T_base[loops.query[row]])
        )
        frame_T_frame = (
            common_T_map[target_chain] @ targetmap_T_querymap @ inverse(common_T_map[query_chain])
        )
        # the component of the later first session moves into the other's frame
        stays = component[target_chain]
        moves = component[query_chain]
        if moves < stays:
            stays, moves = moves, stays
            frame_T_frame = inverse(frame_T_frame)
        moved = component == moves
        common_T_map[moved] = frame_T_frame @ common_T_map[moved]
        component[moved] = stays
    _, numbers = np.unique(component, return_inverse=True)
    return Placement(common_T_map, numbers)

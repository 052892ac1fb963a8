"""The pose graph: a chain of keyframes for each session, and the closures between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from semloc_logs.arrays import F64, I64, Bools


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Keyframes (n,) of the session ``name`` that odometry connects.

    ``map_T_base`` (n, 4, 4) are their poses, ``distance`` (n,) is the road to each in metres,
    ``level`` whether the z axis of the map frame is known to point up. A session without odometry
    has a chain for each keyframe.
    """

    name: str
    stamps_ns: I64
    map_T_base: F64
    distance: F64
    level: bool = True

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True, slots=True, eq=False)
class Loops:
    """Closures (m,) between vertices.

    ``target_T_query`` (m, 4, 4) is the pose of the ``query`` vertex in the ``target`` vertex;
    ``covariance`` (m, 6, 6) in the target's axes, x y z rotation-x rotation-y rotation-z as in
    closures.parquet; ``probability`` (m,) that each is right.
    """

    target: I64
    query: I64
    target_T_query: F64
    covariance: F64
    probability: F64

    def __len__(self) -> int:
        return len(self.target)

    def part(self, rows: I64 | Bools) -> Loops:
        """Some of the rows."""
        return Loops(
            self.target[rows],
            self.query[rows],
            self.target_T_query[rows],
            self.covariance[rows],
            self.probability[rows],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Positions:
    """Where satellites place some ``vertices`` (f,).

    ``antenna`` (f, 3) in the axes of the vertex lies at ``position`` (f, 3), east, north, up of a
    point that all share, to ``sigma`` (f, 3) metres.
    """

    vertices: I64
    antenna: F64
    position: F64
    sigma: F64

    def __len__(self) -> int:
        return len(self.vertices)

    def part(self, rows: I64 | Bools) -> Positions:
        """Some of the rows."""
        return Positions(
            self.vertices[rows], self.antenna[rows], self.position[rows], self.sigma[rows]
        )


NO_POSITIONS = Positions(np.zeros(0, np.int64), *(np.zeros((0, 3)) for _ in range(3)))
Datum = tuple[float, float, float]  # WGS 84 latitude and longitude (degrees), height (m)


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """All sessions; a vertex is the number of a keyframe, counted through the chains in order.

    ``fixes`` are relative to ``datum``, None without any.
    """

    chains: Sequence[Chain]
    loops: Loops
    fixes: Positions = NO_POSITIONS
    datum: Datum | None = None

    @cached_property
    def first(self) -> I64:
        """The first vertex of each chain (k,)."""
        lengths = np.array([len(chain) for chain in self.chains], np.int64)
        return np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64)

    @property
    def vertices(self) -> int:
        """Their number."""
        return sum(len(chain) for chain in self.chains)

    @cached_property
    def chain_of(self) -> I64:
        """The chain of each vertex (n,)."""
        return np.repeat(np.arange(len(self.chains)), [len(chain) for chain in self.chains])

    @cached_property
    def map_T_base(self) -> F64:
        """The pose of each vertex (n, 4, 4) in the map frame of its session."""
        return np.concatenate([np.zeros((0, 4, 4)), *(chain.map_T_base for chain in self.chains)])

    @cached_property
    def distance(self) -> F64:
        """Road (n,) from the start of its session to each vertex, metres."""
        return np.concatenate([np.zeros(0), *(chain.distance for chain in self.chains)])


def turned_covariance(target_R_source: F64, covariance: F64) -> F64:
    """Covariances (n, 6, 6) of position and rotation in other axes, by rotations (n, 3, 3)."""
    turn = np.zeros((len(covariance), 6, 6))
    turn[:, :3, :3] = target_R_source
    turn[:, 3:, 3:] = target_R_source
    return np.asarray(turn @ covariance @ np.swapaxes(turn, 1, 2))

"""The protocol of a localisation system: it learns a database of views with known poses, and
answers a query with ranked poses (section 4.1 of the paper).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32, F64

MOST_POSES = 100  # poses of an answer that are kept; the rank-recall curves end there


class Picture(NamedTuple):
    """``image`` (h, w, 3) uint8 RGB without distortion, ``depth`` (h, w) metres along the optical
    axis with NaN where unknown, ``intrinsics`` (3, 3), ``base_T_camera`` (4, 4), optical axes.
    """

    image: NDArray[np.uint8]
    depth: F32
    intrinsics: F64
    base_T_camera: F64


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What a drive saw at ``stamp_ns``.

    ``points`` (n, 3) metres in the base frame at that time, ``label`` (n,) classes of the label
    space, ``origin`` (3,) or (n, 3) of the rays, ``odom_T_base`` (4, 4) by odometry with z up, and
    ``world_T_base`` (4, 4), the truth: systems may read it of the database, never of a query, where
    it is NaN. ``picture`` where a camera saw it.
    """

    session: str
    stamp_ns: int
    points: F32
    label: NDArray[np.uint8]
    origin: F32
    odom_T_base: F64
    world_T_base: F64
    picture: Picture | None = None


@dataclass(frozen=True, slots=True)
class Query:
    """Consecutive ``views``, the pose of the last one is wanted: one view, or five for *acc.*
    (section 4.4). ``name`` is unique in the scenario.
    """

    name: str
    views: tuple[View, ...]


class RankedPose(NamedTuple):
    """``world_T_base`` (4, 4) of the query's last view, and the ``score`` of the system, greater is
    better; the scale is its own.
    """

    world_T_base: F64
    score: float


class System(Protocol):
    """One row of the paper's Fig. 5."""

    name: str

    def fit(self, database: Sequence[View]) -> None:
        """Learn the places of ``database``; views are loaded when they are taken from it."""
        ...

    def localise(self, query: Query) -> list[RankedPose]:
        """At most ``MOST_POSES`` poses, best first; none where the system finds none."""
        ...

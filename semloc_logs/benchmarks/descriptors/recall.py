"""Recall of descriptors: the share of query subvolumes whose true place is among the nearest
descriptors of a database.

Databases and queries: :mod:`semloc_logs.benchmarks.descriptors.held_out`. They are described by the
network, trained or not, or by a descriptor of a peer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semloc_logs.arrays import F32, F64, I64, U8
from semloc_logs.benchmarks.descriptors.held_out import HeldOut
from semloc_logs.benchmarks.descriptors.places import Place
from semloc_logs.numerics.transforms import apply
from semloc_logs.settings import Resolved
from semloc_logs.subvolumes.describe import (
    Described,
    DescribesWindows,
    Windows,
    describe_map,
)
from semloc_logs.subvolumes.network import LATENT

# a place and whether it is a query -> centres (voxels of its frame) and descriptors
Describe = Callable[[Place, bool], Described]

# of each scenario
DATABASES = {
    "0": ("camera",),
    "90": ("camera",),
    "180": ("camera",),
    "season": ("lidar",),
    "sensor": ("lidar",),
}
NEAREST = 5
RADIUS = 1.5  # m at 0.30 m voxels
LAYER = 8  # voxels between the layers of a map
WORDS = 12  # query words of one query map at most: neighbours are alike
BESIDE = 3.0  # m: what lies so near to a query's true place is never cut from the database
BLOCK = 256  # queries that are compared at once


@dataclass(frozen=True, slots=True, eq=False)
class Words:
    """Descriptors (n, d), and where in the common frame they are of, (n, 3) metres."""

    centre: F64
    descriptor: F32

    def __getitem__(self, rows: I64) -> Words:
        return Words(self.centre[rows], self.descriptor[rows])


class NoEncoder:
    """Describes everything alike: which subvolumes are described does not depend on the network."""

    variant = "geometric"
    latent = LATENT

    def describe(self, codes: U8, windows: NDArray[np.int64]) -> F32:
        """Equal unit descriptors (n, latent) of the ``windows`` (n, 2)."""
        return np.full((len(windows), self.latent), self.latent**-0.5, np.float32)


def network_describes(encoder: DescribesWindows, settings: Resolved) -> Describe:
    """Describes places by the network, as ``semloc describe`` and ``semloc close`` do. ``settings``
    are resolved.
    """
    d = settings.descriptor
    v = settings.fusion.voxel_size

    def describe(place: Place, is_query: bool) -> Described:
        road = None if is_query else place.track[:, :2]
        stride = d.query_stride if is_query else d.stride
        return describe_map(
            place.state,
            place.low,
            place.ground_z,
            encoder,
            Windows(v, stride, d.min_occupied, np.inf if is_query else d.reach),
            road,
        )

    return describe


def count_subvolumes(settings: Resolved) -> Callable[[Place], int]:
    """How many descriptors a place of a database has, whatever the network."""
    describe = network_describes(NoEncoder(), settings)
    return lambda place: len(describe(place, False).centre)


def retrieval_recall(world: HeldOut, encoder: DescribesWindows) -> dict[str, float]:
    """Recall at 5 of each scenario, in [0, 1], of what an encoder describes (:func:`recalls`)."""
    return recalls(world, network_describes(encoder, world.settings))


def recalls(world: HeldOut, describe: Describe) -> dict[str, float]:
    """Recall of each scenario by whatever describes places.

    The share of query words whose true place is among the 5 nearest (L2) of exactly
    ``world.database`` database words: one of those is within the larger of 1.5 m (at 0.30 m voxels)
    and half a cell's diagonal of it. Query words without any such database word do not count.
    Scenarios other than the five have a database of their own name, filled up with the LIDAR's.
    """
    v = world.settings.fusion.voxel_size
    words_of_kind: dict[str, list[Words]] = {}
    queries: dict[str, list[Words]] = {}
    rng = np.random.default_rng(0)
    for street in world.streets():
        for kind, place in street.database:
            words_of_kind.setdefault(kind, []).append(_words(place, describe(place, False), v))
        for name, places in street.queries.items():
            for place in places:
                words = _words(place, describe(place, True), v)
                most = WORDS if name in DATABASES else None  # real queries are few
                queries.setdefault(name, []).append(
                    words[rng.permutation(len(words.centre))[:most]]
                )
    if "0" in queries:  # the queries of the camera that looks ahead, in the LIDAR's map too
        queries["sensor"] = queries["0"]
    databases = {kind: _joined(parts) for kind, parts in words_of_kind.items()}
    radius = true_radius(world.settings)
    out = {}
    for name, parts in queries.items():
        kinds = DATABASES.get(name, (name, "lidar"))
        out[name] = _recall(
            _joined(parts),
            _joined([databases[kind] for kind in kinds if kind in databases]),
            world,
            radius,
        )
    return out


def true_radius(settings: Resolved) -> float:
    """Metres within which a database word is the true one: the larger of 1.5 m (at 0.30 m voxels)
    and half a cell's diagonal.
    """
    v = settings.fusion.voxel_size
    stride = settings.descriptor.stride
    return v * max(RADIUS / 0.30, 0.5 * float(np.linalg.norm([stride, stride, LAYER])))


def _words(place: Place, described: Described, voxel_size: float) -> Words:
    return Words(
        apply(place.common_T_map, described.centre.astype(np.float64) * voxel_size),
        described.descriptor,
    )


def _joined(parts: list[Words]) -> Words:
    parts = [p for p in parts if len(p.centre)] or parts[:1]
    return Words(
        np.concatenate([p.centre for p in parts]), np.concatenate([p.descriptor for p in parts])
    )


def _recall(queries: Words, database: Words, world: HeldOut, radius: float) -> float:
    """Of as many query words as are wanted, on as large a database as is wanted; drawn at random,
    always the same.
    """
    rng = np.random.default_rng(1)
    away = (
        cKDTree(database.centre).query(queries.centre)[0]
        if len(database.centre) and len(queries.centre)
        else np.zeros(0)
    )
    possible = rng.permutation(np.flatnonzero(away < radius))[: world.queries]
    queries = queries[np.sort(possible)]
    if not len(queries.centre):
        return 0.0
    beside = cKDTree(queries.centre).query(database.centre)[0] < BESIDE * radius / RADIUS
    others = rng.permutation(np.flatnonzero(~beside))[: max(0, world.database - int(beside.sum()))]
    database = database[np.sort(np.r_[np.flatnonzero(beside), others])]
    return float(found_again(queries, database, radius).mean())


def found_again(
    queries: Words, database: Words, radius: float, nearest: int = NEAREST
) -> NDArray[np.bool_]:
    """Which words (m,) have one of their ``nearest`` descriptors (L2) within ``radius`` metres of
    where they truly are.
    """
    out = np.zeros(len(queries.centre), bool)
    length = np.einsum("nd,nd->n", database.descriptor, database.descriptor)
    k = min(nearest, len(length))
    for i in range(0, len(out), BLOCK):
        rows = slice(i, i + BLOCK)
        distance = length - 2 * queries.descriptor[rows] @ database.descriptor.T
        best = np.argpartition(distance, k - 1, axis=1)[:, :k]
        away = np.linalg.norm(database.centre[best] - queries.centre[rows, None], axis=2)
        out[rows] = (away < radius).any(1)
    return out

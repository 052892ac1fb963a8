"""`semloc benchmark retrieval`: recall of trained descriptors beside random ones and FPFH."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from semloc_logs.benchmarks.descriptors.held_out import HeldOut, Size, held_out
from semloc_logs.benchmarks.descriptors.open3d_fpfh import fpfh_describes
from semloc_logs.benchmarks.descriptors.places import Place, Street
from semloc_logs.benchmarks.descriptors.recall import (
    NoEncoder,
    count_subvolumes,
    network_describes,
    recalls,
    retrieval_recall,
)
from semloc_logs.errors import SettingsError
from semloc_logs.settings import Resolved
from semloc_logs.subvolumes.describe import load_encoder
from semloc_logs.subvolumes.network import random_encoder

Figures = dict[str, dict[str, float | str]]
Note = Callable[[str], None]
SEEDS = 3
# scenarios and their network
REAL = {"real_log": "semantic", "real_geometry_labels": "semantic", "real_geometric": "geometric"}


@dataclass(frozen=True, slots=True)
class RetrievalChoice:
    """Options of the benchmark.

    ``variants`` of the network, ``weights`` instead of the shipped ones, descriptors of the
    ``database`` and query words of each scenario, ``work``: a folder that keeps the simulated
    streets.
    """

    variants: tuple[str, ...] = ("semantic",)
    weights: Path | None = None
    database: int = 100_000
    queries: int = 2000
    work: Path | None = None


def retrieval_benchmark(
    choice: RetrievalChoice,
    peers: Mapping[str, str],
    settings: Resolved,
    real: Mapping[str, Street] | None = None,
    note: Note = lambda _: None,
) -> Figures:
    """Recall at 5 of each scenario: ``trained``, ``random`` (mean of three seeds) and ``fpfh``.

    ``peers`` names the Python that has FPFH. ``real`` streets, by names of their scenarios in
    ``REAL``, are searched among the simulated ones. SettingsError for another peer, or weights of
    one variant for both.
    """
    if set(peers) - {"fpfh"}:
        raise SettingsError(
            f"Unknown peer '{min(set(peers) - {'fpfh'})}' of retrieval: give --peer fpfh=PYTHON."
        )
    if choice.weights is not None and len(choice.variants) > 1:
        raise SettingsError(
            "One file of weights is for one variant: "
            "give --variant semantic or --variant geometric."
        )
    settings = densely(settings).resolved()
    with ExitStack() as stack:
        work = choice.work or Path(
            stack.enter_context(tempfile.TemporaryDirectory(prefix="semloc-retrieval-"))
        )
        streets = held_out(
            work / "streets",
            settings,
            count_subvolumes(settings),
            Size(choice.database, choice.queries),
            note,
        )
        figures: Figures = {}
        fpfh: dict[str, float] = {}
        for variant in choice.variants:
            world = replace(
                streets,
                others=tuple(
                    street for name, street in (real or {}).items() if REAL[name] == variant
                ),
            )
            columns = {"trained": retrieval_recall(world, load_encoder(variant, choice.weights))}
            note(f"{variant}: trained weights are measured")
            results = [
                retrieval_recall(world, random_encoder(variant, seed)) for seed in range(SEEDS)
            ]
            columns["random"] = {
                name: float(np.mean([f[name] for f in results])) for name in results[0]
            }
            note(f"{variant}: random weights are measured")
            if "fpfh" in peers:
                fpfh |= _fpfh(world, peers["fpfh"], work / "fpfh")
                columns["fpfh"] = fpfh
            for name in columns["trained"]:
                row = (
                    name
                    if variant == "semantic" or name.startswith("real")
                    else f"{variant}_{name}"
                )
                figures[row] = {who: column[name] for who, column in columns.items()} | {
                    "unit": "recall at 5"
                }
        return figures


def densely(settings: Resolved) -> Resolved:
    """Databases have descriptors at a stride of four voxels here: finer than `semloc describe` by
    default, so that 1.5 m tell right from wrong.
    """
    return settings.model_copy(
        update={"descriptor": settings.descriptor.model_copy(update={"stride": 4})}
    )


def _fpfh(world: HeldOut, python: str, folder: Path) -> dict[str, float]:
    def places() -> Iterator[tuple[Place, bool]]:
        for street in world.streets():
            yield from ((place, False) for _, place in street.database)
            yield from ((place, True) for places in street.queries.values() for place in places)

    same = network_describes(NoEncoder(), world.settings)
    return recalls(
        world, fpfh_describes(python, folder, places(), same, world.settings.fusion.voxel_size)
    )

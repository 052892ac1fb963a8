"""The benchmarks by name: what `semloc benchmark NAME` runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from semloc_logs.errors import SettingsError
from semloc_logs.settings import Resolved

Figures = dict[str, dict[str, float | str]]
Busiest = list[tuple[float, int, str]]

SUITE = ("reading", "encoder", "verification", "annotate")  # of speed, on data made on the spot
RETRIEVAL_QUERIES = 2000
LOCALISATION_QUERIES = 40
EXPERIMENTS = ("paper",)  # names that the room of the experiments runs


@dataclass(frozen=True, slots=True)
class Request:
    """What a benchmark is told; each takes of it what it needs."""

    settings: Resolved
    logs: tuple[Path, ...] = ()
    truth: Path | None = None
    peers: Mapping[str, str] = field(default_factory=dict)
    lengths: tuple[int, ...] = (1, 4, 16)
    variant: str = "semantic"
    weights: Path | None = None
    database: int = 100_000
    queries: int | None = None
    picture: Path | None = None
    work: Path | None = None
    note: Callable[[str], None] = lambda _: None


@dataclass(frozen=True, slots=True)
class Outcome:
    """``figures`` by name, each with ``ours``, the unit and the peers; of a profile also the
    ``busiest`` functions: seconds, calls, name.
    """

    figures: Figures
    busiest: Busiest = field(default_factory=list)


def run_named(name: str, request: Request) -> Outcome:
    """Run the benchmark called ``name``. Raises SettingsError for what it cannot be run with."""
    if name not in BENCHMARKS:
        known = ", ".join((*BENCHMARKS, *EXPERIMENTS))
        raise SettingsError(f"Unknown benchmark '{name}': there are {known}.")
    return BENCHMARKS[name](request)


def _logs_of(request: Request, name: str) -> tuple[Path, ...]:
    if not request.logs:
        raise SettingsError(f"Benchmark {name} needs at least one log.")
    return request.logs


def _pipeline(request: Request) -> Outcome:
    from semloc_logs.benchmarks.speed.profiles import profile_pipeline

    return Outcome(*profile_pipeline(_logs_of(request, "pipeline"), request.settings))


def _fuse(request: Request) -> Outcome:
    from semloc_logs.benchmarks.speed.profiles import profile_fuse

    return Outcome(*profile_fuse(_logs_of(request, "fuse"), request.settings))


def _memory(request: Request) -> Outcome:
    from semloc_logs.benchmarks.speed.fusion_memory import memory_curve

    return Outcome(memory_curve(request.lengths, request.settings))


def _words(request: Request) -> Outcome:
    from semloc_logs.benchmarks.descriptors.real_logs import word_recalls

    if len(request.logs) != 2 or request.truth is None:
        raise SettingsError("Benchmark words needs two logs and --truth FILE.")
    return Outcome(word_recalls(request.logs, request.truth, request.settings))


def _labels(request: Request) -> Outcome:
    from semloc_logs.benchmarks.labels.label_quality import measure_labels

    return Outcome(measure_labels(_logs_of(request, "labels"), request.settings))


def _realism(request: Request) -> Outcome:
    from semloc_logs.benchmarks.labels.realism import measure_realism

    return Outcome(measure_realism(_logs_of(request, "realism"), request.settings))


def _fusion(request: Request) -> Outcome:
    from semloc_logs.benchmarks.speed.fusion_speed import fusion_speed

    return Outcome(fusion_speed(request.settings, request.logs, dict(request.peers)))


def _search(request: Request) -> Outcome:
    from semloc_logs.benchmarks.speed.search_speed import search_speed

    return Outcome(search_speed(request.settings, peers=dict(request.peers)))


def _retrieval(request: Request) -> Outcome:
    from semloc_logs.benchmarks.descriptors.real_logs import real_streets
    from semloc_logs.benchmarks.descriptors.retrieval import RetrievalChoice, retrieval_benchmark

    truth = request.truth
    if (truth is None) != (not request.logs) or len(request.logs) not in (0, 2):
        raise SettingsError("Benchmark retrieval takes two logs and --truth FILE, or neither.")
    variants = ("semantic", "geometric") if request.variant == "both" else (request.variant,)
    queries = request.queries or RETRIEVAL_QUERIES
    choice = RetrievalChoice(variants, request.weights, request.database, queries, request.work)
    real = None if truth is None else real_streets(request.logs, truth, request.settings)
    peers = dict(request.peers)
    return Outcome(retrieval_benchmark(choice, peers, request.settings, real, request.note))


def _completion(request: Request) -> Outcome:
    from semloc_logs.benchmarks.descriptors.completion import completion_benchmark

    if request.variant == "both":
        raise SettingsError(
            "Benchmark completion is of one variant:"
            " give --variant semantic or --variant geometric."
        )
    figures = completion_benchmark(
        request.variant,
        request.settings,
        request.weights,
        request.work,
        request.picture,
        request.note,
    )
    return Outcome(figures)


def _scaling(request: Request) -> Outcome:
    from semloc_logs.benchmarks.speed.search_scaling import scaling_benchmark

    return Outcome(scaling_benchmark(request.settings, request.work, request.note))


def _localisation(request: Request) -> Outcome:
    from semloc_logs.benchmarks.localisation.localisation import localisation_benchmark

    queries = request.queries or LOCALISATION_QUERIES
    peers = dict(request.peers)
    figures = localisation_benchmark(request.work, queries, peers, request.settings, request.note)
    return Outcome(figures)


def _suite(request: Request, name: str) -> Outcome:
    from semloc_logs.benchmarks.speed import suite

    return Outcome(getattr(suite, name)(request.settings))


BENCHMARKS: dict[str, Callable[[Request], Outcome]] = {
    **{name: partial(_suite, name=name) for name in SUITE},
    "fusion": _fusion,
    "search": _search,
    "memory": _memory,
    "fuse": _fuse,
    "pipeline": _pipeline,
    "words": _words,
    "labels": _labels,
    "realism": _realism,
    "retrieval": _retrieval,
    "completion": _completion,
    "scaling": _scaling,
    "localisation": _localisation,
}

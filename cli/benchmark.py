"""semloc benchmark."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .console import console
from .options import Command, console_options, json_option, pairs, path_option, settings_options

if TYPE_CHECKING:
    from semloc_logs.settings import Resolved

Rows = list[tuple[float, int, str]]


def _lengths(_: click.Context, __: click.Parameter, value: str) -> tuple[int, ...]:
    try:
        lengths = tuple(int(part) for part in value.split(","))
    except ValueError:
        raise click.BadParameter(
            f"{value!r} is not a list of whole numbers such as 1,4,16"
        ) from None
    if min(lengths) < 1:
        raise click.BadParameter("lengths begin at 1")
    return lengths


@click.command(cls=Command)
@click.argument("name", metavar="NAME")
@click.argument("logs", metavar="[LOG]...", nargs=-1, type=click.Path(path_type=Path))
@click.option("--truth", type=click.Path(path_type=Path), help="Truth file of the logs, for words.")
@click.option(
    "--peer",
    "peers",
    metavar="NAME=PYTHON",
    multiple=True,
    callback=pairs,
    help="What to compare with and the Python that has it (benchmarks/README.md): octomap or"
    " kiss_slam for fusion, fpfh for retrieval, "
    "faiss for search, scan_context, fpfh_ransac, kiss_matcher or map_closures for localisation.",
)
@click.option(
    "--lengths",
    default="1,4,16",
    callback=_lengths,
    help="Multiples of a drive of 250 m, for memory; default 1,4,16.",
)
@click.option(
    "--variant",
    type=click.Choice(["semantic", "geometric", "both"]),
    default="semantic",
    show_default=True,
    help="Network with classes, without, or both, for retrieval and completion.",
)
@path_option("--weights", help="Weights instead of the shipped ones, for retrieval and completion.")
@click.option(
    "--database",
    type=click.IntRange(1),
    default=100_000,
    show_default=True,
    metavar="N",
    help="Descriptors, for retrieval.",
)
@click.option(
    "--queries",
    type=click.IntRange(1),
    metavar="N",
    help="Words that ask, for retrieval (default 2000), or queries of each condition, for"
    " localisation (default 40).",
)
@path_option("--picture", help="PNG of some subvolumes to write, for completion.")
@path_option(
    "--work",
    help="Folder that keeps the simulated streets, for retrieval, completion, scaling and"
    " localisation.",
)
@json_option
@settings_options
@console_options
def command(
    name: str,
    logs: tuple[Path, ...],
    truth: Path | None,
    peers: dict[str, str],
    lengths: tuple[int, ...],
    variant: str,
    weights: Path | None,
    database: int,
    queries: int | None,
    picture: Path | None,
    work: Path | None,
    as_json: bool,
    settings: Resolved,
) -> int:
    """Figures of speed and quality, measured here and now, beside what else does the same.

    NAME is reading, fusion, encoder, search or annotate (on simulated data; fusion takes sweeps of
    LOGs too), memory (peak of fusing drives of several lengths), fuse (one session of the LOGs,
    beside reading and integrating alone), pipeline (seconds, memory and profile of a run on the
    LOGs), words (recall of word matches between two LOGs whose truth is known, trained weights
    beside random ones), labels (classes from geometry against the labels recorded in the LOGs),
    realism (simulated sweeps beside the labelled ones of the LOGs), retrieval (recall of
    descriptors on held-out simulated streets and, with --truth, of the first LOG's in the second
    one's), completion (of incomplete subvolumes of such streets), scaling (the look-up of words in
    maps of 10, 100 and 1000 km), or localisation (whole queries in a simulated city beside other
    systems). Close other programs first: times are wall-clock.

    \b
    Example:  semloc benchmark reading --json
              semloc benchmark fusion --peer octomap=octomap/bin/python
              semloc benchmark pipeline monday.mcap tuesday.bag
              semloc benchmark words monday.mcap tuesday.bag --truth truth.json
              semloc benchmark labels labelled.mcap
              semloc benchmark realism labelled.mcap
              semloc benchmark retrieval --work streets --peer fpfh=open3d/bin/python
              semloc benchmark localisation --work city --peer kiss_matcher=kiss/bin/python
    """
    if name == "words" and (len(logs) != 2 or truth is None):
        raise click.UsageError("words needs two logs and --truth FILE.")
    if name == "retrieval" and ((truth is None) != (not logs) or len(logs) not in (0, 2)):
        raise click.UsageError("retrieval takes two logs and --truth FILE, or neither.")
    if name == "completion" and variant == "both":
        raise click.UsageError(
            "completion is of one variant: give --variant semantic or --variant geometric."
        )
    if name in ("pipeline", "fuse", "labels", "realism") and not logs:
        raise click.UsageError(f"{name} needs at least one log.")
    with console.progress():
        if name == "retrieval":
            from semloc_logs.benchmarks.descriptors.real_logs import real_streets
            from semloc_logs.benchmarks.descriptors.retrieval import (
                RetrievalChoice,
                retrieval_benchmark,
            )

            variants = ("semantic", "geometric") if variant == "both" else (variant,)
            real = real_streets(logs, truth, settings) if truth is not None else None
            rows: Rows = []
            figures = retrieval_benchmark(
                RetrievalChoice(variants, weights, database, queries or 2000, work),
                peers,
                settings,
                real,
                console.note,
            )
        elif name == "completion":
            from semloc_logs.benchmarks.descriptors.completion import completion_benchmark

            figures = completion_benchmark(variant, settings, weights, work, picture, console.note)
            rows = []
        elif name == "scaling":
            from semloc_logs.benchmarks.speed.search_scaling import scaling_benchmark

            figures = scaling_benchmark(settings, work, console.note)
            rows = []
        elif name == "localisation":
            from semloc_logs.benchmarks.localisation.localisation import localisation_benchmark

            figures = localisation_benchmark(work, queries or 40, peers, settings, console.note)
            rows = []
        else:
            figures, rows = _measure(name, logs, truth, peers, lengths, settings)
    if as_json:
        console.result_json(figures)
        return 0
    columns = sorted(
        dict.fromkeys(p for row in figures.values() for p in row if p != "unit"),
        key=lambda p: p != "ours",
    )
    drawn = [
        (figure, *(_number(row.get(column)) for column in columns), str(row["unit"]))
        for figure, row in figures.items()
    ]
    console.table(name, ("figure", *(f"{p}#" for p in columns), "unit"), drawn)
    if rows:
        console.table(
            "where the time goes",
            ("s#", "calls#", "function"),
            [(f"{own:.2f}", str(calls), where) for own, calls, where in rows],
        )
    return 0


def _measure(
    name: str,
    logs: tuple[Path, ...],
    truth: Path | None,
    peers: dict[str, str],
    lengths: tuple[int, ...],
    settings: Resolved,
) -> tuple[dict[str, dict[str, Any]], Rows]:
    """The figures of benchmark ``name`` and, of a profile, the functions that took most time."""
    if name == "pipeline":
        from semloc_logs.benchmarks.speed.profiles import profile_pipeline

        return profile_pipeline(logs, settings)
    if name == "fuse":
        from semloc_logs.benchmarks.speed.profiles import profile_fuse

        return profile_fuse(logs, settings)
    if name == "memory":
        from semloc_logs.benchmarks.speed.memory import memory_curve

        return memory_curve(lengths, settings), []
    if name == "words" and truth is not None:
        from semloc_logs.benchmarks.descriptors.real_logs import word_recalls

        return word_recalls(logs, truth, settings), []
    if name == "labels":
        from semloc_logs.benchmarks.labels.label_quality import measure_labels

        return measure_labels(logs, settings), []
    if name == "realism":
        from semloc_logs.benchmarks.labels.realism import measure_realism

        return measure_realism(logs, settings), []
    if name == "fusion":
        from semloc_logs.benchmarks.speed.fusion_speed import fusion_speed

        return fusion_speed(settings, logs, peers), []
    if name == "search":
        from semloc_logs.benchmarks.speed.search_speed import search_speed

        return search_speed(settings, peers=peers), []
    from semloc_logs.benchmarks.speed.suite import run_benchmark

    return run_benchmark(name, settings), []


def _number(value: float | str | None) -> str | None:
    return f"{value:.4g}" if isinstance(value, int | float) else value

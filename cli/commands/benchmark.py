"""semloc benchmark."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..console import console
from ..options import Command, console_options, json_option, pairs, path_option, settings_options

if TYPE_CHECKING:
    from semloc_logs.benchmarks.named import Outcome, Request
    from semloc_logs.experiments.paper import PaperRequest
    from semloc_logs.settings import Resolved


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


def _names(_: click.Context, __: click.Parameter, value: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in value.split(",") if name.strip())


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
@path_option(
    "--weights",
    help="Weights instead of the shipped ones, for retrieval and completion; for paper a folder of"
    " networks.  [default: weights]",
)
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
@click.option("--quick", is_flag=True, help="A small scene in under ten minutes, for paper.")
@click.option(
    "--systems",
    metavar="NAME,...",
    default="",
    callback=_names,
    help="Systems instead of all, for paper; all-ours, all-baselines and all-ablations are groups.",
)
@click.option(
    "--sensors",
    metavar="NAME,...",
    default="",
    callback=_names,
    help="lidar or stereo instead of both, for paper.",
)
@click.option(
    "--pairs",
    "pair_list",
    type=click.Path(path_type=Path),
    help="Pairs of frames of the LOGs to be registered, a list of the LiDAR-Registration-Benchmark,"
    " for paper: the scenario pairs.",
)
@click.option(
    "--scenarios",
    metavar="NAME,...",
    default="",
    callback=_names,
    help="Scenarios instead of all, such as 0,90,180, for paper.",
)
@click.option(
    "--tables-only",
    is_flag=True,
    help="Tables and figures of the answers that are there, for paper; also while a run goes on.",
)
@path_option("-o", "--output", help="Folder of the run, for paper.  [default: paper]")
@click.option(
    "-j",
    "--jobs",
    type=click.IntRange(1),
    metavar="N",
    help="Processes that simulate and fuse, for paper.  [default: the cores]",
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
    quick: bool,
    systems: tuple[str, ...],
    sensors: tuple[str, ...],
    scenarios: tuple[str, ...],
    pair_list: Path | None,
    tables_only: bool,
    output: Path | None,
    jobs: int | None,
    as_json: bool,
    settings: Resolved,
) -> int:
    """Figures of speed and quality, measured here and now, beside what else does the same.

    On simulated data: reading, fusion (also on sweeps of LOGs), encoder, search, verification,
    annotate, memory (peak of fusing drives of several lengths), retrieval (recall of descriptors on
    held-out streets and, with --truth, of the first LOG's in the second one's), completion (of
    incomplete subvolumes of such streets), scaling (the look-up of words in maps of 10, 100 and
    1000 km), localisation (whole queries in a simulated city beside other systems).

    On LOGs: fuse (one session, beside reading and integrating alone), pipeline (seconds, memory and
    profile of a run), words (recall of word matches between two LOGs whose truth is known, trained
    weights beside random ones), labels (classes from geometry against recorded labels), realism
    (simulated sweeps beside labelled ones). Close other programs first: times are wall-clock.

    paper runs the experiments of the paper with every system that it compares, on simulated drives
    or on LOGs with --truth. It continues in its folder where it was interrupted.

    \b
    Example:  semloc benchmark reading --json
              semloc benchmark fusion --peer octomap=octomap/bin/python
              semloc benchmark pipeline monday.mcap tuesday.bag
              semloc benchmark words monday.mcap tuesday.bag --truth truth.json
              semloc benchmark labels labelled.mcap
              semloc benchmark realism labelled.mcap
              semloc benchmark retrieval --work streets --peer fpfh=open3d/bin/python
              semloc benchmark localisation --work city --peer kiss_matcher=kiss/bin/python
              semloc benchmark paper --quick
              semloc benchmark paper monday.mcap tuesday.bag --truth truth.json --systems paper
    """
    if name == "paper":
        from semloc_logs.experiments.paper import PaperRequest

        paper = PaperRequest(
            settings,
            output or Path("paper"),
            systems,
            quick,
            logs,
            truth,
            queries,
            sensors,
            scenarios,
            jobs,
            weights,
            tables_only,
            console.note,
            pair_list,
        )
        _run_paper(paper, as_json=as_json)
        return 0

    from semloc_logs.benchmarks.named import Request

    request = Request(
        settings,
        logs,
        truth,
        peers,
        lengths,
        variant,
        weights,
        database,
        queries,
        picture,
        work,
        console.note,
    )
    _run_named(name, request, as_json=as_json)
    return 0


def _run_paper(request: PaperRequest, *, as_json: bool) -> None:
    """The experiments of the paper, and the names of their files or the table as JSON."""
    from semloc_logs.experiments.paper import run_paper
    from semloc_logs.tables.table import read_json

    with console.progress():
        files = run_paper(request)
    if as_json:
        console.result_json(read_json(files.json))
        return
    for path in (files.table, files.json, *files.figures, files.answers):
        console.result(str(path))


def _run_named(name: str, request: Request, *, as_json: bool) -> None:
    """A benchmark, and its figures as a table or JSON."""
    from semloc_logs.benchmarks.named import run_named

    with console.progress():
        outcome = run_named(name, request)
    if as_json:
        console.result_json(outcome.figures)
    else:
        _show(name, outcome)


def _show(name: str, outcome: Outcome) -> None:
    """A table of the figures, ours first, and one of the busiest functions."""
    systems = dict.fromkeys(
        system for row in outcome.figures.values() for system in row if system != "unit"
    )
    columns = sorted(systems, key=lambda system: system != "ours")
    rows = [
        (figure, *(_number(row.get(column)) for column in columns), str(row["unit"]))
        for figure, row in outcome.figures.items()
    ]
    console.table(name, ("figure", *(f"{column}#" for column in columns), "unit"), rows)
    if outcome.busiest:
        busiest = [
            (f"{seconds:.2f}", str(calls), function) for seconds, calls, function in outcome.busiest
        ]
        console.table("where the time goes", ("s#", "calls#", "function"), busiest)


def _number(value: float | str | None) -> str | None:
    return f"{value:.4g}" if isinstance(value, int | float) else value

"""semloc vocabulary."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..console import console
from ..options import (
    Command,
    EngineChoice,
    console_options,
    engine_options,
    json_option,
    method_option,
    path_option,
    tables_settings_options,
)
from .train import packed_shards

if TYPE_CHECKING:
    from semloc_logs.settings import Resolved


@click.command(cls=Command)
@click.option(
    "--variant",
    type=click.Choice(["semantic", "geometric", "both"]),
    required=True,
    help="Network whose descriptors are clustered.",
)
@path_option(
    "-o",
    "--output",
    required=True,
    help="File of the vocabulary (.safetensors); of both: folder of the two files.",
)
@path_option(
    "-w", "--work", help="Use the fused sessions of this workspace instead of simulated scenes."
)
@path_option("--shards", help="Use the packed pairs (.parquet) of this folder instead.")
@path_option(
    "--checkpoint",
    help="Folder of packed pairs, such as 'semloc train' leaves; default: beside the output.",
)
@click.option("--scenes", type=int, metavar="N", help="Simulated scenes; default: training.scenes.")
@click.option(
    "--pairs",
    type=click.IntRange(1),
    help="Pairs of each scene, nine descriptors each; default: all.",
)
@json_option
@engine_options
@tables_settings_options
@method_option
@console_options
def command(
    variant: str,
    output: Path,
    work: Path | None,
    shards: Path | None,
    checkpoint: Path | None,
    pairs: int | None,
    as_json: bool,
    engine: EngineChoice,
    settings: Resolved,
) -> int:
    """Learn the words: descriptors of subvolumes are clustered, and each cluster gets thresholds
    for 64-bit codes.

    A vocabulary belongs to the weights that it was made with (--set descriptor.weights=FILE; the
    shipped ones by default). Use it with --set descriptor.vocabulary=FILE. Half a million
    descriptors (60 scenes) give 2^16 words; fewer are possible.

    \b
    Example:  semloc vocabulary --variant semantic -o words.safetensors -w work
              semloc vocabulary --variant both -o vocabularies --shards weights/checkpoint/simulated
    """
    from semloc_logs.engines.processes import cores
    from semloc_logs.training.runs import given_shards, learn_vocabulary, use_threads

    if variant == "both" and settings.descriptor.weights is not None:
        raise click.UsageError("descriptor.weights belong to one variant: name it with --variant.")
    if shards is not None and work is not None:
        raise click.UsageError("--shards and --work are alternatives.")
    with console.progress():
        if shards is not None:
            packed = given_shards(shards)
        else:
            with engine.open(settings.training.scenes) as opened:
                packed = packed_shards(
                    checkpoint or output.parent / "checkpoint", work, settings, opened
                ).every
        files = (
            {v: output / f"{v}.safetensors" for v in ("semantic", "geometric")}
            if variant == "both"
            else {variant: output}
        )
        use_threads(engine.jobs or cores())
        made = {}
        for name, file in files.items():
            made[name] = {
                "vocabulary": str(file),
                "descriptors": learn_vocabulary(name, packed, settings, file, pairs, console.note),
                "shards": len(packed),
            }
    if as_json:
        console.result_json(made if variant == "both" else made[variant])
    else:
        for report in made.values():
            console.result(
                f"{report['vocabulary']}: from {report['descriptors']} descriptors"
                f" of {report['shards']} scenes"
            )
    return 0

"""semloc vocabulary."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from .console import console
from .options import Command, EngineChoice, console_options, engine_options, json_option, path_option, settings_options
from .train import packed_shards

if TYPE_CHECKING:
    from semloc_logs.settings import Settings


@click.command(cls=Command)
@click.option("--variant", type=click.Choice(["semantic", "geometric"]), required=True, help="Network whose descriptors are clustered.")
@path_option("-o", "--output", required=True, help="File of the vocabulary (.safetensors).")
@path_option("-w", "--work", help="Use the fused sessions of this workspace instead of simulated scenes.")
@path_option("--checkpoint", help="Folder of packed pairs, such as that of 'semloc train'; default: beside the output.")
@click.option("--scenes", type=int, metavar="N", help="Simulated scenes; default: training.scenes.")
@click.option("--pairs", type=click.IntRange(1), default=150, show_default=True, help="Pairs of each scene, nine descriptors each.")
@json_option
@engine_options
@settings_options
@console_options
def command(
    variant: str,
    output: Path,
    work: Path | None,
    checkpoint: Path | None,
    pairs: int,
    as_json: bool,
    engine: EngineChoice,
    settings: Settings,
) -> int:
    """Learn the words: descriptors of subvolumes are clustered, and each cluster gets thresholds for 64-bit codes.

    A vocabulary belongs to the weights that it was made with (--set descriptor.weights=FILE; the shipped ones by default). Use it
    with --set descriptor.vocabulary=FILE.

    \b
    Example:  semloc vocabulary --variant semantic -o words.safetensors -w work
    """
    from semloc_logs.engines.engine import cores
    from semloc_logs.learning import learn_vocabulary, use_threads

    with console.progress():
        with engine.open(settings.training.scenes) as opened:
            shards = packed_shards(checkpoint or output.parent / "checkpoint", work, settings, opened)
        use_threads(engine.jobs or cores())
        console.note("Describing and clustering")
        count = learn_vocabulary(variant, shards, settings, output, pairs)
    if as_json:
        console.result_json({"vocabulary": str(output), "descriptors": count, "shards": len(shards)})
    else:
        console.result(f"{output}: from {count} descriptors of {len(shards)} scenes")
    return 0

"""semloc train."""

from __future__ import annotations

import math
import time
from contextlib import closing
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

if TYPE_CHECKING:
    from semloc_logs.engines import Engine
    from semloc_logs.settings import Resolved
    from semloc_logs.training.runs import Packed


@click.command(cls=Command)
@click.option(
    "--variant",
    type=click.Choice(["semantic", "geometric", "both"]),
    default="both",
    show_default=True,
    help="Network with classes, without, or both.",
)
@path_option("-o", "--output", required=True, help="Folder of the weights.")
@path_option(
    "-w",
    "--work",
    help="Train on the fused sessions of this workspace instead of simulated scenes.",
)
@click.option("--scenes", type=int, metavar="N", help="Simulated scenes; default: training.scenes.")
@click.option(
    "--samples",
    type=int,
    metavar="N",
    help="Subvolumes seen in training; default: training.samples.",
)
@path_option(
    "--checkpoint", help="Folder of checkpoints and packed pairs; default: OUTPUT/checkpoint."
)
@click.option(
    "--device",
    type=click.Choice(["auto", "cpu", "cuda"]),
    default="auto",
    show_default=True,
    help="Where the network trains.",
)
@click.option(
    "--minutes",
    type=click.FloatRange(min=0, min_open=True),
    help="Stop after so many minutes with a checkpoint to go on from.",
)
@path_option(
    "--snapshots",
    help="Folder for the weights after 1/32, 1/16, ... 1/2 of the samples: a learning curve.",
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
    checkpoint: Path | None,
    device: str,
    minutes: float | None,
    snapshots: Path | None,
    as_json: bool,
    engine: EngineChoice,
    settings: Resolved,
) -> int:
    """Learn the descriptor, self-supervised: an encoder-decoder completes what few frames saw to
    what all frames saw.

    Two scenes (or stretches of road) are held out and measured at the end. Scenes are simulated by
    --jobs processes while the network trains. Can be interrupted, or limited by --minutes (exit
    code 3): the same command goes on from the checkpoint. Use the result with --set
    descriptor.weights=FILE, and train a vocabulary for it.

    \b
    Example:  semloc train --variant semantic -o weights --scenes 60 --samples 250000
    """
    from semloc_logs.engines.processes import cores
    from semloc_logs.training.checkpoints import steps_done
    from semloc_logs.training.network_training import TrainingRun
    from semloc_logs.training.runs import device_of, learn_descriptor, use_threads
    from semloc_logs.training.schedule import samples_after

    folder = checkpoint or output / "checkpoint"
    chosen = device_of(device)
    deadline = time.monotonic() + (60 * minutes if minutes else math.inf)
    scores = {}
    with console.progress(), engine.open(settings.training.scenes) as opened:
        use_threads(engine.jobs or cores())
        for name in ("semantic", "geometric") if variant == "both" else (variant,):
            weights = output / f"{name}.safetensors"
            where = folder / f"{name}.safetensors"
            shards = packed_shards(
                folder, work, settings, opened, samples_after(steps_done(where), settings.training)
            )
            with closing(shards):
                run = TrainingRun(where, device=chosen, deadline=deadline, snapshots=snapshots)
                learned = learn_descriptor(name, shards, settings, run, weights, console.note)
            if learned is None:
                opened.stop()  # scenes that are being made are made again
                console.warn(
                    f"{minutes:g} minutes are over and {where} is written: the same command goes"
                    " on from there."
                )
                return 3
            scores[name] = learned
            console.note(f"{weights} written")
    if as_json:
        console.result_json(
            {
                name: {"weights": str(output / f"{name}.safetensors"), **learned}
                for name, learned in scores.items()
            }
        )
    else:
        figures = sorted({figure for learned in scores.values() for figure in learned})
        rows = [
            (figure, *(f"{learned[figure]:.4f}" for learned in scores.values()))
            for figure in figures
        ]
        console.table("On two held-out scenes", ("figure", *(f"{name}#" for name in scores)), rows)
        for name in scores:
            console.result(str(output / f"{name}.safetensors"))
    return 0


def packed_shards(
    folder: Path, work: Path | None, settings: Resolved, engine: Engine, samples: int = 0
) -> Packed:
    """Shards of pairs from the sessions of ``work`` or, without one, from simulated scenes;
    ``samples`` have been seen of them.
    """
    from semloc_logs.simulation.meshes.world import require_ray_caster
    from semloc_logs.training.runs import session_shards, simulated_shards
    from semloc_logs.workspace import Workspace

    if work is None:
        require_ray_caster("semloc train")
        return simulated_shards(folder, settings, engine, console.note, samples)
    return session_shards(folder, Workspace(work).sessions(), settings, engine, console.note)

"""Learning the descriptor and the words, beside the pipeline: shards of pairs -> weights ->
vocabulary, all resumable.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import semloc_logs
from semloc_logs.engines import Engine
from semloc_logs.engines.streamed import Growing
from semloc_logs.errors import SettingsError
from semloc_logs.settings import Resolved, Training
from semloc_logs.subvolumes.cut import plain_name
from semloc_logs.subvolumes.describe import load_encoder
from semloc_logs.subvolumes.plain_describe import load_plain_encoder
from semloc_logs.subvolumes.weight_files import samples_of, save_weights
from semloc_logs.training.completion_scores import completion_scores
from semloc_logs.training.descriptor_samples import plain_shard_descriptors, shard_descriptors
from semloc_logs.training.network_training import Progress, TrainingRun, train
from semloc_logs.training.own_sessions import cut_stretch, stretch_tasks
from semloc_logs.training.pairs import read_shard, rows_of
from semloc_logs.training.scene_shards import make_shard, scene_tasks
from semloc_logs.training.schedule import scene_window
from semloc_logs.words.plain_vocabulary import save_plain_vocabulary, train_plain_vocabulary
from semloc_logs.words.vocabulary import save_vocabulary, train_vocabulary
from semloc_logs.workspace import SessionFolder

Note = Callable[[str], None]
HELD_OUT = 2  # shards that only measure
SCORED = 600  # pairs of each of them
SCENES_AHEAD = 8  # scenes made before the training needs them
# scenes that stay after their use: another variant that is trained in turn needs them, too
SCENES_KEPT = 256
REPORT_SECONDS = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Packed:
    """Shards of pairs to train on, and shards that only measure.

    ``train[i]`` may wait until it is made. ``drop(n)`` removes the used ones before number n; they
    are made again when they are needed again.
    """

    train: Sequence[Path]
    held_out: Sequence[Path]
    drop: Callable[[int], None] = lambda _: None

    @property
    def every(self) -> list[Path]:
        """All of them, waited for."""
        return [*self.train, *self.held_out]

    def close(self) -> None:
        """Make no further shards."""
        for shards in (self.train, self.held_out):
            if isinstance(shards, Growing):
                shards.close()


def simulated_shards(
    folder: Path, settings: Resolved, engine: Engine, note: Note, samples: int = 0
) -> Packed:
    """Pairs from ``training.scenes`` simulated scenes, for a training that has seen ``samples``.

    They are made in the order in which training uses them, a few ahead of it, while ``engine`` is
    open; existing shards for the same settings stay. Shards that measure are made when they are
    read.
    """
    tasks = scene_tasks(
        _shard_folder(folder, "simulated", settings), settings.training.scenes, settings
    )
    count = len(tasks) - HELD_OUT if len(tasks) > HELD_OUT else len(tasks)
    first = scene_window(samples, count, settings.training.method).start
    made = engine.map(make_shard, tasks[first:count])
    train = Growing(
        made, count, lambda n: note(f"scene {n} of {count}"), first=first, ahead=SCENES_AHEAD
    )
    held_out = Growing(engine.map(make_shard, tasks[count:]), len(tasks) - count, ahead=0)
    kept = first

    def drop(before: int) -> None:
        nonlocal kept
        for task in tasks[kept : max(kept, before)]:
            task.shard.unlink(missing_ok=True)
        kept = max(kept, before)

    return Packed(train, held_out, drop)


def session_shards(
    folder: Path, sessions: Sequence[SessionFolder], settings: Resolved, engine: Engine, note: Note
) -> Packed:
    """Pairs from fused sessions with poses, a shard for each stretch of road.

    Raises SettingsError when there is none.
    """
    tasks = stretch_tasks(_shard_folder(folder, "sessions", settings), sessions, settings)
    if not tasks:
        raise SettingsError(
            "No session of the workspace has poses and enough keyframes to train on: "
            "fuse longer drives with 'semloc fuse'."
        )
    out = []
    for shard in engine.map(cut_stretch, tasks):
        out.append(shard)
        note(f"stretch {len(out)} of {len(tasks)}")
    full = [path for path in out if rows_of(path)]
    return Packed(full[:-HELD_OUT], full[-HELD_OUT:]) if len(full) > HELD_OUT else Packed(full, [])


def given_shards(folder: Path) -> list[Path]:
    """The shards (.parquet) of a folder of packed pairs; SettingsError without any."""
    shards = sorted(folder.glob("*.parquet"))
    if not shards:
        raise SettingsError(
            f"{folder}: no shards of packed pairs (.parquet); "
            "'semloc train' leaves them below its checkpoint folder."
        )
    return shards


def _shard_folder(folder: Path, kind: str, settings: Resolved) -> Path:
    """Shards of other settings lie in another folder."""
    t = settings.training
    relevant = settings.model_copy(
        update={"training": Training(seed=t.seed, shift=t.shift, turn=t.turn, tilt=t.tilt)}
    )
    return folder / f"{kind}-{relevant.fingerprint('fusion', 'training')}"


class _Reporter:
    """Notes of a training's progress, every few seconds and at its end."""

    def __init__(self, variant: str, samples: int, note: Note) -> None:
        self._variant = variant
        self._samples = samples
        self._note = note
        self._started = time.monotonic()
        self._last = 0.0
        self._first_samples: int | None = None

    def take(self, step: Progress) -> None:
        """Report one step, if it is time."""
        now = time.monotonic()
        if self._first_samples is None:
            self._first_samples = step.samples
        if now - self._last < REPORT_SECONDS and step.samples < self._samples:
            return
        self._last = now
        rate = (step.samples - self._first_samples) / max(now - self._started, 1e-9)
        self._note(
            f"{self._variant}: {min(step.samples, self._samples)} of {self._samples} samples, "
            f"{rate:.0f} a second, reconstruction {step.reconstruction:.3f}, "
            f"contrastive {step.contrastive:.3f}, matched {step.matched:.0%}"
        )


def learn_descriptor(
    variant: str,
    shards: Packed,
    settings: Resolved,
    run: TrainingRun,
    output: Path,
    note: Note,
) -> dict[str, float] | None:
    """Train ``variant``, measure on the held-out shards, write the weights with a card; the scores.

    Continues from the checkpoint of ``run``, if any. None, with a checkpoint, when its deadline
    passes before the end. Raises SettingsError when there are too few shards to hold any out.
    """
    if not len(shards.held_out):
        raise SettingsError(
            f"Training needs at least {HELD_OUT + 1} scenes or stretches of road, "
            f"not {len(shards.train)}: two of them only measure."
        )
    reporter = _Reporter(variant, settings.training.samples, note)

    def on_step(step: Progress) -> None:
        window = scene_window(step.samples, len(shards.train), settings.training.method)
        shards.drop(window.start - SCENES_KEPT)
        reporter.take(step)

    model = train(variant, shards.train, settings.training, run, on_step)
    if model is None:
        return None
    held_out = [tuple(part[:SCORED] for part in read_shard(shard)) for shard in shards.held_out]
    part, whole, other = (np.concatenate([pairs[k] for pairs in held_out]) for k in range(3))
    scores = completion_scores(model.to("cpu"), (part, whole, other))
    save_weights(output, model, _card(settings, len(shards.train), scores=scores))
    return scores


def learn_vocabulary(
    variant: str,
    shards: Sequence[Path],
    settings: Resolved,
    output: Path,
    pairs_per_shard: int | None = None,
    note: Note = lambda _: None,
) -> int:
    """A vocabulary from the descriptors of the shards' complete views; the number of descriptors.

    2^16 words need half a million descriptors or more to lie well; with fewer there are words of
    few descriptors or of none.
    """
    if settings.training.method == "paper":
        return _learn_plain_vocabulary(variant, shards, settings, output, pairs_per_shard, note)
    threads = torch.get_num_threads()
    encoder = load_encoder(variant, settings.descriptor.weights)
    use_threads(threads)  # loading left one
    descriptors = shard_descriptors(shards, encoder, pairs_per_shard, note)
    note(f"{variant}: clustering {len(descriptors)} descriptors")
    vocabulary = train_vocabulary(descriptors, seed=settings.training.seed)
    save_vocabulary(output, vocabulary, _words_card(settings, shards, variant, len(descriptors)))
    return len(descriptors)


def _learn_plain_vocabulary(
    variant: str,
    shards: Sequence[Path],
    settings: Resolved,
    output: Path,
    pairs_per_shard: int | None,
    note: Note,
) -> int:
    """The same of the paper's network."""
    threads = torch.get_num_threads()
    encoder = load_plain_encoder(variant, settings.descriptor.weights)
    use_threads(threads)
    descriptors = plain_shard_descriptors(shards, encoder, pairs_per_shard, note)
    note(f"{variant}: clustering {len(descriptors)} descriptors")
    words = train_plain_vocabulary(descriptors, seed=settings.training.seed)
    card = _words_card(settings, shards, variant, len(descriptors))
    save_plain_vocabulary(output, words, card)
    return len(descriptors)


def use_threads(count: int) -> None:
    """Let the network use so many cores."""
    torch.set_num_threads(count)


def _words_card(
    settings: Resolved, shards: Sequence[Path], variant: str, descriptors: int
) -> dict[str, str]:
    """The origin of words: the samples are those that their weights have seen."""
    name = plain_name(variant) if settings.training.method == "paper" else variant
    samples = samples_of(name, settings.descriptor.weights)
    facts = {"variant": variant, "descriptors": descriptors, "samples": samples or "unknown"}
    return _card(settings, len(shards), **facts)


def _card(settings: Resolved, shards: int, **facts: Any) -> dict[str, str]:
    """The origin of a model, as strings for the file's metadata."""
    training = settings.training
    card = {
        "version": semloc_logs.__version__,
        "samples": training.samples,
        "shards": shards,
        "seed": training.seed,
    }
    card |= {
        "voxel_size": settings.fusion.voxel_size,
        "training": training.model_dump(mode="json"),
        **facts,
    }
    return {k: v if isinstance(v, str) else json.dumps(v, sort_keys=True) for k, v in card.items()}


def device_of(name: str) -> str:
    """``cpu`` or ``cuda`` for ``auto``, ``cpu`` or ``cuda``; SettingsError without such a GPU."""
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise SettingsError(
            "torch finds no GPU that it can use: "
            "train with --device cpu, or install a torch build for this GPU."
        )
    return name

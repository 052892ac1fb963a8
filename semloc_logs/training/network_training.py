"""Training of the encoder-decoder on packed pairs (paper 3.2 and 4.3, supplement 1), on a CPU or a
GPU, resumable from a checkpoint.

Beside the paper's completion loss a contrastive term (InfoNCE over the batch) pulls the descriptor
of an incomplete subvolume towards the descriptor of the complete one seen a little shifted and
turned, which is what the database holds. Adam replaces ADADELTA because the shipped runs see few
samples. With ``training.method=paper`` the network of the paper's Fig. 2 is trained as its
supplement has it: single subvolumes, completion and prior alone, ADADELTA at a constant rate.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from semloc_logs.errors import SettingsError
from semloc_logs.settings import Training
from semloc_logs.subvolumes.cut import CLASSES, code_table
from semloc_logs.subvolumes.network import Completion, Network, descriptors
from semloc_logs.subvolumes.plain_network import PlainCompletion
from semloc_logs.subvolumes.weight_files import save_weights
from semloc_logs.training.batches import Batch, OutOfTime, batches
from semloc_logs.training.checkpoints import resume, save_checkpoint
from semloc_logs.training.pairs import MIN_OCCUPIED
from semloc_logs.training.schedule import learning_rate, plateau_end, samples_after, steps_of
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE

RATE = 1.5e-3
BATCH_OF_RATE = 12  # a larger batch steps farther, with the square root as Adam wants it
TEMPERATURE = 0.1
MAX_GRADIENT = 10.0  # norm, to which a larger one is cut


@dataclass(frozen=True, slots=True)
class Progress:
    """Of one step: samples seen so far, losses, share of the batch's incomplete subvolumes whose
    partner is nearest.
    """

    samples: int
    loss: float
    reconstruction: float
    contrastive: float
    matched: float


def _seen(part: Tensor) -> Tensor:
    """Which of the 3 x 3 subvolumes of each wide one hold enough occupied voxels to be described,
    flat (b * 9,).
    """
    columns = ((part != FREE_STATE) & (part != UNOBSERVED_STATE)).sum(3, dtype=torch.float32)[
        :, None, 8:-8, 8:-8
    ]
    return (F.avg_pool2d(columns, 32, stride=8) * 32**2).round().flatten() >= MIN_OCCUPIED


def targets(complete: Tensor, table: Tensor, classes: int) -> tuple[Tensor, Tensor]:
    """Class indices of the complete subvolumes and which voxels count: unobserved ones and occupied
    ones of unknown class do not.
    """
    codes = table[complete.long()]
    known = codes <= classes
    return torch.where(known, codes, 0).long(), known


@dataclass(slots=True, eq=False)
class _Losses:
    total: Tensor
    reconstruction: Tensor
    contrastive: Tensor
    matched: float

    def progress(self, samples: int) -> Progress:
        """These losses as numbers, after so many samples."""
        return Progress(
            samples,
            float(self.total.detach()),
            float(self.reconstruction.detach()),
            float(self.contrastive.detach()),
            self.matched,
        )


def _losses(
    model: Network, batch: Batch, noise: Tensor, table: Tensor, training: Training
) -> _Losses:
    classes = CLASSES[model.encoder.variant]
    device = noise.device.type
    target, known = targets(model.arranged(batch.complete), table, classes)
    with torch.autocast(device, dtype=torch.bfloat16):
        logits, mu, log_variance = model(table[batch.incomplete.long()], noise)
        # the complete view is the goal; a gradient through it too would cost a third more
        with torch.no_grad():
            partner = (
                model.encoder(table[batch.other.long()]) if training.contrastive_weight else mu
            )
    entropy = F.cross_entropy(logits[None], target[None], reduction="none").float()
    weight = torch.where(target < classes, training.occupied_weight, 1.0) * known
    reconstruction = (entropy * weight).sum() / weight.sum().clamp(min=1.0)
    middle = mu[:, :, mu.shape[2] // 2, mu.shape[3] // 2].float()
    log_variance = log_variance.float()
    prior = 0.5 * (middle.square() + log_variance.exp() - 1 - log_variance).mean()
    contrastive = mu.new_zeros(())
    matched = 0.0
    if training.contrastive_weight:
        seen = _seen(batch.incomplete)
        similarity = descriptors(mu)[seen] @ descriptors(partner)[seen].T / TEMPERATURE
        own = torch.arange(len(similarity), device=similarity.device)
        # dropout can take the last subvolume that is full enough, and the mean of nothing is NaN
        if len(own):
            contrastive = 0.5 * (
                F.cross_entropy(similarity, own) + F.cross_entropy(similarity.T, own)
            )
            matched = float((similarity.argmax(1) == own).float().mean())
    total = (
        training.reconstruction_weight * reconstruction
        + prior
        + training.contrastive_weight * contrastive
    )
    return _Losses(total, reconstruction, contrastive, matched)


def _adam(model: Network) -> torch.optim.Optimizer:
    return torch.optim.Adam(model.parameters(), lr=RATE)


def _adadelta(model: Network) -> torch.optim.Optimizer:
    return torch.optim.Adadelta(model.parameters(), lr=1.0, rho=0.95, eps=1e-8)


@dataclass(frozen=True, slots=True)
class Recipe:
    """How the network of a method is made and stepped.

    ``rate`` is the share of the optimiser's rate at a step of so many; gradients with a norm above
    ``max_gradient`` are cut to it.
    """

    network: Callable[[str, int], Network]
    optimiser: Callable[[Network], torch.optim.Optimizer]
    rate: Callable[[int, int], float]
    scaled: bool  # the rate, with the square root of the batch
    max_gradient: float


def _constant(step: int, steps: int) -> float:
    return 1.0


RECIPES = {
    "ours": Recipe(Completion, _adam, learning_rate, True, MAX_GRADIENT),
    "paper": Recipe(PlainCompletion, _adadelta, _constant, False, math.inf),
}


@dataclass(frozen=True, slots=True)
class TrainingRun:
    """Where and for how long a network is trained.

    ``checkpoint`` is renewed every ``save_every`` steps. Training stops when the clock
    ``time.monotonic()`` passes ``deadline``. ``snapshots`` is a folder that gets the weights after
    1/32, 1/16, ... 1/2 of the steps, for a learning curve. On the ``device`` cuda the network is
    compiled. Another ``network`` and ``optimiser`` than the method's are for comparison.
    """

    checkpoint: Path
    save_every: int = 100
    device: str = "cpu"
    deadline: float = math.inf
    snapshots: Path | None = None
    network: Callable[[str, int], Network] | None = None
    optimiser: Callable[[Network], torch.optim.Optimizer] | None = None

    @property
    def plateau(self) -> Path:
        """The checkpoint at which the rate begins to fall."""
        return self.checkpoint.with_suffix(".plateau.safetensors")


def train(
    variant: str,
    shards: Sequence[Path],
    training: Training,
    run: TrainingRun,
    on_step: Callable[[Progress], None] = lambda _: None,
) -> Network | None:
    """Train from scratch or from the checkpoint of ``run``; returns the finished network.

    None, with a checkpoint from which the same call continues, when the time is over. ``shards``
    may wait in ``[i]`` for scenes that are still being made. The checkpoint at which the rate
    begins to fall stays as NAME.plateau.safetensors: as the checkpoint of a training with more
    samples, it saves the steps until there. Raises SettingsError without shards and WorkspaceError
    when the checkpoint is of another run.
    """
    if not len(shards):
        raise SettingsError(
            "There is nothing to train on: give sessions with keyframes, or scenes to simulate."
        )
    torch.manual_seed(training.seed)
    recipe = RECIPES[training.method]
    model = (run.network or recipe.network)(variant, training.latent).to(run.device)
    optimiser = (run.optimiser or recipe.optimiser)(model)
    steps = steps_of(training)
    done = resume(run.checkpoint, model, optimiser, training) if run.checkpoint.exists() else 0
    if run.device == "cuda":
        model.encoder.compile()
        model.decoder.compile()
    table = torch.from_numpy(code_table(variant)).to(run.device)
    rate = optimiser.defaults["lr"]
    if recipe.scaled:
        rate *= math.sqrt(training.batch / BATCH_OF_RATE)
    model.train()
    keeper = _Keeper(run, model, optimiser, training)
    coming = batches(shards, training, done, steps, run.device, deadline=run.deadline)
    for step in range(done, steps):
        try:
            batch = next(coming)
        except OutOfTime:
            if step > done:
                keeper.save(step)
            return None
        for group in optimiser.param_groups:
            group["lr"] = rate * recipe.rate(step, steps)
        noise = _noise(training, step).to(run.device)
        losses = _losses(model, batch, noise, table, training)
        optimiser.zero_grad(set_to_none=True)
        losses.total.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(model.parameters(), recipe.max_gradient)
        optimiser.step()

        is_late = time.monotonic() >= run.deadline
        keeper.keep(step + 1, is_late=is_late)
        on_step(losses.progress(samples_after(step + 1, training)))
        if is_late and step + 1 < steps:
            return None
    return model


def _noise(training: Training, step: int) -> Tensor:
    """Normal noise of the latent variables (batch, latent) in a step."""
    rng = np.random.default_rng((training.seed, 2, step))
    return torch.from_numpy(rng.standard_normal((training.batch, training.latent), np.float32))


@dataclass(frozen=True, slots=True, eq=False)
class _Keeper:
    """Writes the checkpoints and snapshots of a training."""

    run: TrainingRun
    model: Network
    optimiser: torch.optim.Optimizer
    training: Training

    def save(self, done: int) -> None:
        """Renew the checkpoint, after ``done`` steps."""
        self._save(self.run.checkpoint, done)

    def keep(self, done: int, *, is_late: bool) -> None:
        """Write the files that are due after ``done`` steps, or when the time is over."""
        steps = steps_of(self.training)
        if done % self.run.save_every == 0 or done == steps or is_late:
            self.save(done)
        if done == plateau_end(steps):
            self._save(self.run.plateau, done)
        if self.run.snapshots and done in {steps >> k for k in range(1, 6)}:
            samples = samples_after(done, self.training)
            name = f"{self.model.encoder.variant}-{samples:09d}.safetensors"
            save_weights(self.run.snapshots / name, self.model, {"samples": str(samples)})

    def _save(self, path: Path, done: int) -> None:
        save_checkpoint(path, self.model, self.optimiser, self.training, done)

"""Training of the encoder-decoder on packed pairs (paper 3.2 and 4.3, supplement 1), resumable from a checkpoint.

Beside the paper's completion loss a contrastive term (InfoNCE over the batch) pulls the descriptor of an incomplete subvolume towards
that of the complete one seen a little shifted and turned, which is what the database holds; ``training.contrastive_weight=0`` is the
paper. Adam replaces ADADELTA because the shipped runs see few samples.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.nn import functional as F

from semloc_logs.errors import SettingsError, WorkspaceError
from semloc_logs.settings import Training
from semloc_logs.subvolumes.completion import targets
from semloc_logs.subvolumes.cut import CLASSES, code_table
from semloc_logs.subvolumes.network import Completion, descriptors
from semloc_logs.subvolumes.pairs import occupied, read_shard
from semloc_logs.tables import replacing_file

RATE = 1.5e-3
TEMPERATURE = 0.1
MIN_OCCUPIED = 40
POOL, SCENES = 96, 12  # steps that draw from the same scenes, and how many
FREEZE = 0.4  # of the steps: from then on batch normalisation uses its running statistics, as it will when it describes

U8 = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Progress:
    """Of one step: samples seen so far, losses, share of the batch's incomplete subvolumes whose partner is nearest."""

    samples: int
    loss: float
    reconstruction: float
    contrastive: float
    matched: float


def _batches(shards: Sequence[Path], training: Training, first_step: int, steps: int) -> Iterator[tuple[U8, U8, U8]]:
    """Batches of a fixed random sequence, from step ``first_step`` on, each of several scenes: their neighbours are negatives enough."""
    pool: list[tuple[U8, U8, U8]] = []
    chosen = -1
    for step in range(first_step, steps):
        if step // POOL != chosen:
            chosen = step // POOL
            draw = np.random.default_rng((training.seed, chosen))
            pool = [read_shard(shards[k], int(draw.integers(1 << 16))) for k in draw.permutation(len(shards))[:SCENES]]
        rng = np.random.default_rng((training.seed, 1, step))
        sizes = np.bincount(rng.integers(len(pool), size=training.batch), minlength=len(pool))
        rows = [rng.choice(len(shard[0]), n, replace=len(shard[0]) < n) for shard, n in zip(pool, sizes, strict=True)]
        arrays = [np.concatenate([shard[k][r] for shard, r in zip(pool, rows, strict=True)]) for k in range(3)]
        # quarter turns and mirror images of the whole triple are as good as new streets
        quarter, mirror = int(rng.integers(4)), bool(rng.integers(2))
        turned = [np.rot90(a[:, ::-1] if mirror else a, quarter, axes=(1, 2)) for a in arrays]
        a, b, c = (np.ascontiguousarray(t) for t in turned)
        a[rng.random(a.shape, np.float32) < training.dropout] = 253
        yield a, b, c


def _seen(part: U8) -> NDArray[np.bool_]:
    """Which of the 3 x 3 subvolumes of each wide one hold enough occupied voxels to be described, flat (b * 9,)."""
    columns = occupied(part).sum(3)
    counts = [[columns[:, 8 + 8 * i : 40 + 8 * i, 8 + 8 * j : 40 + 8 * j].sum((1, 2)) for j in range(3)] for i in range(3)]
    return np.ascontiguousarray(np.array(counts).transpose(2, 0, 1).reshape(-1) >= MIN_OCCUPIED)


def train(
    variant: str,
    shards: Sequence[Path],
    training: Training,
    checkpoint: Path,
    on_step: Callable[[Progress], None] = lambda _: None,
    save_every: int = 100,
) -> Completion:
    """Train from scratch or from ``checkpoint``, which is renewed every ``save_every`` steps; returns the finished network.

    Raises SettingsError without shards and WorkspaceError when the checkpoint is of another run.
    """
    shards = [path for path in shards if pq.read_metadata(path).num_rows]
    if not shards:
        raise SettingsError("There is nothing to train on: give sessions with keyframes, or scenes to simulate.")
    torch.manual_seed(training.seed)
    model = Completion(variant)
    optimiser = torch.optim.Adam(model.parameters(), lr=RATE)
    steps = math.ceil(training.samples / (training.batch * 9))
    done = _resume(checkpoint, model, optimiser, training) if checkpoint.exists() else 0
    model.train()
    table, classes = code_table(variant), CLASSES[variant]
    for step, (part, whole, other) in enumerate(_batches(shards, training, done, steps), start=done):
        if step >= FREEZE * steps:
            for part_of_model in model.modules():
                if isinstance(part_of_model, torch.nn.BatchNorm3d):
                    part_of_model.eval()
        for group in optimiser.param_groups:
            group["lr"] = RATE * min(1.0, (step + 1) / 50) * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * step / steps)))
        seen = torch.from_numpy(_seen(part))
        noise = torch.from_numpy(np.random.default_rng((training.seed, 2, step)).standard_normal((len(part), 256), np.float32))
        target, known = targets(whole, table, classes)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            logits, mu, log_variance = model(torch.from_numpy(table[part]), noise)
            with torch.no_grad():  # the complete view is the goal; a gradient through it too would cost a third more
                partner = model.encoder(torch.from_numpy(table[other]))
        entropy = F.cross_entropy(logits, target, reduction="none").float()
        weight = torch.where(target < classes, training.occupied_weight, 1.0) * known
        reconstruction = (entropy * weight).sum() / weight.sum().clamp(min=1.0)
        middle, log_variance = mu[:, :, 1, 1].float(), log_variance.float()
        prior = 0.5 * (middle.square() + log_variance.exp() - 1 - log_variance).mean()
        similarity = descriptors(mu)[seen] @ descriptors(partner)[seen].T / TEMPERATURE
        own = torch.arange(len(similarity))
        some = len(own) > 0  # dropout can take the last subvolume that is full enough, and the mean of nothing is NaN
        contrastive = 0.5 * (F.cross_entropy(similarity, own) + F.cross_entropy(similarity.T, own)) if some else mu.new_zeros(())
        loss = training.reconstruction_weight * reconstruction + prior + training.contrastive_weight * contrastive
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 10.0)
        optimiser.step()
        matched = float((similarity.argmax(1) == own).float().mean()) if some else 0.0
        on_step(
            Progress(
                (step + 1) * training.batch * 9, float(loss.detach()), float(reconstruction.detach()), float(contrastive.detach()), matched
            )
        )
        if (step + 1) % save_every == 0 or step + 1 == steps:
            _save(checkpoint, model, optimiser, training, step + 1)
    return model


def _save(path: Path, model: Completion, optimiser: torch.optim.Adam, training: Training, step: int) -> None:
    tensors = {f"model.{k}": v.contiguous() for k, v in model.state_dict().items()}
    for i, p in enumerate(model.parameters()):
        tensors |= {f"adam.{i}.{k}": v.contiguous() for k, v in optimiser.state.get(p, {}).items() if isinstance(v, Tensor)}
    note = {"step": str(step), "training": training.model_dump_json(), "variant": model.encoder.variant}
    with replacing_file(path) as temporary:
        save_file(tensors, temporary, metadata=note)


def _resume(path: Path, model: Completion, optimiser: torch.optim.Adam, training: Training) -> int:
    try:
        with safe_open(path, "pt") as handle:
            note = handle.metadata() or {}
        tensors = load_file(path)
        same = (
            json.loads(note["training"]) == training.model_dump(mode="json")
            and note.get("variant", model.encoder.variant) == model.encoder.variant
        )
        step = int(note["step"])
    except (OSError, SafetensorError, KeyError, ValueError) as problem:
        raise WorkspaceError(f"Checkpoint {path} cannot be read ({problem}): remove it to start over.") from None
    if not same:
        raise WorkspaceError(f"Checkpoint {path} is of a training with other settings: remove it to start over.")
    try:
        model.load_state_dict({k[6:]: v for k, v in tensors.items() if k.startswith("model.")})
    except RuntimeError:
        raise WorkspaceError(f"Checkpoint {path} is of another network: remove it to start over.") from None
    for i, p in enumerate(model.parameters()):
        state = {k: tensors[f"adam.{i}.{k}"] for k in ("step", "exp_avg", "exp_avg_sq") if f"adam.{i}.{k}" in tensors}
        if state:
            optimiser.state[p] = state
    return step


def save_weights(path: Path, model: Completion, card: dict[str, str]) -> None:
    """The network in bf16 with a model card in the file's metadata."""
    tensors = {k: v.to(torch.bfloat16).contiguous() for k, v in model.state_dict().items() if v.is_floating_point()}
    with replacing_file(path) as temporary:
        save_file(tensors, temporary, metadata={**card, "variant": model.encoder.variant})

"""What each change to the paper's network is worth: the same shards, the same processor time, one
row a variant (paper 3.2, 4.5).

python benchmarks/ablation.py SHARDS WORK --minutes 5 [--only NAME]...

SHARDS is a folder of packed pairs (`semloc train` keeps them beside its checkpoint). Each row
trains for so many minutes of processor time on one core, with a learning rate that ends in that
time, and prints a JSON line; finished rows are not trained again.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semloc_logs.settings import Settings
from semloc_logs.subvolumes.cut import CLASSES, SIZE
from semloc_logs.subvolumes.network import (
    CHANNELS,
    Completion,
    Decoder,
    Encoder,
    Network,
    P4Convolution,
    channels_last,
    latent_mean,
    max_pool,
)
from semloc_logs.subvolumes.weight_files import save_weights
from semloc_logs.training.completion_scores import completion_scores
from semloc_logs.training.network_training import Progress, TrainingRun, train
from semloc_logs.training.pairs import read_shard

HELD_OUT = 2


@dataclass(frozen=True)
class Row:
    """Changes to the paper's network and training."""

    adam: bool = True
    norm: bool = False
    turning: bool = True  # layers that turn with their input
    # the first block maps 2x2x2 embedded voxels at once; else convolves one-hot voxels
    patch: bool = True
    wide: bool = True  # with a margin, fully convolutional, nine subvolumes of a pair
    contrastive: float = 10.0
    reconstruction: float = 10.0
    latent: int = 256
    batch: int = 12


PAPER = {
    "adam": False,
    "turning": False,
    "patch": False,
    "wide": False,
    "contrastive": 0.0,
    "batch": 32,
}
ROWS = {
    "all": Row(),
    "paper": Row(**PAPER),
    "paper + Adam": Row(**{**PAPER, "adam": True}),
    "paper + batch normalisation": Row(**{**PAPER, "norm": True}),
    "paper + first block in eights": Row(**{**PAPER, "patch": True}),
    "paper + contrastive": Row(**{**PAPER, "contrastive": 10.0}),
    "paper + contrastive, wide": Row(**{**PAPER, "contrastive": 10.0, "wide": True, "batch": 12}),
    "all but contrastive": Row(contrastive=0.0),
    "all but completion": Row(reconstruction=0.0),
    "all but first block in eights": Row(patch=False),
    "all but turning": Row(turning=False),
    "all and batch normalisation": Row(norm=True),
    "N = 64": Row(latent=64),
    "N = 512": Row(latent=512),
}


class _Fixed(nn.Module):
    """A layer as any other: filters that do not turn."""

    def __init__(
        self, inputs: int, outputs: int, size: tuple[int, int, int], *, group_in: bool = True
    ) -> None:
        super().__init__()
        layer = nn.Conv3d(inputs, outputs, size)
        self.weight = layer.weight
        self.bias = layer.bias

    def filters(self) -> tuple[Tensor, Tensor | None]:
        return self.weight, self.bias


class _Ablated(Encoder):
    """The encoder with parts of it put back to the paper's."""

    def __init__(self, variant: str, latent: int, row: Row) -> None:
        layer = P4Convolution if row.turning else _Fixed
        super().__init__(variant, latent, layer)
        self.row = row
        if not row.patch:
            self.first = layer(CLASSES[variant] + 3, CHANNELS[0], (3, 3, 3), group_in=False)
            self.embedding.weight.requires_grad_(False)
        self.norms = nn.ModuleList(
            nn.BatchNorm3d(c) if row.norm else nn.Identity() for c in CHANNELS
        )

    def first_block(self, codes: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        if self.row.patch:
            return super().first_block(codes, weight, bias)
        reduced = (
            torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else torch.float32
        )
        inputs = CLASSES[self.variant] + 3
        voxels = F.one_hot(codes.long(), inputs).to(reduced).permute(0, 4, 1, 2, 3)
        return max_pool(
            F.conv3d(
                voxels, weight.reshape(-1, 3, 3, 3, inputs).permute(0, 4, 1, 2, 3), bias, padding=1
            )
        )

    def forward(self, codes: Tensor) -> Tensor:
        if self.row.wide:
            return self.features(codes, slice(1, -1))
        windows = codes[:, 8:-8, 8:-8].unfold(1, SIZE, 8).unfold(2, SIZE, 8)  # (b, i, j, z, x, y)
        b, i, j = windows.shape[:3]
        if self.training:
            windows = windows[:, i // 2 : i // 2 + 1, j // 2 : j // 2 + 1]
            i = j = 1
        single = windows.reshape(-1, *windows.shape[3:]).permute(0, 2, 3, 1)
        # without a margin, as in the paper; one-hot voxels of a whole map would not fit into memory
        mu = torch.cat([self.features(some, slice(None)).flatten(1) for some in single.split(64)])
        return mu.reshape(b, i, j, -1).permute(0, 3, 1, 2)

    def features(self, codes: Tensor, inner: slice) -> Tensor:
        """Codes -> mu of the ``inner`` part."""
        first, *blocks, mean = self._layers()
        x = F.relu(self.norms[0](self.first_block(codes, *first)))
        for (weight, bias), norm in zip(blocks, list(self.norms)[1:], strict=True):
            x = F.relu(norm(max_pool(F.conv3d(x, weight, bias, padding=1))))
        return latent_mean(x[:, :, inner, inner], *mean)


class _AblatedCompletion(Completion):
    def __init__(self, variant: str, latent: int, row: Row) -> None:
        nn.Module.__init__(self)
        self.encoder = _Ablated(variant, latent, row)
        self.decoder = Decoder(variant, latent)
        channels_last(self)


def _optimiser(row: Row) -> Callable[[Network], torch.optim.Optimizer]:
    if row.adam:
        return lambda model: torch.optim.Adam(model.parameters(), lr=1.5e-3)
    return lambda model: torch.optim.Adadelta(model.parameters(), lr=1.0, rho=0.95, eps=1e-8)


def run(
    name: str, shards: list[Path], work: Path, minutes: float, variant: str, seed: int
) -> dict[str, Any]:
    """Train one row and measure it."""
    row = ROWS[name]

    def training(steps: int) -> Any:
        options = {
            "batch": row.batch,
            "samples": steps * row.batch * 9,
            "latent": row.latent,
            "seed": seed,
        }
        options |= {
            "contrastive_weight": row.contrastive,
            "reconstruction_weight": row.reconstruction,
        }
        return Settings().training.model_copy(update=options)

    def network(variant: str, latent: int) -> Completion:
        return _AblatedCompletion(variant, latent, row)

    stem = work / f"{variant}-{name.replace(' ', '_')}-{minutes:g}-{seed}"
    pace = stem.with_suffix(".steps")
    if not pace.exists():
        clock: list[float] = []

        def tick(_: Progress) -> None:
            clock.append(time.process_time())

        train(
            variant,
            shards[:-HELD_OUT],
            training(20),
            TrainingRun(stem.with_suffix(".trial"), network=network, optimiser=_optimiser(row)),
            tick,
        )
        pace.write_text(str(max(50, int(60 * minutes / np.mean(np.diff(clock[4:]))))))
    steps = int(pace.read_text())
    model = train(
        variant,
        shards[:-HELD_OUT],
        training(steps),
        TrainingRun(stem.with_suffix(".checkpoint"), network=network, optimiser=_optimiser(row)),
    )
    assert model is not None
    model.eval()
    held_out = [tuple(part[:300] for part in read_shard(shard)) for shard in shards[-HELD_OUT:]]
    pairs = tuple(np.concatenate([p[k] for p in held_out]) for k in range(3))
    seen = steps * row.batch * (9 if row.wide else 1)
    scores = completion_scores(model, pairs)  # type: ignore[arg-type]
    save_weights(stem.with_suffix(".safetensors"), model, {"row": name})
    return {
        "row": name,
        "variant": variant,
        "minutes": minutes,
        "seed": seed,
        "steps": steps,
        "subvolumes": seen,
        **scores,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shards", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--variant", default="semantic")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", action="append", choices=list(ROWS))
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.work.mkdir(parents=True, exist_ok=True)
    shards = sorted(options.shards.glob("*.parquet"))
    for name in options.only or ROWS:
        print(
            json.dumps(
                run(name, shards, options.work, options.minutes, options.variant, options.seed)
            ),
            flush=True,
        )


if __name__ == "__main__":
    main()

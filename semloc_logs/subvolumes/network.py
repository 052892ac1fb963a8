"""The paper's variational encoder-decoder (3.2, supplement 1), written so that it can be run over a whole map at once.

Labels enter through a learned embedding (a factorised first convolution: an occupied, free or unobserved voxel is a table look-up,
not a vector of L + 2 numbers). Three blocks of 3x3x3 convolution, 2x2x2 max-pooling and ReLU, then a fully connected layer written
as a 4x4x4 convolution. Batch normalisation, which the paper lacks, lets it learn from few samples. The descriptor is the mean mu of
the latent code, scaled to unit length.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semloc_logs.subvolumes.cut import CLASSES

LATENT = 256
EMBEDDING = 8


class _LookUp(torch.autograd.Function):
    """``F.embedding`` for a few codes and many voxels: its own backward pass scatters row by row and takes five times as long."""

    @staticmethod
    def forward(ctx: Any, codes: Tensor, weight: Tensor) -> Tensor:
        ctx.save_for_backward(codes)
        ctx.rows = len(weight)
        return F.embedding(codes, weight)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[None, Tensor]:
        (codes,) = ctx.saved_tensors
        flat, grad = codes.reshape(-1), grads[0].reshape(-1, grads[0].shape[-1])
        columns = [torch.bincount(flat, grad[:, c].float(), minlength=ctx.rows) for c in range(grad.shape[1])]
        return None, torch.stack(columns, 1).to(grad.dtype)


def _halve(x: Tensor) -> Tensor:
    """2x2x2 max-pooling; without gradients as three maxima, which take half the time of the library's kernel in bf16."""
    if torch.is_grad_enabled() and x.requires_grad:
        return F.max_pool3d(x, 2)
    x = torch.maximum(x[:, :, ::2], x[:, :, 1::2])
    x = torch.maximum(x[:, :, :, ::2], x[:, :, :, 1::2])
    return torch.maximum(x[..., ::2], x[..., 1::2])


class Encoder(nn.Module):
    """Codes (b, x, y, 32) uint8 with a margin of 8 voxels in x and y -> mu (b, 256, (x - 40) / 8, (y - 40) / 8).

    Output (i, j) describes the subvolume whose corner is voxel (8 + 8 i, 8 + 8 j, 0).
    """

    def __init__(self, variant: str, latent: int = LATENT) -> None:
        super().__init__()
        self.variant = variant
        self.embedding = nn.Embedding(CLASSES[variant] + 3, EMBEDDING)
        self.blocks = nn.ModuleList(nn.Conv3d(a, b, 3, padding=1) for a, b in ((EMBEDDING, 16), (16, 32), (32, 64)))
        self.norms = nn.ModuleList(nn.BatchNorm3d(c) for c in (16, 32, 64))
        self.mean = nn.Conv3d(64, latent, 4)
        # without an affine part: mu keeps the prior's mean and variance, and no direction that all subvolumes share
        self.centre = nn.BatchNorm3d(latent, affine=False)
        self.log_variance = nn.Linear(latent, latent)

    def forward(self, codes: Tensor) -> Tensor:
        reduced = torch.is_autocast_enabled("cpu")  # looked up in the precision of the convolutions: no copy of the volume
        weight = self.embedding.weight.to(torch.get_autocast_dtype("cpu")) if reduced else self.embedding.weight
        looked_up: Tensor = _LookUp.apply(codes.int(), weight)  # type: ignore[no-untyped-call]
        x = looked_up.permute(0, 4, 1, 2, 3)  # channels last in memory, as the convolutions want it
        for block, norm in zip(self.blocks, self.norms, strict=True):
            x = F.relu(norm(_halve(block(x))))  # ReLU before pooling, as in the paper, would cost eight times as much
        x = x[:, :, 1:-1, 1:-1]  # the pooled margin has served
        mu: Tensor = self.centre(self.mean(x))[..., 0]
        return mu


class Decoder(nn.Module):
    """Latent code (b, 256) -> logits (b, L + 2, 32, 32, 32): upsampling by repetition and convolution."""

    def __init__(self, variant: str, latent: int = LATENT) -> None:
        super().__init__()
        self.start = nn.Linear(latent, 32 * 4**3)
        self.blocks = nn.ModuleList(nn.Conv3d(a, b, 3, padding=1) for a, b in ((32, 32), (32, 16)))
        self.last = nn.Conv3d(16, CLASSES[variant] + 2, 3, padding=1)

    def forward(self, code: Tensor) -> Tensor:
        x = torch.tanh(self.start(code)).reshape(-1, 32, 4, 4, 4).contiguous(memory_format=torch.channels_last_3d)
        for block in self.blocks:
            x = F.relu(block(x.repeat_interleave(2, 2).repeat_interleave(2, 3).repeat_interleave(2, 4)))
        logits: Tensor = self.last(x.repeat_interleave(2, 2).repeat_interleave(2, 3).repeat_interleave(2, 4))
        return logits


def channels_last(module: nn.Module) -> None:
    """Lay out the weights as the convolutions want them: two to three times as fast on a CPU."""
    module.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]


class Completion(nn.Module):
    """Encoder and decoder: what is trained. ``encoder`` alone describes."""

    def __init__(self, variant: str) -> None:
        super().__init__()
        self.encoder = Encoder(variant)
        self.decoder = Decoder(variant)
        channels_last(self)

    def forward(self, codes: Tensor, noise: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Logits of the completed middle subvolume, mu (b, 256, 3, 3) of all and log-variance (b, 256) of the middle one of ``codes``
        (b, 64, 64, 32); without ``noise`` (b, 256) the mean is decoded."""
        every = self.encoder(codes)
        mu = every[:, :, every.shape[2] // 2, every.shape[3] // 2]
        log_variance = self.encoder.log_variance(torch.tanh(mu)).clamp(-8.0, 4.0)
        code = mu if noise is None else mu + noise * torch.exp(0.5 * log_variance)
        return self.decoder(code), every, log_variance


def descriptors(mu: Tensor) -> Tensor:
    """Unit-length descriptors (b * i * j, 256) from mu (b, 256, i, j)."""
    return F.normalize(mu.float().permute(0, 2, 3, 1).reshape(-1, mu.shape[1]), dim=1)

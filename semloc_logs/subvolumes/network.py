"""The paper's variational encoder-decoder (3.2, supplement 1), written so that it can be run over a whole map at once.

Labels enter through a learned embedding (a factorised first convolution: an occupied, free or unobserved voxel is a table look-up,
not a vector of L + 2 numbers). Three blocks of 3x3x3 convolution, ReLU and 2x2x2 max-pooling, then a fully connected layer written
as a 4x4x4 convolution. The descriptor is the mean mu of the latent code, scaled to unit length.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semloc_logs.subvolumes.cut import CLASSES

LATENT = 256
EMBEDDING = 8


class Encoder(nn.Module):
    """Codes (b, x, y, 32) uint8 with a margin of 8 voxels in x and y -> mu (b, 256, (x - 40) / 8, (y - 40) / 8).

    Output (i, j) describes the subvolume whose corner is voxel (8 + 8 i, 8 + 8 j, 0).
    """

    def __init__(self, variant: str, latent: int = LATENT) -> None:
        super().__init__()
        self.variant = variant
        self.embedding = nn.Embedding(CLASSES[variant] + 3, EMBEDDING)
        self.blocks = nn.ModuleList(nn.Conv3d(a, b, 3, padding=1) for a, b in ((EMBEDDING, 16), (16, 32), (32, 64)))
        self.mean = nn.Conv3d(64, latent, 4)
        self.log_variance = nn.Linear(latent, latent)

    def forward(self, codes: Tensor) -> Tensor:
        x = self.embedding(codes.int()).permute(0, 4, 1, 2, 3)  # channels last in memory, as the convolutions want it
        for block in self.blocks:
            x = F.max_pool3d(F.relu(block(x)), 2)
        x = x[:, :, 1:-1, 1:-1]  # the pooled margin has served
        mu: Tensor = self.mean(x)[..., 0]
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


class Completion(nn.Module):
    """Encoder and decoder: what is trained. ``encoder`` alone describes."""

    def __init__(self, variant: str) -> None:
        super().__init__()
        self.encoder = Encoder(variant)
        self.decoder = Decoder(variant)
        self.to(memory_format=torch.channels_last_3d)

    def forward(self, codes: Tensor, noise: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Logits of the completed subvolume, mu and log-variance (b, 256) of wide subvolumes (b, 48, 48, 32)."""
        mu = self.encoder(codes)[:, :, 0, 0]
        log_variance = self.encoder.log_variance(torch.tanh(mu)).clamp(-8.0, 4.0)
        code = mu if noise is None else mu + noise * torch.exp(0.5 * log_variance)
        return self.decoder(code), mu, log_variance


def descriptors(mu: Tensor) -> Tensor:
    """Unit-length descriptors from mu (n, 256)."""
    return F.normalize(mu.float(), dim=1)

"""The paper's encoder-decoder as its Fig. 2 and supplement 1 have it, for single subvolumes.

The encoder takes one-hot voxels through four blocks of 3x3x3 convolution, ReLU and 2x2x2
max-pooling, and a fully connected layer with tanh; mean and log-variance of the latent code follow.
The decoder is its mirror image: a fully connected layer with tanh, a convolution, then four times
upsampling by repetition and convolution, and a softmax at the end. The channels of Fig. 2 are not
in the paper's text: these give 0.92 million parameters, and the paper has "around one million".
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semloc_logs.subvolumes.cut import CLASSES, SIZE
from semloc_logs.subvolumes.network import LATENT, Describer, Network, channels_last, max_pool

CHANNELS = (8, 16, 32, 64)
CORNER = 2  # voxels along an edge after four poolings
HIDDEN = CHANNELS[-1] * CORNER**3


def one_hot(codes: Tensor, inputs: int) -> Tensor:
    """Codes (b, x, y, z) uint8 as ``inputs`` channels (b, inputs, x, y, z), channels last."""
    reduced = torch.is_autocast_enabled("cpu") and not codes.is_cuda
    dtype = torch.get_autocast_dtype("cpu") if reduced else torch.float32
    table = torch.eye(inputs, dtype=dtype, device=codes.device)
    return F.embedding(codes.int(), table).permute(0, 4, 1, 2, 3)


class PlainEncoder(Describer):
    """Codes (b, x, y, 32) -> mu (b, latent, 1, 1) of the subvolume in their middle."""

    def __init__(self, variant: str, latent: int = LATENT) -> None:
        super().__init__()
        self.variant, self.latent = variant, latent
        self.inputs = CLASSES[variant] + 3  # classes, free, unobserved, occupied of unknown class
        self.blocks = nn.ModuleList(
            nn.Conv3d(a, b, 3, padding=1) for a, b in pairwise((self.inputs, *CHANNELS))
        )
        self.hidden = nn.Linear(HIDDEN, HIDDEN)
        self.mean = nn.Linear(HIDDEN, latent)
        self.log_variance = nn.Linear(HIDDEN, latent)

    def features(self, codes: Tensor) -> Tensor:
        """The last hidden layer (b, HIDDEN)."""
        x, y = ((length - SIZE) // 2 for length in codes.shape[1:3])
        voxels = one_hot(codes[:, x : x + SIZE, y : y + SIZE], self.inputs)
        for block in self.blocks:
            voxels = F.relu(max_pool(block(voxels)))
        return torch.tanh(self.hidden(voxels.flatten(1)))

    def forward(self, codes: Tensor) -> Tensor:
        mean: Tensor = self.mean(self.features(codes))
        return mean[:, :, None, None]


class PlainDecoder(nn.Module):
    """Latent code (b, latent) -> logits (b, L + 2, 32, 32, 32) of a subvolume."""

    def __init__(self, variant: str, latent: int = LATENT) -> None:
        super().__init__()
        self.start = nn.Linear(latent, HIDDEN)
        self.first = nn.Conv3d(CHANNELS[-1], CHANNELS[-1], 3, padding=1)
        channels = (*CHANNELS[::-1], CLASSES[variant] + 2)
        self.blocks = nn.ModuleList(nn.Conv3d(a, b, 3, padding=1) for a, b in pairwise(channels))

    def forward(self, code: Tensor) -> Tensor:
        x: Tensor = torch.tanh(self.start(code)).reshape(-1, CHANNELS[-1], CORNER, CORNER, CORNER)
        x = self.first(x.contiguous(memory_format=torch.channels_last_3d))
        for block in self.blocks:
            x = F.relu(x)
            x = block(x.repeat_interleave(2, 2).repeat_interleave(2, 3).repeat_interleave(2, 4))
        return x


class PlainCompletion(Network):
    """Encoder and decoder, as they are trained."""

    encoder: PlainEncoder
    decoder: PlainDecoder

    def __init__(self, variant: str, latent: int = LATENT) -> None:
        super().__init__()
        self.encoder = PlainEncoder(variant, latent)
        self.decoder = PlainDecoder(variant, latent)
        channels_last(self)

    def arranged(self, states: Tensor) -> Tensor:
        return states

    def volumes(self, logits: Tensor) -> Tensor:
        return logits.transpose(0, 1)

    def forward(self, codes: Tensor, noise: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Logits (L + 2, b, 32, 32, 32) of the middle subvolume of ``codes`` (b, x, y, 32).

        Also mu (b, latent, 1, 1) and log-variance (b, latent). Without ``noise`` (b, latent) the
        mean is decoded.
        """
        features = self.encoder.features(codes)
        mu: Tensor = self.encoder.mean(features)
        log_variance: Tensor = self.encoder.log_variance(features).clamp(-8.0, 4.0)
        code = mu if noise is None else mu + noise * torch.exp(0.5 * log_variance)
        return self.decoder(code).transpose(0, 1), mu[:, :, None, None], log_variance

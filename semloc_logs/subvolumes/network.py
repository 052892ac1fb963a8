"""The paper's variational encoder-decoder (3.2, supplement 1), run over whole maps at once.

Labels enter through a learned embedding (an occupied, free or unobserved voxel is a table look-up,
not a vector of L + 2 numbers), and the first block maps 2x2x2 voxels at once. Two blocks of 3x3x3
convolution, 2x2x2 max-pooling and ReLU follow, then a fully connected layer written as a
convolution. The descriptor is the mean mu of the latent code, scaled to unit length. There is no
batch normalisation, as in the paper: beside the contrastive term it costs a third of the recall.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from semloc_logs.arrays import F32, U8
from semloc_logs.subvolumes.cut import CLASSES

LATENT = 256
EMBEDDING = 8
CHANNELS = (16, 32, 64)


class _LookUp(torch.autograd.Function):
    """``F.embedding`` for a few codes and many voxels.

    The library's backward pass scatters row by row and takes five times as long.
    """

    @staticmethod
    def forward(ctx: Any, codes: Tensor, weight: Tensor) -> Tensor:
        ctx.save_for_backward(codes)
        ctx.rows = len(weight)
        return F.embedding(codes, weight)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[None, Tensor]:
        (codes,) = ctx.saved_tensors
        flat = codes.reshape(-1)
        grad = grads[0].reshape(-1, grads[0].shape[-1])
        columns = [
            torch.bincount(flat, grad[:, c].float(), minlength=ctx.rows)
            for c in range(grad.shape[1])
        ]
        return None, torch.stack(columns, 1).to(grad.dtype)


def max_pool(x: Tensor) -> Tensor:
    """2x2x2 max-pooling.

    Without gradients as three maxima, which take half the time of the library's kernel in bf16.
    """
    if torch.is_grad_enabled() and x.requires_grad:
        return F.max_pool3d(x, 2)
    x = torch.maximum(x[:, :, ::2], x[:, :, 1::2])
    x = torch.maximum(x[:, :, :, ::2], x[:, :, :, 1::2])
    return torch.maximum(x[..., ::2], x[..., 1::2])


def space_to_depth(volume: Tensor) -> Tensor:
    """Space to depth: voxels (b, x, y, z) -> (b, x / 2, y / 2, z / 2, 8)."""
    b, x, y, z = volume.shape
    return (
        volume.reshape(b, x // 2, 2, y // 2, 2, z // 2, 2).permute(0, 1, 3, 5, 2, 4, 6).flatten(4)
    )


def depth_to_space(cells: Tensor) -> Tensor:
    """The reverse of :func:`space_to_depth`."""
    b, x, y, z, _ = cells.shape
    return (
        cells.reshape(b, x, y, z, 2, 2, 2)
        .permute(0, 1, 4, 2, 5, 3, 6)
        .reshape(b, 2 * x, 2 * y, 2 * z)
    )


def _turned(base: Tensor, group_in: bool) -> Tensor:
    """Filters (4 * out, 4 * in or in, x, y, z) of a layer that turns with its input.

    They are made from ``base`` (out, [4,] in, x, y, z). Output channel r * out + i is filter i
    turned by r quarter turns about z, which also turns its input's channels (Cohen and Welling
    2016, the group p4).
    """
    turns = []
    for r in range(4):
        turned = torch.rot90(base, r, (-3, -2))
        turns.append(turned.roll(r, 1).flatten(1, 2) if group_in else turned)
    return torch.cat(turns)


class P4Convolution(nn.Module):
    """The parameters of one layer of the encoder, a convolution over quarter turns (P4).

    ``base`` filters for one heading and a ``bias`` that all headings share.
    """

    def __init__(
        self, inputs: int, outputs: int, size: tuple[int, int, int], *, group_in: bool = True
    ) -> None:
        super().__init__()
        self.group_in = group_in
        shape = (outputs // 4, 4, inputs // 4) if group_in else (outputs // 4, inputs)
        bound = 1 / math.sqrt(inputs * math.prod(size))  # as the library's own layers begin
        self.base = nn.Parameter(torch.empty(*shape, *size).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(outputs // 4).uniform_(-bound, bound))

    def filters(self) -> tuple[Tensor, Tensor]:
        """Weight (outputs, inputs, x, y, z) and bias (outputs,) for all four headings."""
        return _turned(self.base, self.group_in), self.bias.repeat(4)


@njit(cache=True, nogil=True)
def look_up_cells(codes: U8, table: F32, bias: F32, usual: int, out: F32) -> None:
    """ReLU(bias + the rows of ``table`` of the 2x2x2 codes of each cell) into ``out``.

    ``table`` (8, codes, channels), ``codes`` (b, x, y, z), ``out`` (b, x / 2, y / 2, z / 2,
    channels). Cells that hold nothing but the ``usual`` code are computed once.
    """
    n = len(bias)
    of_usual = bias.copy()
    for k in range(8):
        for c in range(n):
            of_usual[c] += table[k, usual, c]
    for c in range(n):
        of_usual[c] = max(of_usual[c], np.float32(0))
    for b in range(out.shape[0]):
        for i in range(out.shape[1]):
            for j in range(out.shape[2]):
                for m in range(out.shape[3]):
                    cell = codes[b, 2 * i : 2 * i + 2, 2 * j : 2 * j + 2, 2 * m : 2 * m + 2]
                    same = True
                    for k in range(8):
                        same &= cell[k >> 2, (k >> 1) & 1, k & 1] == usual
                    if same:
                        out[b, i, j, m] = of_usual
                        continue
                    total = bias.copy()
                    for k in range(8):
                        code = cell[k >> 2, (k >> 1) & 1, k & 1]
                        for c in range(n):
                            total[c] += table[k, code, c]
                    for c in range(n):
                        out[b, i, j, m, c] = max(total[c], np.float32(0))


class Describer(nn.Module):
    """The part of a network that describes: codes (b, x, y, 32) -> mu (b, latent, i, j)."""

    variant: str
    latent: int


class Encoder(Describer):
    """Codes (b, x, y, 32) with a margin of 8 voxels in x and y -> mu of the subvolumes.

    mu is (b, latent, (x - 40) / 8, (y - 40) / 8), codes are uint8. Output (i, j) describes the
    subvolume with its corner at voxel (8 + 8 i, 8 + 8 j, 0). A map turned by a quarter about z has
    the same descriptors but for the order of their numbers (``describe.quarter_turns``). Another
    ``layer`` is for comparison.
    """

    def __init__(
        self, variant: str, latent: int = LATENT, layer: Callable[..., Any] = P4Convolution
    ) -> None:
        super().__init__()
        self.variant = variant
        self.latent = latent
        self.embedding = nn.Embedding(CLASSES[variant] + 3, EMBEDDING)
        self.first = layer(EMBEDDING, CHANNELS[0], (2, 2, 2), group_in=False)
        self.blocks = nn.ModuleList(layer(a, b, (3, 3, 3)) for a, b in pairwise(CHANNELS))
        self.mean = layer(CHANNELS[-1], latent, (4, 4, 4))
        self.log_variance = nn.Linear(latent, latent)
        self._kept: list[tuple[Tensor, Tensor]] = []
        self._table: F32 | None = None

    def train(self, mode: bool = True) -> Encoder:
        """As of any module; kernels made from the old weights are dropped."""
        self._kept = []
        self._table = None
        return super().train(mode)

    def _layers(self) -> list[tuple[Tensor, Tensor]]:
        """Weights and biases of all layers as the kernels take them, made once where constant."""
        if self._kept:
            return self._kept
        first, *rest = (layer.filters() for layer in (self.first, *self.blocks, self.mean))
        layers = [(first[0].permute(0, 2, 3, 4, 1).flatten(1), first[1])]
        layers += [(w.contiguous(memory_format=torch.channels_last_3d), b) for w, b in rest[:-1]]
        # the four layers of z as channels: four times as fast as in three dimensions
        w, b = rest[-1]
        layers.append(
            (
                w.permute(0, 4, 1, 2, 3)
                .flatten(1, 2)
                .contiguous(memory_format=torch.channels_last),
                b,
            )
        )
        if not self.training and not torch.is_grad_enabled():
            self._kept = layers
        return layers

    def first_block(self, codes: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """Codes -> (b, 16, x / 2, y / 2, 16): a linear map of the embeddings of each 2x2x2 voxels.

        It costs a fraction of the paper's block, which convolves at full resolution.
        """
        device = codes.device.type
        # looked up in the precision of the convolutions: no copy of the volume
        reduced = torch.is_autocast_enabled(device)
        table = (
            self.embedding.weight.to(torch.get_autocast_dtype(device))
            if reduced
            else self.embedding.weight
        )
        cells = space_to_depth(codes).int()
        if codes.is_cuda:
            looked_up: Tensor = F.embedding(cells, table)
        else:
            looked_up = _LookUp.apply(cells, table)  # type: ignore[no-untyped-call]
        x = F.linear(looked_up.flatten(4), weight, bias)
        return x.permute(0, 4, 1, 2, 3)  # channels last in memory, as the convolutions want it

    def _looked_up(self, codes: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """The first block and its ReLU as a sum of eight rows of a table.

        A row is the share of a voxel of each code in the cell it lies in.
        """
        if self._table is None:
            table = torch.einsum(
                "ce,oke->kco", self.embedding.weight, weight.reshape(-1, 8, EMBEDDING)
            )
            self._table = np.ascontiguousarray(table.float().numpy())
        b, x, y, z = codes.shape
        out = np.empty((b, x // 2, y // 2, z // 2, len(bias)), np.float32)
        look_up_cells(
            codes.numpy(), self._table, bias.float().numpy(), CLASSES[self.variant] + 1, out
        )
        return torch.from_numpy(out).permute(0, 4, 1, 2, 3)

    def forward(self, codes: Tensor) -> Tensor:
        first, *blocks, mean = self._layers()
        describing = not (self.training or torch.is_grad_enabled() or codes.is_cuda)
        x = (
            self._looked_up(codes, *first)
            if describing
            else F.relu(self.first_block(codes, *first))
        )
        for weight, bias in blocks:
            # ReLU before pooling, as in the paper, would cost eight times as much
            x = F.relu(max_pool(F.conv3d(x, weight, bias, padding=1)))
        return latent_mean(x[:, :, 1:-1, 1:-1], *mean)  # the pooled margin has served

    @torch.inference_mode()
    def describe(self, codes: U8, windows: NDArray[np.int64]) -> F32:
        """Unit descriptors (n, latent) of the outputs (i, j) of ``windows`` (n, 2), of the codes
        (x, y, 32) of a map with its margin.
        """
        with torch.autocast("cpu", dtype=torch.bfloat16):
            mu = self(torch.from_numpy(codes)[None])
        i, j = windows.T
        return np.asarray(descriptors(mu[:, :, i, j].unsqueeze(3)).numpy())


def latent_mean(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Features (b, 64, x, y, 4) at an eighth of the resolution -> mu (b, latent, x - 3, y - 3)."""
    columns = x.permute(0, 2, 3, 4, 1).flatten(3).permute(0, 3, 1, 2)
    return F.conv2d(columns, weight, bias)


class Decoder(nn.Module):
    """Latent code (b, latent) -> logits (L + 2, 8, b, 16, 16, 16) of a subvolume.

    The subvolume is :func:`space_to_depth`, the eight moved to the front. Upsampling by repetition
    and convolution as in the paper, but the last step gives the 2x2x2 voxels of each cell at once.
    """

    def __init__(self, variant: str, latent: int = LATENT) -> None:
        super().__init__()
        self.start = nn.Linear(latent, 24 * 4**3)
        self.blocks = nn.ModuleList(nn.Conv3d(a, b, 3, padding=1) for a, b in ((24, 32), (32, 32)))
        self.last = nn.Linear(32, 8 * (CLASSES[variant] + 2))

    def forward(self, code: Tensor) -> Tensor:
        x = (
            torch.tanh(self.start(code))
            .reshape(-1, 24, 4, 4, 4)
            .contiguous(memory_format=torch.channels_last_3d)
        )
        for block in self.blocks:
            x = F.relu(
                block(x.repeat_interleave(2, 2).repeat_interleave(2, 3).repeat_interleave(2, 4))
            )
        # classes first: a softmax over columns is vectorised, one over rows of twenty numbers is
        # not
        cells = x.permute(1, 0, 2, 3, 4).flatten(1)
        logits = torch.addmm(self.last.bias[:, None], self.last.weight, cells)
        return logits.reshape(-1, 8, x.shape[0], *x.shape[2:])


def as_volumes(logits: Tensor) -> Tensor:
    """The decoder's output -> (b, L + 2, 32, 32, 32)."""
    return torch.stack([depth_to_space(of_class.movedim(0, -1)) for of_class in logits], 1)


def channels_last(module: nn.Module) -> None:
    """Lay out the weights as the convolutions want them: two to three times as fast on a CPU."""
    layouts = {4: torch.channels_last, 5: torch.channels_last_3d}
    for parameter in module.parameters():
        if parameter.ndim in layouts:
            parameter.data = parameter.data.contiguous(memory_format=layouts[parameter.ndim])


class Network(nn.Module):
    """An encoder and a decoder, as they are trained; the ``encoder`` alone describes.

    :meth:`forward` takes codes (b, 64, 64, 32) and noise (b, latent) or None; it gives the logits
    of the middle subvolumes, mu (b, latent, i, j) and the middle's log-variance (b, latent).
    """

    encoder: Describer
    decoder: nn.Module

    def arranged(self, states: Tensor) -> Tensor:
        """Voxel states (b, 32, 32, 32) in the order of the logits, which have classes before it."""
        raise NotImplementedError

    def volumes(self, logits: Tensor) -> Tensor:
        """Logits of :meth:`forward` as (b, L + 2, 32, 32, 32)."""
        raise NotImplementedError


class Completion(Network):
    """Our encoder and decoder."""

    encoder: Encoder
    decoder: Decoder

    def __init__(self, variant: str, latent: int = LATENT) -> None:
        super().__init__()
        self.encoder = Encoder(variant, latent)
        self.decoder = Decoder(variant, latent)
        channels_last(self)

    def arranged(self, states: Tensor) -> Tensor:
        return space_to_depth(states).movedim(-1, 0)

    def volumes(self, logits: Tensor) -> Tensor:
        return as_volumes(logits)

    def complete(self, codes: Tensor) -> Tensor:
        """Logits (b, L + 2, 32, 32, 32) of the middle subvolumes of ``codes`` (b, 64, 64, 32).

        As the training weighed voxels.
        """
        return as_volumes(self(codes, None)[0])

    def forward(self, codes: Tensor, noise: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Logits of the completed middle subvolume, mu of all, log-variance of the middle one.

        Logits as the decoder gives them, mu (b, latent, 3, 3), log-variance (b, latent), of
        ``codes`` (b, 64, 64, 32). Without ``noise`` (b, latent) the mean is decoded.
        """
        every = self.encoder(codes)
        mu = every[:, :, every.shape[2] // 2, every.shape[3] // 2]
        log_variance = self.encoder.log_variance(torch.tanh(mu)).clamp(-8.0, 4.0)
        code = mu if noise is None else mu + noise * torch.exp(0.5 * log_variance)
        return self.decoder(code), every, log_variance


def descriptors(mu: Tensor) -> Tensor:
    """Unit-length descriptors (b * i * j, latent) from mu (b, latent, i, j)."""
    return F.normalize(mu.float().permute(0, 2, 3, 1).reshape(-1, mu.shape[1]), dim=1)


def random_encoder(variant: str, seed: int = 0) -> Encoder:
    """An untrained encoder: what training has to beat."""
    torch.manual_seed(seed)
    return Encoder(variant).eval()

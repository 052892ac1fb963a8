"""The paper's encoder-decoder as its Fig. 2 and supplement 1 have it, for single subvolumes.

The encoder takes one-hot voxels through four blocks of 3x3x3 convolution, ReLU and 2x2x2
max-pooling, and a fully connected layer with tanh; mean and log-variance of the latent code follow.
The decoder is its mirror image: a fully connected layer with tanh, a convolution, then four times
upsampling by repetition and convolution, and a softmax at the end. The channels of Fig. 2 are not
in the paper's text: these give 0.92 million parameters, and the paper has "around one million".

The first and the last block, at full resolution, are computed in other ways that give the same
numbers: one-hot voxels times a filter is a row of the filter, and most neighbourhoods hold nothing
but free or but unobserved voxels; a repeated voxel meets sums of a filter's weights.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from semloc_logs.arrays import F32, U8
from semloc_logs.subvolumes.cut import CLASSES, SIZE
from semloc_logs.subvolumes.network import (
    LATENT,
    Describer,
    Network,
    as_volumes,
    channels_last,
    max_pool,
    space_to_depth,
)

BoxArrays = tuple[U8, F32, U8]
Filters = tuple[F32, F32, F32]
Place = tuple[int, int, int]
CHANNELS = (8, 16, 32, 64)
FIRST = CHANNELS[0]
CORNER = 2  # voxels along an edge after four poolings
HIDDEN = CHANNELS[-1] * CORNER**3
UNIFORM = 8  # and more mark cells whose neighbourhood is all free or all unobserved
# of a filter along one axis, which weights a repeated voxel meets: [parity, coarse tap, fine tap]
REPEATED = ((((1, 0, 0), (0, 1, 1), (0, 0, 0))), (((0, 0, 0), (1, 1, 0), (0, 0, 1))))


@njit(cache=True, nogil=True)
def first_block(codes: U8, table: F32, bias: F32, out: F32, largest: U8) -> None:
    """Convolution, ReLU and max-pooling of one-hot voxels.

    ``codes`` (b, 34, 34, 34), or of other even lengths, have a margin of the code whose rows of
    ``table`` (27, codes, FIRST) are zero, the last; before it are occupied of unknown class,
    unobserved and free. ``out`` is (b, 16, 16, 16, FIRST), ``largest`` of its shape gets the voxel
    of each cell that has the maximum, or the uniform code of its neighbourhood plus ``UNIFORM``.
    Neighbourhoods are nearly uniform: only the differences from free or unobserved space are added.
    """
    rows, of_uniform = _from_uniform(table, bias)
    of_space = np.maximum(of_uniform, np.float32(0))
    free = np.uint8(table.shape[1] - 4)
    unobserved = np.uint8(table.shape[1] - 3)
    length = codes.shape[3]
    not_free = np.empty(length, np.uint8)
    not_unobserved = np.empty(length, np.uint8)
    heights = np.empty(out.shape[3], np.int64)
    total = np.empty(8 * FIRST, np.float32)
    cell = np.empty(64, np.uint8)
    for b in range(out.shape[0]):
        for x in range(out.shape[1]):
            for y in range(out.shape[2]):
                # of the columns that cells here look at, which heights have another code
                not_free[:] = 0
                not_unobserved[:] = 0
                for i in range(4):
                    for j in range(4):
                        column = codes[b, 2 * x + i, 2 * y + j]
                        for k in range(length):
                            not_free[k] |= column[k] ^ free
                            not_unobserved[k] |= column[k] ^ unobserved
                mixed = 0
                for z in range(out.shape[3]):
                    is_free = _none(not_free, 2 * z)
                    if is_free or _none(not_unobserved, 2 * z):
                        u = 1 - int(is_free)
                        for c in range(FIRST):
                            out[b, x, y, z, c] = of_space[u, c]
                        for c in range(FIRST):
                            largest[b, x, y, z, c] = UNIFORM + u
                    else:
                        heights[mixed] = z
                        mixed += 1
                for z in heights[:mixed]:
                    for i in range(4):
                        for j in range(4):
                            for k in range(4):
                                cell[(i * 4 + j) * 4 + k] = codes[
                                    b, 2 * x + i, 2 * y + j, 2 * z + k
                                ]
                    _pooled(cell, rows, of_uniform, total, out[b, x, y, z], largest[b, x, y, z])


@njit(cache=True, nogil=True)
def _none(seen: U8, first: int) -> bool:
    """Whether four bytes are zero."""
    return not (seen[first] | seen[first + 1] | seen[first + 2] | seen[first + 3])


@njit(cache=True, nogil=True)
def _from_uniform(table: F32, bias: F32) -> tuple[F32, F32]:
    """What each voxel of a neighbourhood adds to the eight in its middle where it is not free, or
    not unobserved, (2, 64, codes, 8 * FIRST), and the values (2, FIRST) in such space.
    """
    free = table.shape[1] - 4
    rows = np.zeros((2, 64, table.shape[1], 8 * FIRST), np.float32)
    of_uniform = np.empty((2, FIRST), np.float32)
    for u in range(2):
        of_uniform[u] = bias
        for tap in range(27):
            of_uniform[u] += table[tap, free + u]
            difference = table[tap] - table[tap, free + u]
            for voxel in range(8):
                i = (voxel >> 2) + tap // 9
                j = ((voxel >> 1) & 1) + tap // 3 % 3
                k = (voxel & 1) + tap % 3
                into = rows[u, (i * 4 + j) * 4 + k]
                into[:, voxel * FIRST : (voxel + 1) * FIRST] = difference
    return rows, of_uniform


@njit(cache=True, nogil=True)
def _pooled(cell: U8, rows: F32, of_uniform: F32, total: F32, best: F32, which: U8) -> None:
    """The maxima ``best`` (FIRST,) of the eight voxels in the middle of ``cell``, 4 x 4 x 4 of
    them, and ``which`` have them; ``total`` (8 * FIRST,) is working memory.
    """
    free = rows.shape[2] - 4
    count_free = 0
    count_unobserved = 0
    for child in range(64):
        count_free += cell[child] == free
        count_unobserved += cell[child] == free + 1
    u = int(count_unobserved > count_free)
    if max(count_free, count_unobserved) == 64:
        for c in range(FIRST):
            best[c] = max(of_uniform[u, c], np.float32(0))
            which[c] = UNIFORM + u
        return
    for voxel in range(8):
        for c in range(FIRST):
            total[voxel * FIRST + c] = of_uniform[u, c]
    for child in range(64):
        if cell[child] != free + u:
            row = rows[u, child, cell[child]]
            for n in range(8 * FIRST):
                total[n] += row[n]
    for c in range(FIRST):
        best[c] = np.float32(0)
        which[c] = 0
    for voxel in range(8):
        for c in range(FIRST):
            value = total[voxel * FIRST + c]
            if value > best[c]:
                best[c] = value
                which[c] = voxel


@njit(cache=True, nogil=True)
def window_blocks(box: BoxArrays, corners: NDArray[np.int64], filters: Filters, out: F32) -> None:
    """:func:`first_block` of windows of a box whose own first block is known.

    Of ``box`` are the codes (x + 2, y + 2, z + 2) with their margin, and ``out`` and ``largest`` of
    the box without the batch. ``corners`` (n, 3) are even voxels of it; ``filters``: the table and
    the bias, and ``out`` of two windows of free and of unobserved space. ``out`` is (n, 16, 16, 16,
    FIRST). A window sees nothing beyond its faces, so only the cells there differ from the box's.
    """
    codes, features, largest = box
    table, bias, of_space = filters
    rows, of_uniform = _from_uniform(table, bias)
    total = np.empty(8 * FIRST, np.float32)
    cell = np.empty(64, np.uint8)
    which = np.empty(FIRST, np.uint8)
    last = SIZE // 2 - 1
    for n in range(len(corners)):
        first_x = corners[n, 0] // 2
        first_y = corners[n, 1] // 2
        first_z = corners[n, 2] // 2
        for x in range(SIZE // 2):
            for y in range(SIZE // 2):
                for z in range(SIZE // 2):
                    i = first_x + x
                    j = first_y + y
                    k = first_z + z
                    value = out[n, x, y, z]
                    if 0 < x < last and 0 < y < last and 0 < z < last:
                        for c in range(FIRST):
                            value[c] = features[i, j, k, c]
                    elif largest[i, j, k, 0] >= UNIFORM:
                        for c in range(FIRST):
                            value[c] = of_space[largest[i, j, k, 0] - UNIFORM, x, y, z, c]
                    else:
                        _inside(codes, (i, j, k), (x, y, z), cell, table.shape[1] - 1)
                        _pooled(cell, rows, of_uniform, total, value, which)


@njit(cache=True, nogil=True)
def _inside(codes: U8, corner: Place, within: Place, cell: U8, margin: int) -> None:
    """The codes about the cell ``corner`` of a box in ``cell``, 4 x 4 x 4 of them, those beyond the
    faces of the window in which it is the cell ``within`` as ``margin``.
    """
    for a in range(4):
        for b in range(4):
            for c in range(4):
                x = 2 * within[0] + a - 1
                y = 2 * within[1] + b - 1
                z = 2 * within[2] + c - 1
                code = margin
                if 0 <= x < SIZE and 0 <= y < SIZE and 0 <= z < SIZE:
                    code = codes[2 * corner[0] + a, 2 * corner[1] + b, 2 * corner[2] + c]
                cell[(a * 4 + b) * 4 + c] = code


@njit(cache=True, nogil=True)
def first_block_gradient(
    codes: U8, out: F32, largest: U8, gradient: F32, of_table: F32, of_bias: F32
) -> None:
    """Add the gradients of the table and of the bias to ``of_table`` and ``of_bias``."""
    free = of_table.shape[1] - 4
    of_uniform = np.zeros((2, FIRST), np.float32)
    for b in range(out.shape[0]):
        for x in range(out.shape[1]):
            for y in range(out.shape[2]):
                for z in range(out.shape[3]):
                    cell = codes[b, 2 * x : 2 * x + 4, 2 * y : 2 * y + 4, 2 * z : 2 * z + 4]
                    for c in range(FIRST):
                        if out[b, x, y, z, c] <= 0:
                            continue
                        g = gradient[b, x, y, z, c]
                        voxel = largest[b, x, y, z, c]
                        of_bias[c] += g
                        if voxel >= UNIFORM:
                            of_uniform[voxel - UNIFORM, c] += g
                            continue
                        i = voxel >> 2
                        j = (voxel >> 1) & 1
                        k = voxel & 1
                        for tap in range(27):
                            code = cell[i + tap // 9, j + tap // 3 % 3, k + tap % 3]
                            of_table[tap, code, c] += g
    for u in range(2):
        for tap in range(27):
            of_table[tap, free + u] += of_uniform[u]


def _computed(padded: U8, table: F32, bias: F32) -> tuple[F32, U8]:
    """``out`` and ``largest`` of :func:`first_block`."""
    cells = [(length - 2) // 2 for length in padded.shape[1:]]
    out = np.empty((len(padded), *cells, FIRST), np.float32)
    largest = np.empty(out.shape, np.uint8)
    first_block(padded, table, bias, out, largest)
    return out, largest


class _FirstBlock(torch.autograd.Function):
    """:func:`first_block` of codes (b, 32, 32, 32) with its gradient."""

    @staticmethod
    def forward(ctx: Any, codes: Tensor, table: Tensor, bias: Tensor) -> Tensor:
        inputs = table.shape[1]
        padded = np.full((len(codes), *(SIZE + 2,) * 3), inputs, np.uint8)
        padded[:, 1:-1, 1:-1, 1:-1] = codes.numpy()
        rows = F.pad(table.float(), (0, 0, 0, 1)).contiguous()  # the margin adds nothing
        out, largest = _computed(padded, rows.numpy(), bias.float().numpy())
        ctx.kept = (padded, out, largest, rows.shape)
        return torch.from_numpy(out).permute(0, 4, 1, 2, 3)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[None, Tensor, Tensor]:
        padded, out, largest, shape = ctx.kept
        gradient = grads[0].float().permute(0, 2, 3, 4, 1).contiguous().numpy()
        of_table = np.zeros(shape, np.float32)
        of_bias = np.zeros(FIRST, np.float32)
        first_block_gradient(padded, out, largest, gradient, of_table, of_bias)
        return None, torch.from_numpy(of_table[:, :-1].copy()), torch.from_numpy(of_bias)


class PlainEncoder(Describer):
    """Codes (b, x, y, 32) -> mu (b, latent, 1, 1) of the subvolume in their middle."""

    def __init__(self, variant: str, latent: int = LATENT) -> None:
        super().__init__()
        self.variant = variant
        self.latent = latent
        self.inputs = CLASSES[variant] + 3  # classes, free, unobserved, occupied of unknown class
        self.first = nn.Conv3d(self.inputs, FIRST, 3, padding=1)
        self.blocks = nn.ModuleList(nn.Conv3d(a, b, 3, padding=1) for a, b in pairwise(CHANNELS))
        self.hidden = nn.Linear(HIDDEN, HIDDEN)
        self.mean = nn.Linear(HIDDEN, latent)
        self.log_variance = nn.Linear(HIDDEN, latent)

    def first_features(self, codes: Tensor) -> Tensor:
        """The first block of codes (b, 32, 32, 32) uint8, (b, FIRST, 16, 16, 16)."""
        first = self.first
        if codes.is_cuda:
            voxels = F.one_hot(codes.long(), self.inputs).to(first.weight.dtype)
            return F.relu(max_pool(first(voxels.permute(0, 4, 1, 2, 3))))
        table = first.weight.permute(2, 3, 4, 1, 0).reshape(27, self.inputs, FIRST)
        looked_up: Tensor = _FirstBlock.apply(codes, table, first.bias)  # type: ignore[no-untyped-call]
        return looked_up

    def features(self, codes: Tensor) -> Tensor:
        """The last hidden layer (b, HIDDEN)."""
        x, y = ((length - SIZE) // 2 for length in codes.shape[1:3])
        return self._deeper(self.first_features(codes[:, x : x + SIZE, y : y + SIZE]))

    def _deeper(self, voxels: Tensor) -> Tensor:
        """The last hidden layer of the first block (b, FIRST, 16, 16, 16)."""
        for block in self.blocks:
            voxels = F.relu(max_pool(block(voxels)))
        return torch.tanh(self.hidden(voxels.flatten(1)))

    def of_windows(self, codes: U8, corners: NDArray[np.int64], batch: int) -> Iterator[Tensor]:
        """mu (b, latent) of the windows of a box of ``codes`` (x, y, z) at even ``corners`` (n, 3),
        ``batch`` at once. Equal to each window's own; their first block is computed once for all.
        """
        table, bias = (part.detach().numpy() for part in self._rows())
        even = [length + length % 2 for length in codes.shape]
        padded = np.full([length + 2 for length in even], self.inputs, np.uint8)
        padded[tuple(slice(1, 1 + length) for length in codes.shape)] = codes
        box = (padded, *(part[0] for part in _computed(padded[None], table, bias)))
        space = np.full((2, *(SIZE + 2,) * 3), self.inputs, np.uint8)
        for u in range(2):
            space[u, 1:-1, 1:-1, 1:-1] = self.inputs - 3 + u
        filters = (table, bias, _computed(space, table, bias)[0])
        for first in range(0, len(corners), batch):
            part = corners[first : first + batch]
            out = np.empty((len(part), *(SIZE // 2,) * 3, FIRST), np.float32)
            window_blocks(box, part, filters, out)
            with torch.autocast("cpu", dtype=torch.bfloat16):
                mean: Tensor = self.mean(self._deeper(torch.from_numpy(out).movedim(-1, 1)))
            yield mean.float()

    def _rows(self) -> tuple[Tensor, Tensor]:
        """The filter of the first block as rows (27, inputs + 1, FIRST), the last of a margin that
        adds nothing, and its bias.
        """
        weight = self.first.weight
        bias = self.first.bias
        assert bias is not None
        table = weight.permute(2, 3, 4, 1, 0).reshape(27, self.inputs, FIRST)
        return F.pad(table.float(), (0, 0, 0, 1)).contiguous(), bias.float()

    def forward(self, codes: Tensor) -> Tensor:
        mean: Tensor = self.mean(self.features(codes))
        return mean[:, :, None, None]


class PlainDecoder(nn.Module):
    """Latent code (b, latent) -> logits (L + 2, 8, b, 16, 16, 16) of a subvolume.

    The subvolume is ``space_to_depth``, the eight moved to the front.
    """

    def __init__(self, variant: str, latent: int = LATENT) -> None:
        super().__init__()
        self.start = nn.Linear(latent, HIDDEN)
        self.first = nn.Conv3d(CHANNELS[-1], CHANNELS[-1], 3, padding=1)
        channels = CHANNELS[::-1]
        self.blocks = nn.ModuleList(nn.Conv3d(a, b, 3, padding=1) for a, b in pairwise(channels))
        self.last = nn.Conv3d(FIRST, CLASSES[variant] + 2, 3, padding=1)

    def forward(self, code: Tensor) -> Tensor:
        x: Tensor = torch.tanh(self.start(code)).reshape(-1, CHANNELS[-1], CORNER, CORNER, CORNER)
        x = F.relu(self.first(x.contiguous(memory_format=torch.channels_last_3d)))
        for block in self.blocks:
            x = x.repeat_interleave(2, 2).repeat_interleave(2, 3).repeat_interleave(2, 4)
            x = F.relu(block(x))
        x = repeated_convolution(x, self.last)
        b, channels, *cells = x.shape
        columns: Tensor = _Transposed.apply(  # type: ignore[no-untyped-call]
            x.permute(0, 2, 3, 4, 1).reshape(-1, channels)
        )
        return columns.reshape(-1, 8, b, *cells)


def repeated_convolution(x: Tensor, layer: nn.Conv3d) -> Tensor:
    """The 3x3x3 ``layer`` of ``x`` repeated twice along each axis, as (b, 8 * outputs, ...) of x.

    Of the 2x2x2 voxels that a voxel is repeated to, each has a filter of its own. Channel
    ``8 * output + voxel`` is of such a voxel.
    """
    weight = layer.weight
    bias = layer.bias
    assert bias is not None
    repeated = torch.tensor(REPEATED, dtype=weight.dtype, device=weight.device)
    of_each = torch.einsum(
        "pai,qbj,rck,oxijk->opqrxabc", repeated, repeated, repeated, weight
    ).flatten(0, 3)
    of_each = of_each.contiguous(memory_format=torch.channels_last_3d)
    return F.conv3d(x, of_each, bias.repeat_interleave(8), padding=1)


class _Transposed(torch.autograd.Function):
    """The transpose of a matrix in memory, copied block by block, and of its gradient."""

    @staticmethod
    def forward(ctx: Any, matrix: Tensor) -> Tensor:
        return matrix.contiguous().t().contiguous()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        return grads[0].contiguous().t().contiguous()


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
        return space_to_depth(states).movedim(-1, 0)

    def volumes(self, logits: Tensor) -> Tensor:
        return as_volumes(logits)

    def forward(self, codes: Tensor, noise: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Logits of the middle subvolume of ``codes`` (b, x, y, 32), as the decoder gives them.

        Also mu (b, latent, 1, 1) and log-variance (b, latent). Without ``noise`` (b, latent) the
        mean is decoded.
        """
        features = self.encoder.features(codes)
        mu: Tensor = self.encoder.mean(features)
        log_variance: Tensor = self.encoder.log_variance(features).clamp(-8.0, 4.0)
        code = mu if noise is None else mu + noise * torch.exp(0.5 * log_variance)
        return self.decoder(code), mu[:, :, None, None], log_variance

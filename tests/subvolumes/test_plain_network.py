"""The paper's network: its size, and that its quick blocks equal plain convolutions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from semloc_logs.subvolumes.cut import CLASSES
from semloc_logs.subvolumes.network import as_volumes
from semloc_logs.subvolumes.plain_network import (
    PlainCompletion,
    PlainDecoder,
    PlainEncoder,
    repeated_convolution,
)


def codes(variant: str, seed: int = 0) -> torch.Tensor:
    """Two subvolumes: one of random codes, one unobserved but for a corner and a wall."""
    random = np.random.default_rng(seed).integers(0, CLASSES[variant] + 3, (2, 32, 32, 32))
    random[1] = CLASSES[variant] + 1
    random[1, 0, 0, 0] = 0
    random[1, 20, :, 3:9] = CLASSES[variant]
    return torch.from_numpy(random.astype(np.uint8))


def test_it_has_around_one_million_parameters() -> None:
    assert sum(p.numel() for p in PlainCompletion("semantic").parameters()) == 922_189


@pytest.mark.parametrize("variant", ["semantic", "geometric"])
def test_the_first_block_equals_convolution_relu_and_pooling(variant: str) -> None:
    torch.manual_seed(0)
    encoder = PlainEncoder(variant)
    first = encoder.first
    assert first.bias is not None
    given = codes(variant)
    voxels = F.one_hot(given.long(), encoder.inputs).float().permute(0, 4, 1, 2, 3)
    plain = F.max_pool3d(F.relu(first(voxels)), 2)
    quick = encoder.first_features(given)
    torch.testing.assert_close(quick, plain)
    wanted = torch.randn(plain.shape)
    expected = torch.autograd.grad((plain * wanted).sum(), [first.weight, first.bias])
    gradients = torch.autograd.grad((quick * wanted).sum(), [first.weight, first.bias])
    for a, b in zip(gradients, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-3)


def test_the_last_block_equals_repetition_and_convolution() -> None:
    torch.manual_seed(0)
    layer = torch.nn.Conv3d(3, 5, 3, padding=1)
    x = torch.randn(2, 3, 4, 4, 4)
    large = x.repeat_interleave(2, 2).repeat_interleave(2, 3).repeat_interleave(2, 4)
    blocks = repeated_convolution(x, layer).reshape(2, 5, 8, 4, 4, 4)
    volumes = as_volumes(blocks.permute(1, 2, 0, 3, 4, 5))
    torch.testing.assert_close(volumes, layer(large))


def test_the_middle_of_a_wide_box_is_described_and_decoded() -> None:
    torch.manual_seed(0)
    model = PlainCompletion("geometric").eval()
    middle = codes("geometric")
    wide = torch.zeros((2, 80, 80, 32), dtype=torch.uint8)
    wide[:, 24:56, 24:56] = middle
    logits, mu, log_variance = model(wide, None)
    assert model.volumes(logits).shape == (2, 3, 32, 32, 32)
    assert mu.shape == (2, 256, 1, 1)
    assert log_variance.shape == (2, 256)
    torch.testing.assert_close(model.encoder(middle), mu)
    assert PlainDecoder("geometric")(mu[:, :, 0, 0]).shape == (3, 8, 2, 16, 16, 16)

"""What the benchmark of the encoder counts, by hand; no times."""

import numpy as np
import pytest
import torch

from semloc_logs.benchmarks.speed.encoder_speed import encode, macs, one_by_one, watch
from semloc_logs.subvolumes.cut import WIDE
from semloc_logs.subvolumes.network import Encoder, random_encoder


@pytest.fixture(scope="module")
def network() -> Encoder:
    return random_encoder("geometric")


def test_multiplications_of_known_layers_are_counted(network: Encoder) -> None:
    """What the last convolution alone does: 64 x 4^3 inputs for each of 256 outputs of one
    subvolume.
    """
    codes = np.zeros((WIDE, WIDE, 32), np.uint8)
    seen = watch(network, codes)
    assert seen["convolution 3"][1] == 256 * 64 * 4**3
    assert seen["convolution 1"][1] == 32 * 24 * 24 * 16 * 16 * 3**3
    assert macs(network, codes) == sum(count for _, count in seen.values())
    assert all(seconds >= 0 for name, (seconds, _) in seen.items() if name != "between")


def test_dense_and_single_descriptors_are_equal_and_dense_ones_cost_less(network: Encoder) -> None:
    codes = np.random.default_rng(0).integers(0, 3, (WIDE + 16, WIDE + 16, 32)).astype(np.uint8)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        whole = encode(network, codes).reshape(3, 3, -1)
        corners = np.array([[0, 0], [1, 2], [2, 1]])
        alone = one_by_one(network, codes, corners)
    finally:
        torch.set_num_threads(threads)
    np.testing.assert_allclose(whole[corners[:, 0], corners[:, 1]], alone, atol=0.01)
    assert np.abs(alone[0] - alone[1]).max() > 0.01
    assert macs(network, codes) / 9 < 0.5 * macs(network, codes[:WIDE, :WIDE])

"""Which subvolumes the paper's method describes, and that tiles change nothing."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

from semloc_logs.subvolumes.cut import SIZE, code_table, plain_name
from semloc_logs.subvolumes.plain_describe import (
    TILE,
    describe_blocks,
    describe_box,
    describe_windows,
    load_plain_encoder,
    occupied_windows,
)
from semloc_logs.subvolumes.plain_network import PlainEncoder
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE, BlockMap
from semloc_logs.voxels.keys import BLOCK, pack, unpack
from semloc_logs.words.plain_vocabulary import load_plain_vocabulary


@pytest.fixture(scope="module")
def encoder() -> PlainEncoder:
    torch.manual_seed(0)
    return PlainEncoder("geometric").eval()


def one_voxel_a_block(blocks: np.ndarray) -> BlockMap:
    """Blocks (n, 3) with one occupied voxel each, at (3, 3, 3) of the block."""
    keys = np.sort(pack(blocks))
    state = np.full((len(keys), BLOCK**3), UNOBSERVED_STATE, np.uint8)
    state[:, (3 * BLOCK + 3) * BLOCK + 3] = 0
    nothing = np.zeros(0, np.int64)
    return BlockMap(keys, np.zeros(state.shape, np.int8), state, nothing, nothing)


def test_windows_hold_so_many_occupied_voxels() -> None:
    state = np.full((64, 64, 64), UNOBSERVED_STATE, np.uint8)
    state[40, 40, 40] = 0
    state[41, 40, 40] = 2
    # corners 16, 24 and 32 along each axis hold the voxel at 40
    one = occupied_windows(state, np.array([-8, 0, 8]), 8, 1)
    assert len(one) == 27
    assert one.min(0).tolist() == [8, 16, 24]
    assert len(occupied_windows(state, np.zeros(3, int), 8, 2)) == 27
    assert len(occupied_windows(state, np.zeros(3, int), 8, 3)) == 0
    # of corners 0, 16 and 32 the latter two
    assert len(occupied_windows(state, np.zeros(3, int), 16, 1)) == 8


def test_every_subvolume_with_the_voxel_is_described(encoder: PlainEncoder) -> None:
    described = describe_blocks(one_voxel_a_block(np.array([[0, 0, 0]])), 8, 1, encoder)
    # the voxel at 3 lies in windows that begin at -24, -16, -8 and 0
    assert len(described.centre) == 64
    assert described.centre.min(0).tolist() == [-8, -8, -8]
    assert described.centre.max(0).tolist() == [16, 16, 16]
    assert described.descriptor.shape == (64, 256)


def test_tiles_change_nothing(encoder: PlainEncoder) -> None:
    blocks = one_voxel_a_block(np.array([[0, 0, 0], [TILE // BLOCK, 1, 0], [-3, -20, 0]]))
    low, high = blocks.bounds()
    state = blocks.dense(low, tuple((high - low).tolist()))
    whole = describe_box(state, low, 8, 1, encoder)
    tiled = describe_blocks(blocks, 8, 1, encoder)
    assert len(whole.centre) == len(tiled.centre) == 3 * 64
    order, other = (np.lexsort(d.centre.T) for d in (whole, tiled))
    np.testing.assert_array_equal(whole.centre[order], tiled.centre[other])
    np.testing.assert_allclose(whole.descriptor[order], tiled.descriptor[other], atol=1e-3)


def test_only_subvolumes_near_the_road_are_described(encoder: PlainEncoder) -> None:
    blocks = one_voxel_a_block(np.array([[0, 0, 0], [40, 0, 0]]))
    assert unpack(blocks.keys)[1].tolist() == [40, 0, 0]
    beside_road = describe_blocks(blocks, 8, 1, encoder, (np.array([[0.0, 0.0]]), 100.0))
    assert len(beside_road.centre) == 64
    assert beside_road.centre[:, 0].max() < 100


def test_windows_of_a_box_are_described_as_each_alone(encoder: PlainEncoder) -> None:
    rng = np.random.default_rng(0)
    # free space over a floor, a wall, unobserved beyond, and a corner of noise
    state = np.full((45, 50, 41), UNOBSERVED_STATE, np.uint8)
    state[:, :30] = FREE_STATE
    state[:, :, 4] = 0
    state[:, 30] = 2
    state[:12, :12, :12] = rng.choice([0, 2, FREE_STATE, UNOBSERVED_STATE], (12, 12, 12))
    corners = np.array([[0, 0, 0], [2, 4, 8], [13, 18, 9], [12, 17, 0], [2, 18, 8]])
    vectors = describe_windows(state, corners, encoder)
    size = slice(0, SIZE)
    for corner, vector in zip(corners, vectors, strict=True):
        x, y, z = corner
        alone = torch.from_numpy(code_table("geometric")[state[x:, y:, z:][size, size, size]])
        with torch.inference_mode(), torch.autocast("cpu", dtype=torch.bfloat16):
            expected = encoder(alone[None])[0, :, 0, 0].float()
        np.testing.assert_allclose(vector, expected, atol=1e-3)


@pytest.mark.parametrize("variant", ["semantic", "geometric"])
def test_shipped_weights_and_words_go_together_and_state_their_samples(variant: str) -> None:
    encoder = load_plain_encoder(variant)
    words = load_plain_vocabulary(variant)
    assert words.vocabulary.projection.shape == (64, encoder.latent + 1)
    # a descriptor of an empty map and of a wall differ, and their words do, too
    state = np.full((32, 32, 64), FREE_STATE, np.uint8)
    state[:, 10, 32:] = 2
    described = describe_windows(state, np.array([[0, 0, 0], [0, 0, 32]]), encoder)
    word, _ = words.vocabulary.words(words.lifted(described))
    assert word[0] != word[1]
    page = Path(__file__).parents[2] / "docs" / "explanation" / "plain_method.md"
    folder = files("semloc_logs.subvolumes") / "weights"
    with (
        as_file(folder / f"{plain_name(variant)}.safetensors") as path,
        safe_open(path, "np") as handle,
    ):
        samples = int(handle.metadata()["samples"])
    text = page.read_text(encoding="utf-8").replace(" subvolumes", "")
    assert f"{samples:,} ({variant})" in text


@pytest.mark.parametrize("stride", [4, 8, 12, 16])
def test_windows_are_counted_as_one_by_one(stride: int) -> None:
    rng = np.random.default_rng(3)
    state = np.where(rng.random((77, 58, 41)) < 3e-4, 7, FREE_STATE).astype(np.uint8)
    state[rng.random(state.shape) < 0.3] = UNOBSERVED_STATE
    expected = [
        (x, y, z)
        for x in range(0, 77 - SIZE + 1, stride)
        for y in range(0, 58 - SIZE + 1, stride)
        for z in range(0, 41 - SIZE + 1, stride)
        if (state[x : x + SIZE, y : y + SIZE, z : z + SIZE] == 7).sum() >= 6
    ]
    assert 0 < len(expected) < len(range(0, 46, stride)) * len(range(0, 27, stride)) * 3
    corners = occupied_windows(state, np.array([32, 0, -32]), stride, 6)
    np.testing.assert_array_equal(corners - [32, 0, -32], expected)

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file

from semloc_logs.arrays import U8
from semloc_logs.errors import SettingsError
from semloc_logs.subvolumes import describe
from semloc_logs.subvolumes.cut import MARGIN, SIZE, WIDE, code_table, turned_map
from semloc_logs.subvolumes.describe import (
    Described,
    Windows,
    describe_map,
    load_encoder,
    quarter_turns,
)
from semloc_logs.subvolumes.network import (
    Completion,
    Decoder,
    Encoder,
    depth_to_space,
    descriptors,
    random_encoder,
    space_to_depth,
)
from semloc_logs.subvolumes.weight_files import save_weights
from semloc_logs.training.pairs import occupied

LOW = np.array([-64, 32, -16])
V = 0.3


def world(seed: int = 0, size: tuple[int, int, int] = (56, 48, 40)) -> U8:
    """Ground with a step, walls, posts, free space above, holes that nobody saw."""
    rng = np.random.default_rng(seed)
    s = np.full(size, 254, np.uint8)
    height = np.where(np.arange(size[0])[:, None] < size[0] // 2, 12, 21) + np.zeros(size[1], int)
    for x, y in np.ndindex(*size[:2]):
        s[x, y, : height[x, y]] = 253
        s[x, y, height[x, y]] = rng.choice([0, 1, 9])
    for _ in range(8):
        x = rng.integers(0, size[0] - 12)
        y = rng.integers(0, size[1] - 12)
        s[x : x + rng.integers(1, 12), y : y + rng.integers(1, 4), 13 : rng.integers(20, 38)] = (
            rng.choice([2, 5, 8, 255])
        )
    s[rng.random(size) < 0.2] = 253
    return s


@contextlib.contextmanager
def full_precision() -> Iterator[None]:
    """describe_map with its autocast switched off."""
    with mock.patch.object(torch, "autocast", return_value=contextlib.nullcontext()):
        yield


def one_by_one(state: U8, described: Described, encoder: Encoder) -> NDArray[np.float32]:
    """Each described subvolume cut out of the map with its margin and encoded alone."""
    out = []
    padded = np.pad(state, ((64, 64), (64, 64), (64, 64)), constant_values=253)
    for centre in described.centre:
        corner = (centre - SIZE / 2).astype(int) - LOW + 64
        x, y, z = corner - [MARGIN, MARGIN, 0]
        crop = padded[x : x + WIDE, y : y + WIDE, z : z + SIZE]
        with torch.inference_mode():
            out.append(
                descriptors(
                    encoder(torch.from_numpy(code_table(encoder.variant)[crop])[None])
                ).numpy()[0]
            )
    return np.array(out)


@pytest.mark.parametrize("variant", ["semantic", "geometric"])
def test_a_map_at_once_is_its_subvolumes_one_by_one(
    variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(describe, "PATCH", 40)  # several patches
    state = world()
    encoder = random_encoder(variant)
    with full_precision():
        described = describe_map(state, LOW, (12 - 16) * V, encoder, Windows(V, 8, 40))
    assert len(described.descriptor) > 30
    np.testing.assert_allclose(np.linalg.norm(described.descriptor, axis=1), 1, atol=1e-5)
    some = np.arange(0, len(described.centre), len(described.centre) // 7)
    single = one_by_one(
        state, Described(described.centre[some], described.descriptor[some]), encoder
    )
    np.testing.assert_allclose(described.descriptor[some], single, atol=1e-5)
    reduced = describe_map(state, LOW, (12 - 16) * V, encoder, Windows(V, 8, 40))
    np.testing.assert_array_equal(reduced.centre, described.centre)
    assert np.abs(reduced.descriptor - described.descriptor).max() < 1e-2
    # the step in the ground needs more than one layer
    assert len(np.unique(described.centre[:, 2])) > 1


def test_a_finer_stride_contains_the_coarser_one() -> None:
    state = world()
    encoder = random_encoder("semantic")
    ground = (12 - 16) * V
    coarse, fine = (describe_map(state, LOW, ground, encoder, Windows(V, s, 40)) for s in (8, 4))
    row = {tuple(c): i for i, c in enumerate(fine.centre.tolist())}
    assert len(row) == len(fine.centre)  # no place twice
    same = [row[tuple(c)] for c in coarse.centre.tolist()]
    np.testing.assert_allclose(fine.descriptor[same], coarse.descriptor, atol=1e-2)
    assert len(fine.centre) > 3 * len(coarse.centre)
    assert set(np.unique((fine.centre[:, :2] - SIZE / 2 - LOW[:2]) % 4)) == {0.0}


def test_what_is_described_holds_enough_and_starts_at_its_lowest_surface() -> None:
    state = world()
    padded = np.pad(state, 64, constant_values=253)
    described = describe_map(
        state, LOW, (12 - 16) * V, random_encoder("geometric"), Windows(V, 8, 400)
    )
    bottoms = []
    for centre in described.centre:
        x, y, z = (centre - SIZE / 2).astype(int) - LOW + 64
        part = occupied(padded[x : x + SIZE, y : y + SIZE, z : z + SIZE])
        assert part.sum() >= 400
        bottoms.append(int(np.argmax(part.sum((0, 1)) > 20)))
    assert max(bottoms) <= 8  # the lowest surface lies in the lowest eight voxels
    everywhere = describe_map(
        state, LOW, (12 - 16) * V, random_encoder("geometric"), Windows(V, 8, 1)
    )
    assert len(everywhere.centre) > len(described.centre)


def test_a_map_described_in_other_words_of_its_own_position() -> None:
    """Descriptors follow the content, not the coordinates; a shift by whole strides moves the
    centres.
    """
    state = world()
    encoder = random_encoder("geometric")
    a = describe_map(state, LOW, (12 - 16) * V, encoder, Windows(V, 8, 40))
    b = describe_map(
        state, LOW + np.array([800, -160, 24]), (12 - 16 + 24) * V, encoder, Windows(V, 8, 40)
    )
    np.testing.assert_array_equal(a.descriptor, b.descriptor)
    np.testing.assert_array_equal(a.centre + np.array([800, -160, 24]), b.centre)


def test_the_grid_is_that_of_the_map_wherever_the_content_starts() -> None:
    """Positions are multiples of the stride from the map's corner, so that overlapping submaps
    describe the same places.
    """
    state = world()
    encoder = random_encoder("geometric")
    state[:5], state[:, :3] = 253, 253
    ground = (12 - 16) * V
    a = describe_map(state, LOW, ground, encoder, Windows(V, 8, 40))
    assert set(np.unique((a.centre[:, :2] - SIZE / 2 - LOW[:2]) % 8)) == {0.0}
    more = np.pad(state, ((24, 16), (40, 8), (16, 0)), constant_values=253)
    b = describe_map(more, LOW - np.array([24, 40, 16]), ground, encoder, Windows(V, 8, 40))
    order_a, order_b = (np.lexsort(d.centre.T) for d in (a, b))
    np.testing.assert_array_equal(a.centre[order_a], b.centre[order_b])
    assert np.abs(a.descriptor[order_a] - b.descriptor[order_b]).max() < 1e-2


@pytest.mark.parametrize(
    "state",
    [
        np.full((40, 40, 16), 254, np.uint8),
        np.full((16, 16, 16), 253, np.uint8),
        np.zeros((0, 0, 0), np.uint8),
    ],
)
def test_maps_with_nothing_occupied(state: U8) -> None:
    described = describe_map(
        state, np.zeros(3, int), 0.0, random_encoder("geometric"), Windows(V, 8, 1)
    )
    assert described.centre.shape == (0, 3)
    assert described.descriptor.shape == (0, 256)


def test_a_single_voxel_and_a_small_map() -> None:
    state = np.full((16, 16, 16), 253, np.uint8)
    state[8, 8, 8] = 2
    assert (
        len(
            describe_map(
                state, np.zeros(3, int), 0.0, random_encoder("geometric"), Windows(V, 8, 2)
            ).centre
        )
        == 0
    )
    state[6:10, 6:10, 8:12] = 2
    described = describe_map(
        state, np.zeros(3, int), 0.0, random_encoder("geometric"), Windows(V, 8, 20)
    )
    assert len(described.centre) > 0
    assert np.abs(described.centre[:, :2] - 8).max() <= SIZE


def test_other_strides_are_refused() -> None:
    with pytest.raises(SettingsError, match="stride"):
        describe_map(world(), LOW, 0.0, random_encoder("geometric"), Windows(V, 6, 40))


def test_eights_there_and_back() -> None:
    volume = torch.arange(2 * 4 * 6 * 8).reshape(2, 4, 6, 8)
    cells = space_to_depth(volume)
    assert cells.shape == (2, 2, 3, 4, 8)
    assert sorted(cells[1, 1, 2, 3].tolist()) == sorted(volume[1, 2:4, 4:6, 6:8].flatten().tolist())
    assert torch.equal(depth_to_space(cells), volume)


def test_shapes_of_the_network() -> None:
    codes = torch.zeros((2, WIDE, WIDE, SIZE), dtype=torch.uint8)
    encoder = random_encoder("semantic")
    with torch.inference_mode():
        assert encoder(codes).shape == (2, 256, 1, 1)
        assert encoder(torch.zeros((1, WIDE + 24, WIDE + 8, SIZE), dtype=torch.uint8)).shape == (
            1,
            256,
            4,
            2,
        )
        assert Decoder("semantic")(torch.zeros(3, 256)).shape == (21, 8, 3, 16, 16, 16)
        assert Completion("semantic").eval().complete(
            torch.zeros((2, 64, 64, 32), dtype=torch.uint8)
        ).shape == (2, 21, 32, 32, 32)
        logits, mu, log_variance = Completion("geometric").eval()(
            torch.zeros((2, 64, 64, 32), dtype=torch.uint8), None
        )
    assert (logits.shape, mu.shape, log_variance.shape) == (
        (3, 8, 2, 16, 16, 16),
        (2, 256, 3, 3),
        (2, 256),
    )
    parameters = sum(p.numel() for p in Completion("semantic").parameters())
    assert 0.5e6 < parameters < 3e6  # about one million, as in the paper


def test_random_encoders_are_the_same_for_a_seed() -> None:
    a = random_encoder("geometric", 1)
    b = random_encoder("geometric", 1)
    c = random_encoder("geometric", 2)
    assert all(torch.equal(x, y) for x, y in zip(a.parameters(), b.parameters(), strict=True))
    assert not all(torch.equal(x, y) for x, y in zip(a.parameters(), c.parameters(), strict=True))


def test_weights_come_back_and_other_files_are_refused(tmp_path: Path) -> None:
    model = Completion("geometric").eval()
    path = tmp_path / "weights.safetensors"
    save_weights(path, model, {"trained_on": "nothing"})
    encoder = load_encoder("geometric", path)
    state = world()
    a = describe_map(state, LOW, (12 - 16) * V, encoder, Windows(V, 8, 40))
    b = describe_map(state, LOW, (12 - 16) * V, model.encoder, Windows(V, 8, 40))
    assert (a.descriptor * b.descriptor).sum(1).min() > 0.999  # bf16 of the weights
    with pytest.raises(SettingsError, match="semantic"):
        load_encoder("semantic", path)  # of the other variant
    odd = tmp_path / "odd.safetensors"
    for content in (b"", b"\x08\x00\x00\x00\x00\x00\x00\x00{}      ", b"x" * 100):
        odd.write_bytes(content)
        with pytest.raises(SettingsError, match=r"odd\.safetensors"):
            load_encoder("geometric", odd)
    save_file({"encoder.log_variance.bias": torch.zeros(3)}, odd)
    with pytest.raises(SettingsError, match=r"odd\.safetensors"):
        load_encoder("geometric", odd)
    with pytest.raises(SettingsError, match="missing"):
        load_encoder("geometric", tmp_path / "missing")


def test_the_encoder_turns_with_its_input() -> None:
    encoder = random_encoder("semantic", seed=4)
    volume = torch.from_numpy(
        np.random.default_rng(5).integers(0, 21, (1, 64, 64, 32)).astype(np.uint8)
    )
    with torch.inference_mode():
        as_it_lies = encoder(volume)
        for turns in range(1, 4):
            turned = torch.rot90(
                encoder(torch.rot90(volume, turns, (1, 2)).contiguous()), -turns, (2, 3)
            )
            expected = quarter_turns(descriptors(as_it_lies).numpy(), turns)
            np.testing.assert_allclose(descriptors(turned).numpy(), expected, atol=1e-5)
            # a turn is not the identity
            assert np.abs(descriptors(as_it_lies).numpy() - expected).max() > 0.01


@pytest.mark.parametrize("yaw", [0.0, np.pi / 10, np.pi / 2, 4.0])
def test_centres_of_a_turned_map_are_those_of_the_map(yaw: float) -> None:
    """A single block in the map: all windows that hold it lie about it, and on every side."""
    state = np.full((80, 96, 40), 254, np.uint8)
    state[60:64, 20:24, 12:16] = 2
    turned = turned_map(state, LOW, yaw)
    described = describe_map(
        turned.state, turned.low, -4 * V, random_encoder("geometric"), Windows(V, 4, 40)
    )
    away = turned.to_map(described.centre)[:, :2] - (LOW[:2] + np.array([62, 22]))
    assert len(away) >= 5
    assert np.abs(away).max() < 16 * np.sqrt(2) + 2
    assert np.abs(away.mean(0)).max() < 2.5
    np.testing.assert_allclose(
        turned.from_map(turned.to_map(described.centre)[:, :2]), described.centre[:, :2], atol=1e-4
    )


def test_quarter_turns_of_the_query_meet_the_headings_of_the_map() -> None:
    """A query at yaw a + 90 degrees has the descriptor of the map at a, turned by a quarter."""
    encoder = random_encoder("geometric", seed=2)
    state = world()
    turned = [turned_map(state, LOW, yaw) for yaw in (np.pi / 10, np.pi / 10 + np.pi / 2)]
    described = [
        describe_map(t.state, t.low, (12 - 16) * V, encoder, Windows(V, 8, 40)) for t in turned
    ]
    known, asked = (t.to_map(f.centre) for t, f in zip(turned, described, strict=True))
    i, j = np.nonzero(np.linalg.norm(known[:, None] - asked[None], axis=2) < 0.01)
    assert len(i) > 10
    np.testing.assert_allclose(
        quarter_turns(described[1].descriptor[j], 1), described[0].descriptor[i], atol=0.05
    )


def test_looking_up_cells_is_the_first_block() -> None:
    """Sums of table rows, which describing uses, against embedding and matrix product, which
    training uses.
    """
    encoder = random_encoder("semantic", seed=3)
    codes = np.random.default_rng(1).integers(0, 22, (2, 12, 10, 8)).astype(np.uint8)
    codes[:, 4:] = 20  # nothing but unobserved voxels
    volume = torch.from_numpy(codes)
    with torch.no_grad():
        first = encoder._layers()[0]
        expected = torch.relu(encoder.first_block(volume, *first))
        np.testing.assert_allclose(
            encoder._looked_up(volume, *first).numpy(), expected.numpy(), atol=1e-6
        )

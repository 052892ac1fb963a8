"""Descriptors of any length as unit vectors whose distances keep their order."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semloc_logs.words.plain_vocabulary import (
    LONGEST,
    lifted,
    load_plain_vocabulary,
    save_plain_vocabulary,
    train_plain_vocabulary,
)


def test_lifted_descriptors_are_unit_vectors() -> None:
    unit = lifted(np.array([[3.0, 4.0], [0.0, 0.0], [300.0, 400.0]]), 0.1)
    np.testing.assert_allclose(unit[0], [0.3, 0.4, np.sqrt(0.75)], atol=1e-6)
    np.testing.assert_array_equal(unit[1], [0, 0, 1])
    np.testing.assert_allclose(unit[2, :2], [0.6 * LONGEST, 0.8 * LONGEST], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1.0, atol=1e-6)


def test_distances_are_scaled_and_a_little_longer_where_lengths_differ() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 200, 64))
    scale = 0.5 / 8
    plain = scale**2 * ((a - b) ** 2).sum(1)
    unit = ((lifted(a, scale) - lifted(b, scale)) ** 2).sum(1)
    longer = scale * np.maximum(np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1))
    assert longer.max() < LONGEST
    assert (unit >= plain - 1e-5).all()
    assert (unit <= plain * (1 + longer**2 / (1 - longer**2)) + 1e-5).all()


def test_words_of_near_descriptors_are_the_same_after_a_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    centres = 5.0 * rng.normal(size=(20, 64))
    descriptors = np.repeat(centres, 30, 0) + 0.01 * rng.normal(size=(600, 64))
    words = train_plain_vocabulary(descriptors, cells=16, children=4)
    save_plain_vocabulary(tmp_path / "words.safetensors", words, {"variant": "semantic"})
    again = load_plain_vocabulary("semantic", tmp_path / "words.safetensors")
    assert again.scale == words.scale
    cell = again.vocabulary.nearest_cells(again.lifted(descriptors), 1)[:, 0].reshape(20, 30)
    assert (cell == cell[:, :1]).all()
    assert len(np.unique(cell[:, 0])) > 4


def test_few_descriptors_give_few_words() -> None:
    descriptors = np.random.default_rng(0).normal(size=(1200, 64))
    # 1200 of 16 cells of at most 256 words: 18 to a word of 4, and 16 is the power of two below
    words = train_plain_vocabulary(descriptors, cells=16)
    assert words.vocabulary.children.shape == (16, 16, 64)

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file

from semloc_logs.arrays import F32
from semloc_logs.errors import SettingsError
from semloc_logs.numerics.bits import lowest_bit, popcount
from semloc_logs.words.index import SHORTLIST, Allowed, Index
from semloc_logs.words.kmeans import grid, kmeans, nearest_centroids
from semloc_logs.words.vocabulary import (
    BITS,
    Vocabulary,
    load_vocabulary,
    save_vocabulary,
    train_vocabulary,
)

ALL = Allowed(np.array([True]))
TOLERANCE = 2.0**-9  # of a similarity: descriptors are rounded to 2^-11


def unit(seed: int, n: int, centres: int = 12, spread: float = 0.7) -> F32:
    """Unit vectors (n, 256) in clusters."""
    rng = np.random.default_rng(seed)
    c = np.random.default_rng(99).standard_normal((centres, 256))
    v = c[rng.integers(0, centres, n)] + spread * rng.standard_normal((n, 256))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True), np.float32)


@pytest.fixture(scope="module")
def vocabulary() -> Vocabulary:
    return train_vocabulary(unit(0, 1500), cells=10, children=4)


def test_the_shape_and_scale_of_a_vocabulary(vocabulary: Vocabulary) -> None:
    assert [
        getattr(vocabulary, k).shape for k in ("cells", "projection", "thresholds", "children")
    ] == [
        (10, 256),
        (BITS, 256),
        (10, BITS),
        (10, 4, BITS),
    ]
    np.testing.assert_allclose(np.linalg.norm(vocabulary.cells, axis=1), 1, atol=0.01)
    np.testing.assert_allclose(
        vocabulary.projection @ vocabulary.projection.T, np.eye(BITS), atol=0.02
    )
    for k, steps in (("cells", 2048), ("projection", 2048), ("children", 256)):
        a = getattr(vocabulary, k)
        assert (a * steps == np.round(a * steps)).all()


def test_cells_are_the_nearest_ones(vocabulary: Vocabulary) -> None:
    d = unit(1, 300)
    similarity = d @ vocabulary.cells.T
    ordered = -np.sort(-similarity, axis=1)
    for probes in (1, 3, 10, 50):
        cells = vocabulary.nearest_cells(d, probes)
        assert cells.shape == (300, min(probes, 10))
        np.testing.assert_allclose(
            np.take_along_axis(similarity, cells, 1), ordered[:, :probes], atol=TOLERANCE
        )
        assert all(len(set(row)) == len(row) for row in cells.tolist())


def slow_code(vocabulary: Vocabulary, d: F32, cell: int) -> tuple[int, F32]:
    margin = vocabulary.projection.astype(float) @ d - vocabulary.thresholds[cell]
    return sum(1 << b for b in range(BITS) if margin[b] > 0), np.abs(margin)


def test_codes_are_the_signs_of_the_projections(vocabulary: Vocabulary) -> None:
    d = unit(2, 50)
    cell = np.arange(50) % 10
    codes = vocabulary.codes(d, cell)
    assert codes.dtype == np.uint64
    for i in range(50):
        expected, margin = slow_code(vocabulary, d[i], int(cell[i]))
        differing = expected ^ int(codes[i])
        assert all(margin[b] < TOLERANCE for b in range(BITS) if differing >> b & 1)
    both = vocabulary.codes(d, np.stack([cell, (cell + 1) % 10], 1))
    assert both[:, 0].tolist() == codes.tolist()
    assert both[:, 1].tolist() == vocabulary.codes(d, (cell + 1) % 10).tolist()
    words, of_words = vocabulary.words(d)
    own = vocabulary.nearest_cells(d, 1)[:, 0]
    assert (words // 256).tolist() == own.tolist()
    assert (words % 256).max() < 4
    assert of_words.tolist() == vocabulary.codes(d, own).tolist()
    assert [len(a) for a in vocabulary.words(d[:0])] == [0, 0]


def test_bits_are_balanced_in_each_cell_and_say_something(vocabulary: Vocabulary) -> None:
    d = unit(0, 1500)
    word, code = vocabulary.words(d)
    bits = np.unpackbits(code.view(np.uint8).reshape(-1, 8), axis=1, bitorder="little")
    for cell in range(10):
        bits_of_cell = bits[word // 256 == cell]
        if len(bits_of_cell) >= 30:
            assert bits_of_cell.mean(0).min() > 0.35
            assert bits_of_cell.mean(0).max() < 0.65
    moved_a_little = np.clip(
        d + 0.01 * np.random.default_rng(0).standard_normal(d.shape), -1, 1
    ).astype(np.float32)
    moved_a_little /= np.linalg.norm(moved_a_little, axis=1, keepdims=True)
    moved = vocabulary.codes(moved_a_little, word // 256)
    distance = np.array([(int(a) ^ int(b)).bit_count() for a, b in zip(code, moved, strict=True)])
    other = np.array(
        [(int(a) ^ int(b)).bit_count() for a, b in zip(code, np.roll(code, 7), strict=True)]
    )
    assert distance.mean() < 12 < 25 < other.mean()


def slow_search(
    v: Vocabulary,
    word: NDArray[np.uint16],
    code: NDArray[np.uint64],
    d: F32,
    cells: NDArray[np.int32],
    k: int,
    allowed: NDArray[np.bool_],
) -> list[tuple[float, int, int]]:
    """Asymmetric and Hamming distances and rows of the k nearest ``allowed`` (n,) entries in the
    ``cells`` of one descriptor.
    """
    candidates = []
    for e in np.flatnonzero(np.isin(word // 256, cells) & allowed):
        margin = v.projected(d[None])[0].astype(float) - v.thresholds[word[e] // 256]
        differs = [(int(code[e]) >> b & 1) != (margin[b] > 0) for b in range(BITS)]
        candidates.append((float(np.abs(margin[differs]).sum()), sum(differs), int(e)))
    size = max(SHORTLIST, k)
    farthest = sorted(f[1] for f in candidates)[min(size, len(candidates)) - 1] if candidates else 0
    return sorted(f for f in candidates if f[1] <= farthest)[:k]


@given(
    st.integers(0, 1000),
    st.integers(1, 40),
    st.integers(1, 12),
    st.lists(st.booleans(), min_size=5, max_size=5),
)
@settings(max_examples=15)
def test_the_nearest_words_are_those_of_brute_force(
    seed: int, k: int, probes: int, allow: list[bool]
) -> None:
    v = TRAINED
    d = unit(seed, 300)
    q = unit(seed + 1, 8)
    word, code = v.words(d)
    group = np.random.default_rng(seed).integers(0, 5, 300)
    allowed = np.array(allow)
    m = Index.of_words(v, word, code, group).search(q, k, probes, Allowed(allowed))
    cells = v.nearest_cells(q, probes)
    for i in range(len(q)):
        expected = slow_search(v, word, code, q[i], cells[i], k, allowed[group])
        row = {
            e: (asymmetric, hamming)
            for asymmetric, hamming, e in slow_search(
                v, word, code, q[i], cells[i], 300, allowed[group]
            )
        }
        of_query = m.query == i
        entries = m.entry[of_query].tolist()
        assert len(set(entries)) == len(entries) == len(expected)
        assert m.distance[of_query].tolist() == [row[e][1] for e in entries]
        np.testing.assert_allclose(
            [row[e][0] for e in entries], [f[0] for f in expected], rtol=1e-6, atol=1e-7
        )


def _count(x: NDArray[np.uint64]) -> list[tuple[int, int]]:
    return [(popcount(v), lowest_bit(v)) for v in x]


_counted: Any = njit(_count)


@given(st.lists(st.integers(1, 2**64 - 1), min_size=1, max_size=20))
@settings(max_examples=30)
def test_bits_are_counted(values: list[int]) -> None:
    assert _counted(np.array(values, np.uint64)) == [
        (v.bit_count(), (v & -v).bit_length() - 1) for v in values
    ]


def test_what_is_found_does_not_depend_on_the_other_queries() -> None:
    """The bound that a query begins with is the one before's: far and near queries in either order,
    and alone, find the same.
    """
    close = unit(3, 400)
    far = unit(77, 30, centres=3, spread=3.0)
    word, code = TRAINED.words(close)
    index = Index.of_words(TRAINED, word, code, np.zeros(400, np.int64))
    mixed = np.stack([close[:30], far], 1).reshape(60, 256)

    def searched(q: F32) -> list[tuple[int, int, int]]:
        m = index.search(q, 5, 3, ALL)
        return list(zip(m.query.tolist(), m.entry.tolist(), m.distance.tolist(), strict=True))

    together = searched(mixed)
    assert sorted((59 - q, e, d) for q, e, d in searched(mixed[::-1])) == sorted(together)
    assert [(q + i, e, d) for i in range(60) for q, e, d in searched(mixed[i : i + 1])] == together


def test_a_bit_that_is_sure_outweighs_two_that_are_not() -> None:
    """One cell, thresholds 0: the query's projections are 0.5, -0.01, -0.01 and nothing else."""
    projection = np.eye(64, dtype=np.float32)
    cell = np.full((1, 64), 0.125, np.float32)
    v = Vocabulary(
        cell, projection, np.zeros((1, 64), np.float32), np.zeros((1, 1, 64), np.float32)
    )
    query = np.zeros((1, 64), np.float32)
    query[0, :3] = 0.5, -0.01, -0.01
    code = np.array([0b000, 0b111, 0b001], np.uint64)
    m = Index.of_words(v, np.zeros(3, np.uint16), code, np.zeros(3, np.int64)).search(
        query, 3, 1, ALL
    )
    assert m.entry.tolist() == [2, 1, 0]
    assert m.distance.tolist() == [0, 2, 1]


TRAINED = train_vocabulary(unit(0, 600), cells=9, children=3)


def test_a_word_finds_itself_first_and_fewer_entries_than_asked_for_come_back() -> None:
    d = unit(3, 40)
    word, code = TRAINED.words(d)
    index = Index.of_words(TRAINED, word, code, np.zeros(40, np.int64))
    m = index.search(d, 100, 9, ALL)
    assert np.bincount(m.query).tolist() == [40] * 40  # all there are, once
    first = np.r_[True, np.diff(m.query) > 0]
    assert (m.distance[first] == 0).all()
    one = index.search(d, 1, 1, ALL)
    assert (one.distance == 0).all()
    assert (code[one.entry] == code).all()


def test_searches_with_nothing_to_find() -> None:
    d = unit(3, 5)
    word, code = TRAINED.words(d)
    for index, query, allowed in (
        (Index.of_words(TRAINED, word, code, np.zeros(5, np.int64)), d, Allowed(np.array([False]))),
        (Index.of_words(TRAINED, word, code, np.zeros(5, np.int64)), d[:0], ALL),
        (Index.of_words(TRAINED, word[:0], code[:0], np.zeros(0, np.int64)), d, ALL),
    ):
        m = index.search(query, 5, 3, allowed)
        assert [len(a) for a in (m.query, m.entry, m.distance)] == [0, 0, 0]


def test_kmeans_finds_clusters_that_lie_apart() -> None:
    rng = np.random.default_rng(0)
    centres = np.array([[0.0, 0], [0.5, 0], [0, 0.5], [0.5, 0.5], [0.7, 0.7]])
    data = np.concatenate([c + 0.005 * rng.standard_normal((40, 2)) for c in centres]).astype(
        np.float32
    )
    means = kmeans(data, 5, np.random.default_rng(3), 15)
    assert (((data[:, None] - means) ** 2).sum(2).min(1)).sum() < 0.25 * (
        (data - data.mean(0)) ** 2
    ).sum()
    assert np.isfinite(means).all()


class Picks:
    """A generator that starts two of three centroids in one place."""

    def choice(self, n: int, k: int, replace: bool) -> NDArray[np.int64]:
        return np.array([0, 1, 2])


def test_an_empty_centroid_takes_the_point_farthest_from_its_own() -> None:
    data = np.array([[0, 0], [0, 0], [0.5, 0], [0.5, 0.0625], [0.5, 0.5], [-0.0625, 0]], np.float32)
    assert [0.5, 0.5] in kmeans(data, 3, Picks(), rounds=15).tolist()  # type: ignore[arg-type]


@given(st.integers(0, 10_000), st.integers(1, 7), st.integers(1, 4), st.integers(1, 6))
@settings(max_examples=30)
def test_kmeans_is_lloyds_algorithm(seed: int, k: int, dimensions: int, rounds: int) -> None:
    """Beside points one by one; the sums of rounded points are exact in any order."""
    rng = np.random.default_rng(seed)
    points = grid(rng.uniform(-0.4, 0.4, (40, dimensions)).astype(np.float32))
    centroids = points[np.sort(np.random.default_rng(seed).choice(40, k, replace=False))].astype(
        float
    )
    for _ in range(rounds):
        nearest = [
            min(range(k), key=lambda c: (float(((p - centroids[c]) ** 2).sum()), c))
            for p in points.astype(float)
        ]
        distance = [
            float(((p - centroids[c]) ** 2).sum())
            for p, c in zip(points.astype(float), nearest, strict=True)
        ]
        farthest = sorted(range(40), key=lambda i: (-distance[i], i))
        moved = np.array(
            [
                grid(points[np.array(nearest) == c].astype(float).mean(0))
                if c in nearest
                else points[farthest.pop(0)]
                for c in range(k)
            ]
        )
        centroids = moved.astype(float)
    np.testing.assert_array_equal(kmeans(points, k, np.random.default_rng(seed), rounds), centroids)


def test_the_nearest_of_equal_centroids_is_the_first() -> None:
    nearest, distance = nearest_centroids(
        np.array([[0.5, 0], [0, 0.25]], np.float32),
        np.array([[0, 0], [0.5, 0], [0.5, 0], [0, 0]], np.float32),
    )
    assert nearest.tolist() == [1, 0]
    assert distance.tolist() == [0, 0.0625]


def test_training_is_repeatable_and_small_data_give_fewer_words() -> None:
    a = train_vocabulary(unit(0, 600), cells=9, children=3)
    b = TRAINED
    for k in ("cells", "projection", "thresholds", "children"):
        np.testing.assert_array_equal(getattr(a, k), getattr(b, k))
    assert len(train_vocabulary(unit(0, 512), cells=256, children=2).cells) == 8
    with pytest.raises(SettingsError, match="256 descriptors"):
        train_vocabulary(unit(0, 255))
    with pytest.raises(SettingsError, match="64 dimensions"):
        train_vocabulary(unit(0, 400)[:, :63])


def test_descriptors_may_have_64_dimensions_and_half_precision() -> None:
    d = unit(0, 700)[:, :64]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    v = train_vocabulary(grid(d).astype(np.float16), cells=10, children=4)
    assert (v.cells.shape, v.projection.shape) == ((10, 64), (64, 64))
    np.testing.assert_allclose(v.projected(d), grid(d) @ v.projection.T, atol=1e-6)
    word, code = v.words(d)
    m = Index.of_words(v, word, code, np.zeros(700, np.int64)).search(d[:50], 1, 1, ALL)
    assert (code[m.entry] == code[:50]).all()
    # multiples of 2^-11 below 1 have no more digits than half precision holds
    again = train_vocabulary(d, cells=10, children=4)
    for k in ("cells", "projection", "thresholds", "children"):
        np.testing.assert_array_equal(getattr(v, k), getattr(again, k))


def test_a_cell_of_few_descriptors_has_half_as_many_words() -> None:
    d = unit(0, 600)
    v = train_vocabulary(d, cells=9, children=256)
    words = v.words(d)[0]
    own = v.nearest_cells(d, 1)[:, 0]
    for cell in range(9):
        count = int((own == cell).sum())
        kids = v.children[cell]
        assert kids.shape == (256, BITS)
        assert len(np.unique(kids, axis=0)) <= max(1, count // 2)
        assert (words[own == cell] % 256 < max(1, count // 2)).all()


def test_children_of_more_words_lie_nearer() -> None:
    d = unit(0, 3000)
    own = np.arange(3000)

    def miss(children: int) -> float:
        v = train_vocabulary(d, cells=4, children=children)
        word = v.words(d)[0]
        return float(
            np.mean(
                np.linalg.norm(v.projected(d) - v.children[word // 256, word % 256], axis=1)[own]
            )
        )

    assert miss(64) < miss(8) < miss(1)


def test_vocabularies_come_back_and_code_the_same(vocabulary: Vocabulary, tmp_path: Path) -> None:
    path = tmp_path / "vocabulary.safetensors"
    save_vocabulary(path, vocabulary, {"trained_on": "random"})
    loaded = load_vocabulary("geometric", path)
    for k in ("cells", "projection", "children"):
        np.testing.assert_array_equal(getattr(loaded, k), getattr(vocabulary, k))
    assert load_file(path)["children"].dtype == np.int8
    np.testing.assert_allclose(loaded.thresholds, vocabulary.thresholds, atol=1e-3)
    d = unit(5, 200)
    word, code = loaded.words(d)
    own_word, own_code = vocabulary.words(d)
    assert word.tolist() == own_word.tolist()
    different = np.unpackbits((code ^ own_code).view(np.uint8)).sum()
    assert different < 0.002 * 64 * 200  # the thresholds alone lose digits
    again = tmp_path / "again.safetensors"
    save_vocabulary(again, loaded, {"trained_on": "random"})
    assert again.read_bytes() == path.read_bytes()


def test_children_of_half_precision_are_rounded_to_bytes(
    vocabulary: Vocabulary, tmp_path: Path
) -> None:
    """As vocabularies of fewer words had them."""
    halves = {
        k: getattr(vocabulary, k).astype(np.float16) for k in ("cells", "projection", "thresholds")
    }
    children = np.array([[[0.1] * 64, [0.9] * 64]] * 10, np.float16)
    save_file(halves | {"children": children}, tmp_path / "old.safetensors")
    children_read = load_vocabulary("geometric", tmp_path / "old.safetensors").children
    assert children_read[:, 0].tolist() == [[26 / 256] * 64] * 10
    assert children_read[:, 1].tolist() == [[127 / 256] * 64] * 10  # the end of the range


def test_files_that_hold_no_vocabulary_are_refused_by_name(
    vocabulary: Vocabulary, tmp_path: Path
) -> None:
    arrays = {
        k: getattr(vocabulary, k).astype(np.float16) for k in ("cells", "projection", "thresholds")
    }
    arrays["children"] = (vocabulary.children * 256).astype(np.int8)
    odd: dict[str, bytes | None] = {"missing": None, "bytes": b"x" * 50, "empty": b""}
    odd_arrays = {
        "fewer": {k: v for k, v in arrays.items() if k != "children"},
        "narrow": arrays | {"cells": arrays["cells"][:, :128].copy()},
        "unequal": arrays | {"thresholds": arrays["thresholds"][:5].copy()},
        "wide": arrays | {"children": arrays["children"].astype(np.float32)},
        "infinite": arrays | {"thresholds": np.full_like(arrays["thresholds"], np.inf)},
        "flat": arrays | {"children": arrays["children"].reshape(-1)},
        # 260 cells do not fit a byte
        "many": {
            k: v if k == "projection" else np.concatenate([v] * 26) for k, v in arrays.items()
        },
    }
    for name, content in odd.items():
        if content is not None:
            (tmp_path / name).write_bytes(content)
    for name, some in odd_arrays.items():
        save_file(some, tmp_path / name)
    for name in (*odd, *odd_arrays):
        with pytest.raises(SettingsError, match=name):
            load_vocabulary("geometric", tmp_path / name)


SCRIPT = """
import sys, hashlib, numpy as np
from semloc_logs.words.vocabulary import train_vocabulary, Vocabulary
rng = np.random.default_rng(0)
def unit(n):
    v = rng.standard_normal((n, 256))
    return (v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32)
grid = lambda a: (np.round(a * 2048) / 2048).astype(np.float32)
thresholds = rng.uniform(-0.1, 0.1, (200, 64)).astype(np.float32)
cells, projection = grid(unit(200)), grid(unit(64))
children = np.round(rng.uniform(-25, 25, (200, 5, 64))).astype(np.float32) / 256
v = Vocabulary(cells, projection, thresholds, children)
d = unit(3000)
digest = hashlib.sha256()
for a in (*v.words(d), v.nearest_cells(d, 8), (grid(d) @ v.cells.T)):
    digest.update(np.ascontiguousarray(a).tobytes())
one = np.concatenate([v.words(d[i : i + 7])[1] for i in range(0, 3000, 7)])
assert (one == v.words(d)[1]).all()
trained = train_vocabulary(unit(2000), cells=20, children=20)
for a in (trained.cells, trained.projection, trained.thresholds, trained.children):
    digest.update(a.tobytes())
print(digest.hexdigest())
"""


def test_words_do_not_depend_on_the_number_of_threads() -> None:
    outputs = set()
    for threads in ("1", "2", "3"):
        environment = os.environ | {"OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads}
        outputs.add(
            subprocess.run(
                [sys.executable, "-c", SCRIPT],
                env=environment,
                check=True,
                capture_output=True,
                text=True,
            ).stdout
        )
    assert len(outputs) == 1

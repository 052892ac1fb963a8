"""The benchmark of search finds what it looks for; no times."""

import sys

import numpy as np
import pytest

from semloc_logs.benchmarks.speed import search_speed as module
from semloc_logs.errors import SettingsError
from semloc_logs.settings import Settings
from semloc_logs.words.vocabulary import train_vocabulary


def test_more_probes_find_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "QUERIES", 200)
    trained = train_vocabulary(module.draw(1, 3000), cells=32, children=2)
    monkeypatch.setattr(module, "train_vocabulary", lambda *_, **__: trained)
    figures = module.search_speed(Settings().resolved(), [4000])
    recall = [float(figures[f"4000 words, {p} probes"]["found"]) for p in (1, 4, 8, 16)]
    assert 0.2 < recall[0] < recall[1] < recall[2] <= recall[3] <= 1
    assert recall[3] > 0.9


def test_draws_are_unit_vectors_with_falling_spread() -> None:
    v = module.draw(3, 2000)
    np.testing.assert_allclose(np.linalg.norm(v, axis=1), 1, atol=1e-5)
    assert v[:, 0].std() > 2 * v[:, 9].std() > 4 * v[:, 200].std()


def test_peers_that_there_are_not_are_refused() -> None:
    with pytest.raises(SettingsError, match="faiss=PYTHON"):
        module.search_speed(Settings().resolved(), [100], {"annoy": sys.executable})
    with pytest.raises(SettingsError, match="install faiss-cpu"):
        module._faiss(
            sys.executable + "-none",
            np.zeros(3, np.uint64),
            np.zeros(1, np.uint64),
            np.zeros(1, np.int64),
        )

"""The benchmark of the index's growth counts what it says; no times."""

import numpy as np
import pytest

from semloc_logs.benchmarks.speed import search_scaling as module
from semloc_logs.benchmarks.speed.search_speed import draw
from semloc_logs.errors import SettingsError
from semloc_logs.settings import Settings
from semloc_logs.words.vocabulary import train_vocabulary


def streets(radius: float = 1.5) -> module.Streets:
    """600 words of three streets, far from each other; every third is searched for a metre away."""
    d = draw(1, 600)
    centre = np.stack([3.0 * np.arange(600), np.zeros(600), np.zeros(600)], 1)
    asked = d[::3] + 0.05 * draw(2, 200)
    return module.Streets(
        centre,
        d,
        np.arange(600) // 200,
        centre[::3] + np.array([0, 1.0, 0]),
        np.asarray(asked, np.float32),
        radius,
    )


def test_maps_grow_and_sessions_come_and_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "POOL", 500)
    figures = module.search_scaling(
        Settings().resolved(),
        streets(),
        train_vocabulary(draw(1, 600), cells=8, children=4),
        (10, 40),
        70,
    )
    assert [figures[f"{km} km: a query"]["words"] for km in (10, 40)] == [700, 2800]
    for km in (10, 40):
        assert float(figures[f"{km} km: a query"]["found"]) > 0.9
        megabytes = float(figures[f"{km} km: files"]["ours"])
        assert megabytes * 1e6 > 32 * float(figures[f"{km} km: a query"]["words"])


def test_copies_lie_as_far_off_as_other_streets() -> None:
    s = streets()
    apart = s.apart()
    slow = [
        min(
            float(np.linalg.norm(s.descriptor[i] - s.descriptor[j]))
            for j in range(600)
            if s.street[i] != s.street[j]
        )
        for i in (0, 250)
    ]
    assert 0.5 < apart / np.mean(slow) < 2
    moved = s.moved(50)
    nearest = np.sqrt(np.maximum(2 - 2 * (moved @ s.descriptor.T).max(1), 0))
    assert 0.4 * apart < np.median(nearest) <= 1.05 * apart


def test_words_that_ask_need_a_true_one() -> None:
    with pytest.raises(SettingsError, match="true one"):
        streets(0.5).queries()

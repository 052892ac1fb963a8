"""Pair lists of the LiDAR-Registration-Benchmark."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from semloc_logs.errors import TruthError
from semloc_logs.experiments.pair_lists import RegistrationPair, pair_scenario, read_pairs
from semloc_logs.experiments.views import ViewStore
from semloc_logs.numerics.transforms import yaw_transform

SECOND = 1_000_000_000
# five frames a second; the store has a view each second from the first second on
FRAMES_NS = SECOND // 5 * np.arange(100)
PLACES = [(float(x), 0.0, 0.0) for x in range(10)]


def test_a_pair_list_of_the_benchmark_is_read(tmp_path: Path) -> None:
    # as the benchmark writes it: 15 titles for 16 numbers, and an overlap that not all lists have
    path = tmp_path / "test_0_10.txt"
    titles = "seq i seq_db j " + " ".join(f"mot{k}" for k in range(1, 16))
    matrix = "0.0 -1.0 0.0 3.0 1.0 0.0 0.0 4.0 0.0 0.0 1.0 0.5 0.0 0.0 0.0 1.0"
    path.write_text(f"{titles}\n8 10 8 1000 {matrix}\n\n8 11 8 1001 {matrix} 0.73\n")
    pairs = read_pairs(path)
    assert [(p.sequence, p.source, p.target_sequence, p.target) for p in pairs] == [
        (8, 10, 8, 1000),
        (8, 11, 8, 1001),
    ]
    assert np.allclose(pairs[0].target_T_source, yaw_transform(np.pi / 2, (3.0, 4.0, 0.5)))


def test_a_list_of_another_form_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "list.txt"
    path.write_text("titles\n8 10 8\n")
    with pytest.raises(TruthError, match="line 2: give four whole numbers and a 4x4 matrix"):
        read_pairs(path)
    with pytest.raises(TruthError, match="cannot be read"):
        read_pairs(tmp_path / "absent.txt")


def pair(source: int, target: int, sequence: int = 8) -> RegistrationPair:
    return RegistrationPair(sequence, source, sequence, target, np.eye(4))


def test_a_pair_is_a_query_in_a_database_of_one_view(make_store: Callable[..., ViewStore]) -> None:
    store = make_store(kitti_07=PLACES, kitti_08=PLACES)
    frames = {"kitti_07": FRAMES_NS, "kitti_08": FRAMES_NS}
    # views 0 to 9 of either session are at 1 s to 10 s, frames 5 to 50
    scenario = pair_scenario(store, [pair(10, 30), pair(6, 44), pair(5, 5, 7)], frames)
    assert scenario.name == "pairs"
    trials = [(t.queries[0].view, t.database.tolist()) for t in scenario.trials]
    # 6 is 0.2 s after the first view, 44 is 0.2 s before the ninth
    # a view is not paired with itself
    assert trials == [(11, [15]), (10, [18])]
    assert scenario.trials[0].queries[0].name == "kitti_08@2000000000 on kitti_08@6000000000"
    assert [t.queries[0].passage for t in scenario.trials] == [0, 1]


@pytest.mark.parametrize(
    "missing", [pair(10, 100), pair(10, 30, 5), pair(0, 30)], ids=["frame", "sequence", "view"]
)
def test_pairs_without_views_are_left_out(
    make_store: Callable[..., ViewStore], missing: RegistrationPair
) -> None:
    store = make_store(kitti_08=PLACES)
    frames = {"kitti_08": FRAMES_NS}
    assert len(pair_scenario(store, [missing, pair(10, 30)], frames).trials) == 1
    with pytest.raises(TruthError, match="names of sessions end with the number of one"):
        pair_scenario(store, [missing], frames)

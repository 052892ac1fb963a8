from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from semloc_logs.benchmarks.descriptors import completion as module
from semloc_logs.benchmarks.descriptors.completion import completion_benchmark, completion_figures
from semloc_logs.errors import SettingsError
from semloc_logs.pictures.boxes import draw_boxes
from semloc_logs.pictures.colours import class_colours
from semloc_logs.pictures.completion_picture import draw_completions
from semloc_logs.settings import Settings
from semloc_logs.subvolumes.completed import Completed, completed, load_completion
from semloc_logs.training.pairs import BROAD, write_shard
from semloc_logs.training.scene_shards import SceneTask

CLASSES, FREE, UNOBSERVED, UNKNOWN = 19, 19, 20, 21


def codes(*values: int) -> np.ndarray:
    """A tiny subvolume in place of 32^3 voxels."""
    return np.array(values, np.uint8).reshape(1, -1, 1, 1)


def test_figures_by_hand() -> None:
    # the last two do not count
    truth = codes(2, 2, 8, 8, FREE, FREE, FREE, FREE, UNOBSERVED, UNKNOWN)
    predicted = codes(2, 8, 8, 8, FREE, FREE, FREE, 2, FREE, FREE)
    given = codes(2, UNOBSERVED, 8, UNKNOWN, FREE, UNOBSERVED, UNOBSERVED, FREE, 3, 3)
    figures = completion_figures(Completed(given, predicted, truth, truth, CLASSES))
    assert figures["accuracy"]["ours"] == pytest.approx(6 / 8)
    assert figures["accuracy"]["all_free"] == pytest.approx(4 / 8)
    assert figures["accuracy"]["copy_input"] == pytest.approx(4 / 8)
    assert figures["accuracy"]["paper"] == 0.87
    assert figures["accuracy"]["most_probable"] == 1.0
    assert figures["unobserved_accuracy"]["ours"] == pytest.approx(2 / 3)
    assert figures["unobserved_accuracy"]["all_free"] == pytest.approx(2 / 3)
    assert figures["mean_iou"]["ours"] == pytest.approx((1 / 3 + 2 / 3) / 2)
    assert figures["occupied_iou"]["ours"] == pytest.approx(4 / 5)
    assert figures["free_iou"]["ours"] == pytest.approx(3 / 4)
    # the voxel of unknown class is there
    assert figures["occupied_iou"]["copy_input"] == pytest.approx(3 / 4)
    assert figures["free_iou"]["copy_input"] == pytest.approx(2 / 4)
    assert all("8 voxels" in str(row["unit"]) for row in figures.values())


def test_a_perfect_answer() -> None:
    truth = np.random.default_rng(0).integers(0, 20, (2, 4, 4, 4)).astype(np.uint8)
    figures = completion_figures(
        Completed(np.full_like(truth, UNOBSERVED), truth, truth, truth, CLASSES)
    )
    assert [row["ours"] for row in figures.values()] == [1.0] * len(figures)


def pairs(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    whole = np.full((n, BROAD, BROAD, 32), 254, np.uint8)
    whole[:, :, :, 3] = 0
    whole[:, 20:40, 30, 4:20] = 2
    part = whole.copy()
    part[:, 32:] = 253
    return part, np.ascontiguousarray(whole[:, 16:-16, 16:-16]), whole


@pytest.mark.parametrize("variant", ["semantic", "geometric"])
def test_the_shipped_network_completes(variant: str) -> None:
    model = load_completion(variant)
    completion = completed(model, pairs(1))
    assert completion.completed.shape == (1, 32, 32, 32)
    figures = completion_figures(completion)
    assert float(figures["accuracy"]["ours"]) > float(figures["accuracy"]["copy_input"])


def test_other_weights_are_refused(tmp_path: Path) -> None:
    (tmp_path / "none.safetensors").write_bytes(b"nothing of the kind")
    for path in (tmp_path / "none.safetensors", tmp_path / "missing"):
        with pytest.raises(SettingsError, match="no weights"):
            load_completion("semantic", path)


def test_the_benchmark_draws_what_it_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def shard(task: SceneTask) -> Path:
        write_shard(task.shard, list(zip(*pairs(2), strict=True)))
        return task.shard

    monkeypatch.setattr(module, "make_shard", shard)
    monkeypatch.setattr(module, "SEEDS", (9001,))
    picture = tmp_path / "completion.png"
    figures = completion_benchmark(
        "semantic", Settings().resolved(), work=tmp_path / "work", picture=picture
    )
    assert set(figures) == {
        "accuracy",
        "mean_iou",
        "occupied_iou",
        "free_iou",
        "unobserved_accuracy",
    }
    image = cv2.imread(str(picture))
    assert image is not None
    tops = class_colours()[[0, 2]][:, ::-1]
    for colour in tops:  # road and building show with the tops of their boxes
        assert (image == colour).all(2).any()


def test_boxes_hide_what_is_behind_and_below() -> None:
    state = np.full((4, 4, 4), 254, np.uint8)
    state[0, 0, 0] = 8
    assert (draw_boxes(state) == class_colours()[8]).all(2).sum() > 50
    state[1, 1, 1] = 2  # on the line of sight
    hidden = draw_boxes(state)
    assert not (hidden == class_colours()[8]).all(2).any()
    assert (hidden == class_colours()[2]).all(2).sum() > 50
    empty = draw_boxes(np.full((4, 4, 4), 253, np.uint8))
    assert (empty.min(2) >= 200).all()


def test_no_rows_are_a_picture_too(tmp_path: Path) -> None:
    nothing = np.zeros((0, 32, 32, 32), np.uint8)
    draw_completions(tmp_path / "none.png", "semantic", nothing, nothing, nothing)
    assert cv2.imread(str(tmp_path / "none.png")) is not None

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from semloc_logs.arrays import U8
from semloc_logs.errors import SettingsError, WorkspaceError
from semloc_logs.settings import Settings, Training
from semloc_logs.subvolumes.cut import SIZE, code_table
from semloc_logs.subvolumes.describe import load_encoder
from semloc_logs.training import network_training
from semloc_logs.training.batches import batches
from semloc_logs.training.completion_scores import completion_scores
from semloc_logs.training.network_training import Progress, TrainingRun, _seen, targets, train
from semloc_logs.training.pairs import (
    BROAD,
    SceneFrame,
    cut_pairs,
    occupied,
    read_shard,
    write_shard,
)
from semloc_logs.training.schedule import learning_rate, scene_window

Pair = tuple[U8, U8, U8]


def pair(rng: np.random.Generator) -> Pair:
    """A floor and some boxes; half of it unseen in the incomplete view."""
    whole = np.full((BROAD, BROAD, SIZE), 254, np.uint8)
    whole[:, :, 4] = 0
    for _ in range(10):
        x = rng.integers(0, BROAD - 8)
        y = rng.integers(0, BROAD - 8)
        h = rng.integers(6, 30)
        whole[x : x + 6, y : y + 6, 5:h] = rng.choice([2, 8])
    part = whole.copy()
    part[rng.random(part.shape) < 0.5] = 253
    return part, np.ascontiguousarray(whole[16:-16, 16:-16]), whole


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("shards")
    rng = np.random.default_rng(0)
    paths = [folder / "a.parquet", folder / "b.parquet", folder / "empty.parquet"]
    for path, n in zip(paths, (5, 3, 0), strict=True):
        write_shard(path, [pair(rng) for _ in range(n)])
    return paths


def test_shards_come_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    pairs = [pair(rng) for _ in range(3)]
    write_shard(tmp_path / "shard", pairs)
    shard = read_shard(tmp_path / "shard")
    for k in range(3):
        np.testing.assert_array_equal(shard[k], np.stack([p[k] for p in pairs]))
    write_shard(tmp_path / "none", [])
    assert [a.shape[0] for a in read_shard(tmp_path / "none")] == [0, 0, 0]


def test_the_three_views_of_a_batch_belong_together(tmp_path: Path) -> None:
    """Row n of a shard is full of the value n, and its corner tells how a view was turned."""
    paths = []
    for s in range(4):
        paths.append(tmp_path / f"{s}")
        rows = []
        for n in range(6):
            views = [
                np.full(shape, 10 * s + n, np.uint8)
                for shape in ((BROAD, BROAD, SIZE), (SIZE, SIZE, SIZE), (BROAD, BROAD, SIZE))
            ]
            for view in views:
                # half an edge: no quarter turn and no mirror image looks alike
                view[0, : len(view) // 2, 0] = 200
            rows.append((views[0], views[1], views[2]))
        write_shard(paths[-1], rows)
    settings = Training(batch=5, dropout=0.1)
    turns = set()
    scenes = set()
    for batch in batches(paths, settings, 0, 40):
        a, b, c = (np.asarray(view) for view in batch)
        assert a.shape == (5, BROAD, BROAD, SIZE)
        assert b.shape == (5, SIZE, SIZE, SIZE)
        for n in range(5):
            value = int(b[n, 5, 5, 5])
            assert int(c[n, 9, 9, 9]) == value
            assert set(np.unique(a[n]).tolist()) == {value, 200, 253}
            marks = [
                frozenset(
                    map(
                        tuple,
                        (np.argwhere(view[n, :, :, 0] == 200) * 64 // len(view[n]) // 32).tolist(),
                    )
                )
                for view in (a, b, c)
            ]
            assert marks[0] == marks[1] == marks[2]
            turns.add(
                marks[0] | {(len(np.unique(np.argwhere(c[n, :, :, 0] == 200)[:, 0])) > 1, -1)}
            )
            scenes.add(value // 10)
        assert 0.05 < (a == 253).mean() < 0.15
        assert not (b == 253).any()
        assert not (c == 253).any()
    assert len(turns) == 8  # all quarter turns and mirror images
    assert len(scenes) > 1


def test_batches_are_the_same_each_time_and_from_any_step(shards: list[Path]) -> None:
    settings = Training(batch=3)
    whole = list(batches(shards[:2], settings, 0, 5))
    rest = list(batches(shards[:2], settings, 3, 5))
    assert len(whole) == 5
    for x, y in zip(whole[3:], rest, strict=True):
        for a, b in zip(x, y, strict=True):
            np.testing.assert_array_equal(a, b)
    other = next(batches(shards[:2], Training(batch=3, seed=1), 0, 5))
    assert not np.array_equal(whole[0][0], other[0])


def test_which_subvolumes_are_described_and_which_voxels_count() -> None:
    part = np.full((2, BROAD, BROAD, SIZE), 253, np.uint8)
    part[1, 8:16, 8:13, 3] = 2  # 40 voxels in the corner of the first subvolume only
    seen = _seen(torch.from_numpy(part)).reshape(2, 3, 3)
    assert not seen[0].any()
    assert torch.argwhere(seen[1]).tolist() == [[0, 0]]
    table = torch.from_numpy(code_table("semantic"))
    target, known = targets(torch.tensor([0, 18, 254, 253, 255], dtype=torch.uint8), table, 19)
    assert known.tolist() == [True, True, True, False, False]
    assert target[known].tolist() == [0, 18, 19]


def short(steps: int, **more: float) -> Training:
    return Training.model_validate({"batch": 2, "samples": max(32, steps * 18), **more})


def test_the_loss_goes_down(
    shards: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(network_training, "RATE", 0.1)  # of a warm-up over fifty steps
    seen: list[Progress] = []
    model = train(
        "geometric", shards[:1], short(12), TrainingRun(tmp_path / "checkpoint"), seen.append
    )
    assert [p.samples for p in seen] == [18 * (i + 1) for i in range(12)]
    assert seen[-1].reconstruction < 0.8 * seen[0].reconstruction
    assert seen[-1].loss < seen[0].loss
    assert all(np.isfinite([p.loss, p.contrastive, p.matched]).all() for p in seen)
    assert model is not None
    scores = completion_scores(model, tuple(a[:2] for a in read_shard(shards[0])))  # type: ignore[arg-type]
    assert set(scores) == {
        "accuracy",
        "all_free",
        "copy_input",
        "unobserved_accuracy",
        "iou",
        "recall5",
    }
    assert all(0 <= v <= 1 for v in scores.values())
    assert scores["all_free"] > 0.5
    assert scores["recall5"] == 1  # two of two are among the five nearest


class _Stop(Exception):
    pass


def test_a_training_that_was_stopped_ends_where_an_unbroken_one_does(
    shards: list[Path], tmp_path: Path
) -> None:
    settings = short(4)
    whole = train("geometric", shards, settings, TrainingRun(tmp_path / "whole"))

    def stop(progress: Progress) -> None:
        if progress.samples == 3 * 18:
            raise _Stop

    checkpoint = tmp_path / "broken"
    with pytest.raises(_Stop):
        train("geometric", shards, settings, TrainingRun(checkpoint, save_every=2), stop)
    seen: list[Progress] = []
    resumed = train(
        "geometric", shards, settings, TrainingRun(checkpoint, save_every=2), seen.append
    )
    assert [p.samples for p in seen] == [54, 72]  # from the checkpoint, not from the start
    assert whole is not None
    assert resumed is not None
    for (name, a), b in zip(whole.state_dict().items(), resumed.state_dict().values(), strict=True):
        assert torch.equal(a, b), name
    for odd, message in ((short(4, seed=1), "settings"), (short(5), "settings")):
        with pytest.raises(WorkspaceError, match=message):
            train("geometric", shards, odd, TrainingRun(checkpoint))
    with pytest.raises(WorkspaceError, match="settings"):
        train("semantic", shards, settings, TrainingRun(checkpoint))
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    with pytest.raises(WorkspaceError, match="broken"):
        train("geometric", shards, settings, TrainingRun(checkpoint))


def test_a_training_stops_in_time_and_leaves_snapshots(shards: list[Path], tmp_path: Path) -> None:
    settings = short(4)
    checkpoint = tmp_path / "checkpoint"
    seen: list[Progress] = []
    for steps in (1, 2, 3):  # a deadline that is over allows one step each time
        assert (
            train(
                "geometric",
                shards,
                settings,
                TrainingRun(checkpoint, deadline=0.0, snapshots=tmp_path),
                seen.append,
            )
            is None
        )
        assert [p.samples for p in seen] == [18 * (i + 1) for i in range(steps)]
    run = TrainingRun(checkpoint, deadline=0.0)
    assert train("geometric", shards, settings, run, seen.append) is not None
    assert len(seen) == 4
    assert sorted(p.name for p in tmp_path.glob("geometric-*")) == [
        "geometric-000000018.safetensors",
        "geometric-000000036.safetensors",
    ]
    assert load_encoder("geometric", tmp_path / "geometric-000000036.safetensors").latent == 256


def test_scenes_come_into_use_and_leave_again() -> None:
    assert scene_window(0, 4000) == range(12)
    assert scene_window(3999, 4000) == range(12)
    assert scene_window(4000, 4000) == range(13)
    assert scene_window(10**6, 4000) == range(6, 262)
    assert scene_window(16 * 10**6, 4000) == range(3744, 4000)
    assert scene_window(10**6, 100) == range(100)
    # the paper takes one sample of a pair, and so many pairs a scene
    assert scene_window(4000 // 9 + 1, 4000, "paper") == range(13)
    assert scene_window(4000 // 9, 4000, "paper") == range(12)


def test_scenes_are_used_as_they_come(shards: list[Path]) -> None:
    """A pool of 12 x 32 pairs, 3456 samples, begins with the first 12 scenes; one more is in use
    after 4000 samples.
    """
    read: list[int] = []

    class Scenes(Sequence[Path]):
        def __len__(self) -> int:
            return 50

        def __getitem__(self, index: Any) -> Any:
            read.append(index)
            return shards[0]

    list(batches(Scenes(), Training(batch=12), 0, 32 * 20))
    pools = [read[i : i + 12] for i in range(0, len(read), 12)]
    assert len(pools) == 20
    assert sorted(pools[0]) == list(range(12))
    for number, pool in enumerate(pools):
        assert max(pool) < 12 + 3456 * number // 4000
        assert len(set(pool)) == 12
    assert max(pools[-1]) >= 20
    longer: list[int] = list(read)
    read.clear()
    list(batches(Scenes(), Training(batch=12, samples=10**7), 0, 32 * 20))
    assert sorted(read) == sorted(longer)  # whatever the length of the training
    read.clear()
    list(batches(Scenes(), Training(batch=48), 0, 1))
    # a batch of more pairs takes several parts of each scene
    assert sorted(set(read[:48])) == list(range(12))
    assert len(read) >= 48


def test_a_scene_that_comes_too_late_ends_the_training_in_time(
    shards: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("semloc_logs.training.batches.PATIENCE", 0.2)
    late = threading.Event()
    begun = time.monotonic()

    class Scenes(Sequence[Path]):
        def __len__(self) -> int:
            return 2

        def __getitem__(self, index: Any) -> Any:
            late.wait(20)
            return shards[index]

    try:
        assert (
            train(
                "geometric",
                Scenes(),
                short(4),
                TrainingRun(tmp_path / "checkpoint", deadline=time.monotonic()),
            )
            is None
        )
    finally:
        late.set()
    assert time.monotonic() - begun < 10
    assert not (tmp_path / "checkpoint").exists()


def test_the_rate_rises_stays_and_falls() -> None:
    rates = [learning_rate(step, 1000) for step in range(1000)]
    assert rates[0] == pytest.approx(1 / 50)
    assert rates[49:750] == [1.0] * 701
    assert rates[875] == pytest.approx(0.02 + 0.98 / 2)
    assert 0.02 < rates[999] < 0.021
    assert learning_rate(700, 10**6) == rates[700]


def test_a_training_can_be_made_longer_from_its_plateau(shards: list[Path], tmp_path: Path) -> None:
    short_run = tmp_path / "short"
    long_run = tmp_path / "long"
    train("geometric", shards, short(4), TrainingRun(short_run))
    whole = train("geometric", shards, short(8), TrainingRun(long_run))
    with pytest.raises(WorkspaceError, match="settings"):
        train("geometric", shards, short(8), TrainingRun(short_run))  # its rate has fallen already
    plateau = tmp_path / "short.plateau.safetensors"
    seen: list[Progress] = []
    longer = train("geometric", shards, short(8), TrainingRun(plateau), seen.append)
    assert [p.samples for p in seen] == [18 * (i + 1) for i in range(3, 8)]
    assert whole is not None
    assert longer is not None
    for (name, a), b in zip(whole.state_dict().items(), longer.state_dict().values(), strict=True):
        assert torch.equal(a, b), name


def test_nothing_to_train_on(shards: list[Path], tmp_path: Path) -> None:
    for paths in ([], shards[2:]):
        with pytest.raises(SettingsError, match="nothing to train on"):
            train("geometric", paths, short(4), TrainingRun(tmp_path / "checkpoint"))
    assert pq.read_metadata(shards[2]).num_rows == 0


def test_a_batch_without_anything_to_describe_keeps_the_weights_finite(tmp_path: Path) -> None:
    bare = np.full((BROAD, BROAD, SIZE), 254, np.uint8)
    bare[32, 32, :3] = 2
    write_shard(tmp_path / "shard", [(bare, bare[16:-16, 16:-16], bare)])
    run = TrainingRun(tmp_path / "checkpoint", save_every=1)
    model = train("geometric", [tmp_path / "shard"], short(1), run)
    assert model is not None
    assert all(torch.isfinite(p).all() for p in model.parameters())


def test_pairs_are_cut_from_the_same_place() -> None:
    """A street of two fronts, driven along; the incomplete view never shows what the complete one
    does not know.
    """
    rng = np.random.default_rng(0)
    fusion = Settings().resolved().fusion
    front = np.c_[
        rng.uniform(-10, 10, 6000),
        rng.choice([-5.0, 5.0], 6000) + rng.normal(0, 0.02, 6000),
        rng.uniform(0, 5, 6000),
    ]
    road = np.c_[rng.uniform(-10, 10, 4000), rng.uniform(-5, 5, 4000), rng.normal(0, 0.02, 4000)]
    world = np.concatenate([front, road]).astype(np.float32)
    label = np.r_[np.full(6000, 2), np.full(4000, 0)].astype(np.uint8)
    frames = []
    for x in (-2.0, 0.0, 2.0):
        T = np.eye(4)
        T[:3, 3] = x, 0, 1.7
        some = rng.random(len(world)) < 0.4
        frames.append(
            SceneFrame(
                world[some] - np.array([x, 0, 1.7], np.float32),
                np.zeros(3, np.float32),
                label[some],
                T,
            )
        )
    settings = Training(shift=0.0, turn=0.0, tilt=0.0)
    pairs = cut_pairs(frames, fusion, settings, np.random.default_rng(1))
    assert len(pairs) > 10
    for part, whole, other in pairs:
        assert (part.shape, whole.shape, other.shape) == (
            (BROAD, BROAD, SIZE),
            (SIZE, SIZE, SIZE),
            (BROAD, BROAD, SIZE),
        )
        # without shift and turn the same view
        np.testing.assert_array_equal(other[16:-16, 16:-16], whole)
        middle = part[16:-16, 16:-16]
        assert occupied(middle).sum() >= 40
        both = occupied(middle) & (whole != 253)
        assert (occupied(middle) & (whole == 253)).sum() == 0
        assert (middle[both] == whole[both]).mean() > 0.9
    again = cut_pairs(frames, fusion, settings, np.random.default_rng(1))
    assert all(
        np.array_equal(a, b)
        for x, y in zip(pairs, again, strict=True)
        for a, b in zip(x, y, strict=True)
    )
    moved = cut_pairs(frames, fusion, Training(), np.random.default_rng(1))
    assert any(not np.array_equal(o[16:-16, 16:-16], w) for _, w, o in moved)

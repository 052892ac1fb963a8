"""Learning on tiny shards: training, held-out scores, resuming, and the model card."""

import json
from collections.abc import Iterator
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from semloc_logs.engines import make_engine
from semloc_logs.errors import SettingsError
from semloc_logs.numerics.transforms import apply, yaw_transform
from semloc_logs.settings import Resolved, load
from semloc_logs.tables import contracts
from semloc_logs.tables.table import write_json, write_table
from semloc_logs.training.batches import _drawn
from semloc_logs.training.checkpoints import _goes_on
from semloc_logs.training.network_training import RECIPES, TrainingRun, train
from semloc_logs.training.own_sessions import session_frames, stretch_tasks
from semloc_logs.training.pairs import read_shard, write_shard
from semloc_logs.training.runs import (
    Packed,
    learn_descriptor,
    learn_vocabulary,
    session_shards,
    simulated_shards,
)
from semloc_logs.voxels.store import Keyframe, keep_keyframes, pose_columns
from semloc_logs.words.plain_vocabulary import load_plain_vocabulary
from semloc_logs.workspace import SessionFolder

METADATA = {"schema_version": 1}


def _settings(**training: Any) -> Resolved:
    return load(assignments={f"training.{k}": str(v) for k, v in training.items()}).resolved()


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Path]]:
    """Four shards of six pairs each: a floor, and walls at random places."""
    folder = tmp_path_factory.mktemp("shards")
    rng = np.random.default_rng(0)
    paths = []
    for n in range(4):
        pairs = []
        for _ in range(6):
            world = np.full((64, 64, 32), 254, np.uint8)
            world[:, :, 8] = 0
            x, y = rng.integers(20, 40, 2)
            world[x, :, 8:24] = 2
            world[:, y, 8:16] = 8
            part = np.where(rng.random(world.shape) < 0.5, 253, world).astype(np.uint8)
            pairs.append((part, np.ascontiguousarray(world[16:-16, 16:-16]), world))
        paths.append(folder / f"scene-{n}.parquet")
        write_shard(paths[-1], pairs)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield paths
    torch.set_num_threads(threads)


def test_a_descriptor_is_learned_measured_and_described(shards: list[Path], tmp_path: Path) -> None:
    settings = _settings(samples=54, batch=2, seed=5)
    notes = list[str]()
    output = tmp_path / "geometric.safetensors"
    checkpoint = tmp_path / "checkpoint.safetensors"
    scores = learn_descriptor(
        "geometric",
        Packed(shards[:2], shards[2:]),
        settings,
        TrainingRun(checkpoint),
        output,
        notes.append,
    )
    assert scores is not None
    assert {"accuracy", "recall5"} <= set(scores)
    assert all(0 <= s <= 1 for s in scores.values())
    assert "54 of 54 samples" in notes[-1]
    with safe_open(output, "pt") as handle:
        card = handle.metadata()
    assert json.loads(card["scores"]) == pytest.approx(scores)
    assert (card["variant"], card["samples"], card["seed"], card["shards"]) == (
        "geometric",
        "54",
        "5",
        "2",
    )
    # the finished checkpoint is not trained again, and gives the same network
    first = load_file(output)
    notes = []
    assert learn_descriptor(
        "geometric",
        Packed(shards[:2], shards[2:]),
        settings,
        TrainingRun(checkpoint),
        output,
        notes.append,
    ) == pytest.approx(scores)
    assert notes == []
    assert all(torch.equal(tensor, first[name]) for name, tensor in load_file(output).items())


def test_two_scenes_are_too_few(shards: list[Path], tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="at least 3"):
        learn_descriptor(
            "geometric",
            Packed(shards[:2], []),
            _settings(),
            TrainingRun(tmp_path / "c"),
            tmp_path / "w",
            lambda _: None,
        )
    assert list(tmp_path.iterdir()) == []


def test_a_vocabulary_belongs_to_its_weights(shards: list[Path], tmp_path: Path) -> None:
    settings = _settings(samples=36, batch=2)
    weights = tmp_path / "geometric.safetensors"
    learn_descriptor(
        "geometric",
        Packed(shards[:2], shards[2:]),
        settings,
        TrainingRun(tmp_path / "c.safetensors"),
        weights,
        lambda _: None,
    )
    own = settings.model_copy(
        update={"descriptor": settings.descriptor.model_copy(update={"weights": weights})}
    )
    # the setting is of trainings to come; these weights have seen 36
    own = own.model_copy(
        update={"training": settings.training.model_copy(update={"samples": 250_000})}
    )
    output = tmp_path / "words.safetensors"
    # 24 pairs of nine descriptors are fewer than 256: three times the same shards are enough
    with pytest.raises(SettingsError, match="256"):
        learn_vocabulary("geometric", shards, own, output, 6)
    assert learn_vocabulary("geometric", [*shards, *shards], own, output, 6) == 8 * 6 * 9
    with safe_open(output, "np") as handle:
        assert handle.metadata()["descriptors"] == "432"
        assert handle.metadata()["samples"] == "36"
        assert handle.get_tensor("projection").shape == (64, 256)


# -- sessions of one's own


def _session(folder: SessionFolder, n: int, posed: bool = True) -> list[np.ndarray[Any, Any]]:
    """A drive along x, 1 m a keyframe, between two walls; the points of each keyframe."""
    rng = np.random.default_rng(3)
    poses = np.array([yaw_transform(0.0, (float(k), 0.0, 1.5)) for k in range(n)])
    clouds = []
    for pose in poses:
        x = pose[0, 3] + rng.uniform(-15, 15, 3000)
        ground = np.stack([x, rng.uniform(-6, 6, 3000), np.zeros(3000)], 1)
        walls = np.stack(
            [x, np.where(rng.random(3000) < 0.5, -6.0, 6.0), rng.uniform(0, 5, 3000)], 1
        )
        clouds.append((np.concatenate([ground, walls]) - pose[:3, 3]).astype(np.float32))
    label = np.repeat([0, 2], 3000).astype(np.uint8)
    stamps = (np.arange(n) * 10**9).tolist()
    frames = {
        "keyframe": np.arange(n),
        "stamp_ns": stamps,
        "log_time_ns": stamps,
        "topic": ["/points"] * n,
        "posed": [posed] * n,
        "distance": np.arange(n, dtype=float),
        "ground_z": np.zeros(n),
        "points": np.full(n, 6000),
        "origin_x": np.full(n, 0.25, np.float32),
        "origin_y": np.zeros(n, np.float32),
        "origin_z": np.zeros(n, np.float32),
        **{f"view_{c}": np.zeros(n, np.float32) for c in "xyz"},
        **pose_columns(poses),
    }
    write_table(folder.frames, contracts.table("frames", frames), METADATA)
    folder.keyframes.mkdir()
    list(
        keep_keyframes(
            folder.keyframes, stamps, (Keyframe(cloud, label) for cloud in clouds), METADATA
        )
    )
    write_json(folder.session_json, {"posed": posed})
    return clouds


def test_session_frames_are_the_keyframes(tmp_path: Path) -> None:
    folder = SessionFolder(tmp_path / "sessions/drive")
    clouds = _session(folder, 70)
    frames = session_frames(folder, 60, 68)
    assert len(frames) == 8
    np.testing.assert_allclose(frames[5].points, clouds[65], atol=0.002)
    np.testing.assert_allclose(frames[5].map_T_base, yaw_transform(0.0, (65.0, 0.0, 1.5)))
    np.testing.assert_allclose(frames[5].origin, (0.25, 0, 0))
    assert np.bincount(frames[5].label).tolist() == [3000, 0, 3000]
    heights = apply(frames[5].map_T_base, frames[5].points)[:, 2]
    assert heights[:3000].max() < 0.01
    assert len(session_frames(folder)) == 70


def test_stretches_cover_the_road_once(tmp_path: Path) -> None:
    folder = SessionFolder(tmp_path / "sessions/drive")
    _session(folder, 130)
    tasks = stretch_tasks(tmp_path / "shards", [folder], load().resolved())
    assert [t.last - t.first for t in tasks][:2] == [61, 61]
    assert tasks[-1].last == 130
    assert len({t.shard for t in tasks}) == len(tasks)


def test_sessions_become_shards_of_pairs_once(tmp_path: Path) -> None:
    folder = SessionFolder(tmp_path / "sessions/drive")
    _session(folder, 12)
    settings = load().resolved()
    (shard,) = session_shards(
        tmp_path / "shards", [folder], settings, make_engine("serial"), lambda _: None
    ).every
    part, whole, other = read_shard(shard)
    assert len(part) == len(whole) == len(other) > 20
    assert {0, 2, 254} <= set(np.unique(whole).tolist())
    written = shard.stat().st_mtime_ns
    session_shards(tmp_path / "shards", [folder], settings, make_engine("serial"), lambda _: None)
    assert shard.stat().st_mtime_ns == written
    other_voxels = load(assignments={"fusion.voxel_size": "0.2"}).resolved()
    assert session_shards(
        tmp_path / "shards", [folder], other_voxels, make_engine("serial"), lambda _: None
    ).every != [shard]


def test_sessions_without_poses_teach_nothing(tmp_path: Path) -> None:
    folder = SessionFolder(tmp_path / "sessions/drive")
    _session(folder, 12, posed=False)
    assert session_frames(folder) == []
    with pytest.raises(SettingsError, match="poses"):
        session_shards(
            tmp_path / "shards", [folder], load().resolved(), make_engine("serial"), lambda _: None
        )


def test_used_scenes_are_dropped_and_others_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make(task: Any) -> Path:
        task.shard.parent.mkdir(parents=True, exist_ok=True)
        task.shard.touch()
        return Path(task.shard)

    monkeypatch.setattr("semloc_logs.training.runs.make_shard", make)
    settings = load(assignments={"training.scenes": "12"}).resolved()
    packed = simulated_shards(tmp_path, settings, make_engine("serial"), lambda _: None)
    paths = packed.every
    assert len(paths) == 12
    for before, left in ((-256, 12), (0, 12), (3, 9), (1, 9), (5, 7)):
        packed.drop(before)
        assert sum(path.exists() for path in paths) == left
    assert [path.exists() for path in paths[:6]] == [False] * 5 + [True]
    packed.close()


def test_the_papers_network_is_learned_as_written_with_words_of_its_own(
    shards: list[Path], tmp_path: Path
) -> None:
    settings = load(
        method="paper", assignments={"training.samples": "32", "training.batch": "16"}
    ).resolved()
    assert settings.training.contrastive_weight == 0
    output = tmp_path / "geometric.safetensors"
    checkpoint = tmp_path / "checkpoint.safetensors"
    steps = list[str]()
    scores = learn_descriptor(
        "geometric",
        Packed(shards[:2], shards[2:]),
        settings,
        TrainingRun(checkpoint),
        output,
        steps.append,
    )
    assert scores is not None
    # two steps of sixteen pairs, one sample a pair
    assert "32 of 32 samples" in steps[-1]
    assert "contrastive 0.000" in steps[-1]
    state = load_file(checkpoint)
    assert float(state["optimiser.0.step"]) == 2
    assert {k.split(".")[-1] for k in state if k.startswith("optimiser.0.")} == {
        "step",
        "square_avg",
        "acc_delta",
    }
    words = tmp_path / "words.safetensors"
    named = settings.model_copy(
        update={"descriptor": settings.descriptor.model_copy(update={"weights": output})}
    )
    # nine subvolumes of each of 24 pairs are too few for a vocabulary, 288 are not
    with pytest.raises(SettingsError, match="at least 256"):
        learn_vocabulary("geometric", shards, named, words)
    assert learn_vocabulary("geometric", [*shards, *shards[:2]], named, words) == 36 * 9
    loaded = load_plain_vocabulary("geometric", words)
    assert loaded.vocabulary.projection.shape == (64, 257)
    shipped = files("semloc_logs.words") / "vocabularies" / "geometric.safetensors"
    with (
        as_file(shipped) as ours,
        pytest.raises(SettingsError, match="not a vocabulary of the paper's method"),
    ):
        load_plain_vocabulary("geometric", ours)


def test_the_rate_of_the_paper_stays_and_nothing_is_mirrored(shards: list[Path]) -> None:
    ours = _settings(samples=54, batch=2)
    paper = load(method="paper").resolved()
    recipe = RECIPES[paper.training.method]
    assert {recipe.rate(step, 100) for step in (0, 50, 99)} == {1.0}
    assert recipe.max_gradient == np.inf
    mirrored = {
        settings.training.method: [
            _drawn([read_shard(shards[0])], settings.training, step).mirror for step in range(20)
        ]
        for settings in (ours, paper)
    }
    assert any(mirrored["ours"])
    assert not any(mirrored["paper"])


def test_only_while_the_rate_stays_may_the_number_of_samples_change() -> None:
    ours = _settings(samples=1800, batch=2).training  # 100 steps, the last 25 of a falling rate
    longer = ours.model_copy(update={"samples": 3600})
    paper = ours.model_copy(update={"method": "paper", "samples": 200})  # 100 steps
    shorter = paper.model_copy(update={"samples": 180})  # 90 steps
    for before, now, step, goes_on in (
        (ours, longer, 75, True),
        (ours, longer, 76, False),
        (paper, shorter, 90, True),
        (paper, shorter, 91, False),
        (paper, ours, 10, False),
    ):
        contents = (before.model_dump(mode="json"), now.model_dump(mode="json"))
        assert _goes_on(*contents, step) is goes_on


def test_a_checkpoint_of_before_a_setting_was_made_goes_on(
    shards: list[Path], tmp_path: Path
) -> None:
    training = _settings(samples=72, batch=2).training
    checkpoint = tmp_path / "checkpoint.safetensors"
    assert train("geometric", shards, training, TrainingRun(checkpoint, deadline=0.0)) is None
    tensors = load_file(checkpoint)
    with safe_open(checkpoint, "pt") as handle:
        note = dict(handle.metadata())
    content = json.loads(note["training"])
    del content["method"]
    save_file(tensors, checkpoint, metadata={**note, "training": json.dumps(content)})
    assert train("geometric", shards, training, TrainingRun(checkpoint)) is not None

"""Packed training pairs from simulated scenes: what the shipped weights are trained on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semloc_logs.settings import Settings
from semloc_logs.simulation.training_scenes import training_session
from semloc_logs.subvolumes.pairs import SceneFrame, cut_pairs, write_shard


@dataclass(frozen=True, slots=True)
class SceneTask:
    """One scene to simulate and cut into a shard; picklable."""

    seed: int
    shard: Path
    settings: Settings  # resolved


def make_shard(task: SceneTask) -> Path:
    """Simulate the scene of ``task.seed`` and write its pairs, unless they are there already."""
    if not task.shard.exists():
        frames = [SceneFrame(points, origin, label, pose) for points, origin, label, pose in training_session(task.seed)]
        rng = np.random.default_rng((task.settings.training.seed, 3, task.seed))
        write_shard(task.shard, cut_pairs(frames, task.settings.fusion, task.settings.training, rng))
    return task.shard


def scene_tasks(folder: Path, scenes: int, settings: Settings) -> list[SceneTask]:
    """Tasks for ``scenes`` scenes with shards in ``folder``."""
    return [SceneTask(seed, folder / f"scene-{seed:05d}.parquet", settings) for seed in range(scenes)]

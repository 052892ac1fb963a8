"""Packed training pairs from simulated scenes: what the shipped weights are trained on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semloc_logs.settings import Resolved
from semloc_logs.training.pairs import SceneFrame, cut_pairs, write_shard
from semloc_logs.training.training_scenes import TrainingFrame, training_scene


@dataclass(frozen=True, slots=True)
class SceneTask:
    """One scene to simulate and cut into a shard; picklable."""

    seed: int
    shard: Path
    settings: Resolved


def make_shard(task: SceneTask) -> Path:
    """Simulate the scene of ``task.seed`` and write its pairs, unless they are there already."""
    if not task.shard.exists():
        scene = training_scene(task.seed)
        mapped = [scene_frame(f) for f in scene.mapped]
        queries = (
            mapped if scene.queries is scene.mapped else [scene_frame(f) for f in scene.queries]
        )
        rng = np.random.default_rng((task.settings.training.seed, 3, task.seed))
        write_shard(
            task.shard,
            cut_pairs(mapped, task.settings.fusion, task.settings.training, rng, queries),
        )
    return task.shard


def scene_frame(frame: TrainingFrame) -> SceneFrame:
    """The simulated frame as one to be fused."""
    return SceneFrame(frame.points, frame.origin, frame.labels, frame.world_T_base, frame.sigma)


def scene_tasks(folder: Path, scenes: int, settings: Resolved) -> list[SceneTask]:
    """Tasks for ``scenes`` scenes with shards in ``folder``."""
    return [
        SceneTask(seed, folder / f"scene-{seed:05d}.parquet", settings) for seed in range(scenes)
    ]

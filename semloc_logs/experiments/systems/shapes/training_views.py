"""Views that shape descriptors and their words are learnt from: simulated drives of the scenes that
ours was trained on, and not the database of an experiment (section 4.3).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

from semloc_logs.experiments.kept_files import not_counted
from semloc_logs.experiments.system import View
from semloc_logs.training.training_scenes import TrainingFrame, training_scene

SCENES, FRAMES = 8, 60
QUICK_SCENES, QUICK_FRAMES = 1, 24
STREETS = (0, 1, 2, 3, 4, 6, 7, 9)  # seeds of training scenes that are streets
APART = 1000.0  # m between two scenes in the common world


@dataclass(frozen=True, slots=True)
class Training:
    """Views to learn from, made when they are called for; ``key`` names them."""

    key: str
    views: Callable[[], Sequence[View]]


def simulated_training(*, quick: bool) -> Training:
    """The simulated streets."""
    scenes, frames = (QUICK_SCENES, QUICK_FRAMES) if quick else (SCENES, FRAMES)
    return Training(f"streets-{scenes}-{frames}", partial(training_views, scenes, frames))


@lru_cache(maxsize=1)
def training_views(scenes: int, frames: int) -> tuple[View, ...]:
    """The mapping drives of so many scenes, of about ``frames`` views each, far from each other."""
    with not_counted():
        return tuple(
            _view(seed, number, frame)
            for seed in STREETS[:scenes]
            for number, frame in enumerate(training_scene(seed, frames).mapped)
        )


def _view(seed: int, number: int, frame: TrainingFrame) -> View:
    pose = frame.world_T_base.copy()
    pose[0, 3] += APART * seed
    return View(f"street{seed}", number, frame.points, frame.labels, frame.origin, pose, pose)

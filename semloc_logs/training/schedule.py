"""The schedule of a training: steps, samples, learning rate, and the scenes in use."""

from __future__ import annotations

import math

from semloc_logs.settings import Training

SAMPLES_A_PAIR = {"ours": 9, "paper": 1}
WARM_UP = 50  # steps
DECAY = 0.25  # share of the steps, the last ones, over which the rate falls
LAST_RATE = 0.02  # of the full rate, at the last step
FIRST_SCENES = 12  # in use from the first step on
# a further scene comes into use after so many samples, nine of a pair: about as many as its pairs
# hold
SAMPLES_A_SCENE = 4000
WINDOW = 256  # scenes in use at most


def steps_of(training: Training) -> int:
    """Steps of the whole training."""
    return math.ceil(training.samples / samples_after(1, training))


def samples_after(steps: int, training: Training) -> int:
    """Samples seen in so many steps."""
    return steps * training.batch * SAMPLES_A_PAIR[training.method]


def learning_rate(step: int, steps: int) -> float:
    """Share of the full rate at ``step`` of ``steps``: a warm-up, a plateau, then a cosine down to
    ``LAST_RATE`` (Hägele et al. 2024).

    The plateau is the same however many steps there are, so a training can be made longer, or
    ended, after it has begun.
    """
    begin = plateau_end(steps)
    if step < begin:
        return min(1.0, (step + 1) / WARM_UP)
    share = (step - begin) / max(1, steps - begin)
    return min(1.0, (step + 1) / WARM_UP) * (
        LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + math.cos(math.pi * share))
    )


def plateau_end(steps: int) -> int:
    """The step of ``steps`` at which the rate begins to fall."""
    return steps - int(DECAY * steps)


def open_ended(training: Training) -> int:
    """Steps over which a training does not depend on its length: the paper's rate never falls."""
    steps = steps_of(training)
    return steps if training.method == "paper" else plateau_end(steps)


def scene_window(samples: int, scenes: int, method: str = "ours") -> range:
    """Numbers of the scenes in use when ``samples`` samples have been seen, of ``scenes`` there
    are.
    """
    nine_of_a_pair = samples * SAMPLES_A_PAIR["ours"] // SAMPLES_A_PAIR[method]
    newest = min(scenes, FIRST_SCENES + nine_of_a_pair // SAMPLES_A_SCENE)
    return range(max(0, newest - WINDOW), newest)

from __future__ import annotations

import json
import math
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64
from semloc_logs.mapping.keyframes import collect
from semloc_logs.mapping.levelling import level
from semloc_logs.mapping.up_direction import find_up
from semloc_logs.settings import load

UP = np.array([0.0, 0.0, 1.0])


def noisy(rng: np.random.Generator, direction: F64, n: int, degrees: float) -> F64:
    """Unit normals scattered around a direction, of random sign."""
    v = direction + rng.normal(0, np.radians(degrees), (n, 3))
    return np.asarray(
        v / np.linalg.norm(v, axis=1, keepdims=True) * rng.choice([-1.0, 1.0], (n, 1))
    )


def degrees_between(a: F64, b: F64) -> float:
    return math.degrees(math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b)))


def scene(
    seed: int, floor: int = 4000, walls: int = 6000, slanted: int = 1500, clutter: int = 3000
) -> F64:
    """Normals in a level frame: a floor, walls in two directions, a roof of 35 degrees, clutter
    everywhere.
    """
    rng = np.random.default_rng(seed)
    roof = np.array([0.0, math.sin(math.radians(35)), math.cos(math.radians(35))])
    parts = [
        noisy(rng, UP, floor, 1.5),
        noisy(rng, np.array([math.cos(0.3), math.sin(0.3), 0]), walls // 2, 1.5),
        noisy(rng, np.array([-math.sin(0.3), math.cos(0.3), 0]), walls // 2, 1.5),
        noisy(rng, roof, slanted, 1.5),
        noisy(rng, np.zeros(3), clutter, 50),
    ]
    return np.concatenate(parts)


@pytest.mark.parametrize("tilt", [0.0, 3.0, 12.0, 30.0])
@pytest.mark.parametrize("what", ["floor and walls", "floor", "walls"])
def test_a_known_tilt_is_found(tilt: float, what: str) -> None:
    """The prior is wrong by the tilt."""
    normals = scene(1, floor=4000 if "floor" in what else 0, walls=6000 if "walls" in what else 0)
    turn = Rotation.from_rotvec(np.radians(tilt) * np.array([0.6, -0.8, 0.0])).as_matrix()
    up = find_up(normals @ turn.T, np.ones(len(normals)), UP)
    assert np.linalg.norm(up) == pytest.approx(1)
    assert degrees_between(up, turn @ UP) < 0.1


def test_a_slope_does_not_pass_for_the_floor() -> None:
    """The road climbs by 6 degrees for a third of the drive; walls are upright all the same."""
    rng = np.random.default_rng(0)
    slope = np.array([math.sin(math.radians(6)), 0, math.cos(math.radians(6))])
    normals = np.concatenate([scene(2, slanted=0), noisy(rng, slope, 2000, 1.0)])
    assert degrees_between(find_up(normals, np.ones(len(normals)), UP), UP) < 0.2


def test_weights_count_and_the_result_has_the_sign_of_the_prior() -> None:
    rng = np.random.default_rng(0)
    light = np.array([math.sin(0.4), 0, math.cos(0.4)])
    normals = np.concatenate([noisy(rng, UP, 500, 1.0), noisy(rng, light, 2000, 1.0)])
    weights = np.r_[np.full(500, 1.0), np.full(2000, 0.01)]
    assert degrees_between(find_up(normals, weights, UP), UP) < 0.2
    assert degrees_between(find_up(normals, weights, -3 * UP), -UP) < 0.2


def test_with_nothing_to_see_the_prior_stays() -> None:
    prior = np.array([0.1, 0.0, 1.0])
    unit = prior / np.linalg.norm(prior)
    np.testing.assert_allclose(find_up(np.zeros((0, 3)), np.zeros(0), prior), unit)
    few = np.tile(UP, (20, 1))
    np.testing.assert_allclose(find_up(few, np.ones(20), prior), unit)
    np.testing.assert_allclose(find_up(np.tile(UP, (500, 1)), np.zeros(500), prior), unit)


def test_two_drives_through_a_basement_agree_on_up(shared: Callable[[str], Path]) -> None:
    """Both session frames are tilted, one of them by six degrees; the truth has how they lie to
    each other.
    """
    truth = json.loads(shared("logs/basement_truth.json").read_text())
    ups = {}
    settings = load(
        assignments={
            "fusion.voxel_size": "0.3",
            "fusion.keyframe_distance": "4",
            "fusion.keyframe_angle": "3.0",
        }
    ).resolved()
    for name in ("basement_a.mcap", "basement_b.bag"):
        scratch = Path(tempfile.mkdtemp())
        try:
            from semloc_logs.labels.label_sources import labeller_of
            from semloc_logs.logs.session.session import SessionOptions, open_session

            session = open_session(
                [shared(f"logs/{name}")], SessionOptions(min_range=0.9, max_range=30.0)
            )
            try:
                collected = collect(
                    session,
                    labeller_of(settings.labels, session),
                    settings.fusion,
                    scratch,
                    name,
                )
                session_T_map = level(session, collected, settings).session_T_map
            finally:
                session.close()
        finally:
            shutil.rmtree(scratch)
        assert len(collected) > 3
        common = np.array(truth[name]["T_common_session"])
        ups[name] = common[:3, :3] @ session_T_map[:3, 2]
    assert degrees_between(*ups.values()) < 0.5, ups

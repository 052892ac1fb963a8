"""Which keyframes the surface of a target is made from, and how uncertain their points are."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from semloc_logs.closures import target_surface
from semloc_logs.closures.target_surface import _every_second, _surface
from semloc_logs.numerics.transforms import yaw_transform


def test_of_a_longer_stretch_every_second_keyframe_of_each_sensor_is_used() -> None:
    """Of front 0, 1, 3, 5 the second and fourth are left out, of rear 2, 4 the second."""
    topics = np.array(["front", "front", "rear", "front", "rear", "front"], object)
    session = SimpleNamespace(topics=np.concatenate([np.full(10, "other", object), topics]))
    database = SimpleNamespace(session=lambda group: session)
    surroundings = SimpleNamespace(
        visible=SimpleNamespace(database=database), group=0, ids=np.arange(10, 16)
    )
    chosen = _every_second(cast(Any, surroundings), np.arange(6))
    np.testing.assert_array_equal(chosen, [10, 12, 13])


def test_points_are_uncertain_along_their_rays_in_the_map(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A keyframe that is turned to the left: what lies ahead of it lies along y of the map."""
    session = SimpleNamespace(map_T_base=yaw_transform(np.pi / 2, (5.0, 0.0, 0.0))[None])
    settings = SimpleNamespace(fusion=SimpleNamespace(voxel_size=0.3))
    database = SimpleNamespace(session=lambda group: session, settings=settings)
    frame = SimpleNamespace(
        points=np.array([[2.0, 0.0, 1.0]]), spread=lambda origin: np.array([[0.4, 0.0, 0.1]])
    )
    surroundings = SimpleNamespace(
        visible=SimpleNamespace(database=database),
        group=0,
        near=lambda number: (frame, np.zeros(3)),
    )
    monkeypatch.setattr(target_surface, "_chosen", lambda surroundings: np.array([0]))
    monkeypatch.setattr(target_surface, "point_surface", lambda *made_from: made_from)
    made = _surface(cast(Any, surroundings))
    points, spreads, voxel_size = cast(Any, made.surface)
    np.testing.assert_allclose(points, [[5.0, 2.0, 1.0]], atol=1e-12)
    np.testing.assert_allclose(spreads, [[0.0, 0.4, 0.1]], atol=1e-12)
    assert voxel_size == 0.3
    np.testing.assert_array_equal(made.keyframes, [0])

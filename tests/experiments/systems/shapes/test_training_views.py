from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.experiments.systems.shapes.training_views import (
    QUICK_FRAMES,
    simulated_training,
    training_views,
)


def test_streets_are_simulated_once() -> None:
    pytest.importorskip("embreex")
    views = training_views(2, 3)
    assert len(views) == 6
    assert views is training_views(2, 3)
    assert {view.session for view in views} == {"street0", "street1"}
    first, second = (
        np.array([v.world_T_base[:2, 3] for v in views if v.session == name])
        for name in ("street0", "street1")
    )
    # the scenes do not overlap
    assert np.linalg.norm(first[:, None] - second[None], axis=2).min() > 500
    for view in views:
        assert len(view.points) == len(view.label) > 1000
        np.testing.assert_array_equal(view.odom_T_base, view.world_T_base)


def test_quick_and_full_training_have_other_keys() -> None:
    quick, full = simulated_training(quick=True), simulated_training(quick=False)
    assert quick.key != full.key
    assert str(QUICK_FRAMES) in quick.key

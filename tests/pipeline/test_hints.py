"""What a user is told where nothing was found."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from semloc_logs.closures.closure_tables import read_closures
from semloc_logs.errors import WorkspaceError
from semloc_logs.stages import hints
from semloc_logs.tables.table import write_json
from semloc_logs.workspace import SessionFolder, Workspace


@pytest.fixture
def fused(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Workspace]:
    """``fused(a=(reach, voxel_size))``: a workspace whose sessions have points on a sphere of that
    radius (m) around the sensor, which is 2 m above the base.
    """

    def make(**sessions: tuple[float, float]) -> Workspace:
        work = Workspace(tmp_path_factory.mktemp("work"))
        for name in sessions:
            write_json(work.session(name).session_json, {})

        def session(folder: SessionFolder) -> SimpleNamespace:
            reach, voxel_size = sessions[folder.name]
            directions = np.random.default_rng(0).normal(size=(1000, 3))
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            return SimpleNamespace(
                json={"voxel_size": voxel_size},
                stamps_ns=np.arange(30),
                origins=np.tile([0.0, 0.0, 2.0], (30, 1)),
                keyframe=lambda _: SimpleNamespace(points=reach * directions + (0, 0, 2)),
            )

        monkeypatch.setattr(hints, "SessionMap", session)
        return work

    return make


@pytest.mark.parametrize(
    ("reach", "voxel_size", "told"),
    [
        (4.0, 0.30, "0.05"),
        (9.0, 0.30, "0.10"),
        (9.0, 0.10, None),
        (4.0, 0.05, None),
        (40, 0.3, None),
    ],
)
def test_voxels_that_are_too_large_for_the_reach(
    fused: Callable[..., Workspace], reach: float, voxel_size: float, told: str | None
) -> None:
    hint = hints.voxel_size_hint(fused(a=(reach, voxel_size)))
    assert (hint is None) == (told is None)
    if hint is not None:
        assert f"points of a lie within {reach:.1f} m" in hint
        assert f"--set fusion.voxel_size={told} " in hint


def test_one_session_in_a_room_is_enough(fused: Callable[..., Workspace]) -> None:
    assert "of b " in str(hints.voxel_size_hint(fused(a=(40.0, 0.3), b=(4.0, 0.3))))
    assert hints.voxel_size_hint(fused()) is None


def test_the_smallest_room_is_named(fused: Callable[..., Workspace]) -> None:
    assert "of a " in str(hints.voxel_size_hint(fused(a=(4.0, 0.3), b=(9.0, 0.3))))


def test_closures_that_were_not_searched_yet(fused: Callable[..., Workspace]) -> None:
    work = fused(a=(4.0, 0.3))
    with pytest.raises(WorkspaceError, match="has no closures yet: run 'semloc close' first"):
        read_closures(work.closures)

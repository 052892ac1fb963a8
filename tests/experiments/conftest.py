"""Views that exist in memory only: a session is a list of poses on a plane, with few points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from semloc_logs.experiments.system import View
from semloc_logs.experiments.views import SessionViews, ViewStore
from semloc_logs.numerics.transforms import yaw_transform

Places = Sequence[tuple[float, float, float]]  # x, y (m), heading (degrees)


class MadeViews(SessionViews):
    """A session without files."""

    def __init__(self, name: str, places: Places) -> None:
        poses = np.array([yaw_transform(np.radians(h), (x, y, 0.0)) for x, y, h in places])
        stamps = 1_000_000_000 * np.arange(1, len(places) + 1)
        folder = SimpleNamespace(name=name)
        session = cast(Any, SimpleNamespace(folder=folder, stamps_ns=stamps))
        super().__init__(session, poses, np.ones(len(places), bool))

    def view(self, number: int) -> View:
        pose = self.world_T_base[number]
        return View(
            session=self.session.folder.name,
            stamp_ns=int(self.session.stamps_ns[number]),
            points=pose[None, :3, 3].astype(np.float32),
            label=np.zeros(1, np.uint8),
            origin=np.zeros(3, np.float32),
            odom_T_base=np.eye(4),
            world_T_base=pose,
        )


@pytest.fixture
def make_store() -> Callable[..., ViewStore]:
    """``make_store(name=places, ...)``: a store of sessions of (x, y, heading in degrees)."""

    def make(**sessions: Places) -> ViewStore:
        return ViewStore([MadeViews(name, places) for name, places in sessions.items()])

    return make

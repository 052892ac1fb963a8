"""What viewers show around the closures of a log: frames, poses, drives and a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64

Colour = tuple[float, float, float, float]  # red, green, blue, opacity from 0 to 1


@dataclass(frozen=True, slots=True, eq=False)
class Transform:
    """Pose (4, 4) of the frame ``child`` in the frame ``parent`` at a time."""

    stamp_ns: int
    parent: str
    child: str
    parent_T_child: F64


@dataclass(frozen=True, slots=True, eq=False)
class StampedPose:
    """Pose (4, 4) of the base frame in ``frame_id``; covariance (6, 6), zeros where unknown."""

    stamp_ns: int
    frame_id: str
    frame_T_base: F64
    covariance: F64


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points (n, 3) in ``frame_id``, their colours (n, 3) and train ids (n,)."""

    frame_id: str
    points: NDArray[np.float32]
    colours: NDArray[np.uint8]
    label: NDArray[np.uint8]

    def rows(self, names: Sequence[str]) -> NDArray[Any]:
        """x y z as floats, then single bytes called ``names``: blue, green, red, 0, label."""
        kinds = [(axis, "<f4") for axis in "xyz"] + [(name, "u1") for name in names]
        out = np.zeros(len(self.points), np.dtype(kinds))
        out["x"], out["y"], out["z"] = self.points.T
        blue, green, red, _, label = names
        out[red], out[green], out[blue] = self.colours.T
        out[label] = self.label
        return out


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Positions (n, 3) of a session's vehicle in ``frame_id``, in the order of time."""

    session: str
    frame_id: str
    positions: F64
    color: Colour


@dataclass(frozen=True, slots=True)
class Scene:
    """What viewers show around the closures.

    ``moving`` transforms are of the vehicle, where the log has none, and of the common frame;
    ``fixed`` ones hold for the whole log. ``common`` are poses in the common frame, which /semloc/
    pose has instead of the ones in the frames of the targets. ``cloud`` is the map, ``drives`` are
    of the log and of the sessions that closures connect with it.
    """

    moving: Sequence[Transform] = ()
    fixed: Sequence[Transform] = ()
    common: Sequence[StampedPose] = ()
    cloud: Cloud | None = None
    drives: Sequence[Drive] = ()


NO_SCENE = Scene()

"""Transforms that are known before the messages of a log give them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.logs.poses.tf_tree import frame_name
from semloc_logs.logs.problems import Problem
from semloc_logs.numerics.transforms import transform


class StaticTransform(NamedTuple):
    """``parent_T_child`` as position (m) and quaternion: x, y, z, qx, qy, qz, qw."""

    parent: str
    child: str
    pose: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Mountings:
    """Mountings of sensors beside the messages of a session.

    ``given`` by the user: the pose of a frame in the base frame, by frame name; they overrule the
    log. ``own`` static transforms of the session, and the ``lent`` ones of other logs, hold from
    its start. ``problems`` tell where the lent ones are from.
    """

    given: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    own: tuple[StaticTransform, ...] = ()
    lent: tuple[StaticTransform, ...] = ()
    problems: tuple[Problem, ...] = ()

    @property
    def given_poses(self) -> dict[str, F64]:
        """``base_T_frame`` (4, 4) of the given frames."""
        return {frame_name(frame): matrix(pose) for frame, pose in self.given.items()}


NO_MOUNTINGS = Mountings()


def matrix(pose: tuple[float, ...]) -> F64:
    """The 4x4 matrix of x, y, z, qx, qy, qz, qw."""
    values = np.array(pose, float)
    return transform(values[:3], values[3:])

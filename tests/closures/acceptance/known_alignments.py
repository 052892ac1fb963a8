"""Alignments of sessions along known roads, and the outcomes for them, for tests of acceptance."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import cast

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.closures.acceptance.calibration import Calibration, Model, log_odds
from semloc_logs.closures.acceptance.decide import decide
from semloc_logs.closures.closure import Alignment, Closure, Features, Rejected
from semloc_logs.mapping.drift import UNMEASURED
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse, yaw_transform
from semloc_logs.settings import Settings

Outcome = Closure | Rejected
SETTINGS = Settings().resolved()
MAP = yaw_transform(0.7, (40.0, -20.0, 1.0))  # target map from query map
GOOD = Features(0.9, 0.9, 0.0, 0.9, 3.5, 3.0, 0.0)
ANYTHING = (-50.0,) * 3, (50.0,) * 3, (0.0,) * 3
# the stiffness of an alignment is its log-odds
MODEL = Model(
    Calibration((0.0, 1.0, 0.0), *ANYTHING, 0.0),
    Calibration((2.0, -3.0, 1.0, -1.0), (0.0,) * 4, (3.0,) * 4, (0.0,) * 4, 0.0),
    50.0,
    0.125,
)


def bend(n: int, step: float = 2.0) -> F64:
    """A bent road (n, 4, 4), a keyframe every ``step`` metres."""
    poses = [np.eye(4)]
    for _ in range(n - 1):
        poses.append(poses[-1] @ yaw_transform(0.02, (step, 0.0, 0.0)))
    return np.array(poses)


def session(poses: F64, posed: bool = True) -> SessionMap:
    return cast(
        SessionMap,
        SimpleNamespace(
            map_T_base=poses,
            distance=2.0 * np.arange(len(poses)),
            posed=posed,
            drift=UNMEASURED,
        ),
    )


ROAD = bend(60)
MAPS = {"a": session(ROAD), "b": session(MAP @ ROAD)}


def alignment(
    k: int,
    alone: float,
    error: F64 | None = None,
    query: str = "a",
    target: str = "b",
    target_keyframe: int | None = None,
) -> Alignment:
    """Query ``k`` aligned at the true place, or moved by ``error`` in the target's map; or at
    ``target_keyframe``.
    """
    target_keyframe = k if target_keyframe is None else target_keyframe
    moved = (np.eye(4) if error is None else error) @ MAPS[target].map_T_base[target_keyframe]
    return Alignment(
        query,
        target,
        k,
        target_keyframe,
        k,
        target_keyframe,
        inverse(MAPS[target].map_T_base[target_keyframe]) @ moved,
        np.eye(6) * 1e-4,
        0.8,
        900,
        5,
        dataclasses.replace(GOOD, stiffness=float(log_odds(np.array(alone)))),
    )


def decided(
    rows: list[Alignment], maps: dict[str, SessionMap] | None = None
) -> dict[tuple[int, int], Outcome]:
    out = decide(rows, maps or MAPS, SETTINGS, model=MODEL)
    assert len(out) == len(rows)
    return {(o.alignment.query_keyframe, o.alignment.target_keyframe): o for o in out}


def accepted(outcome: Outcome) -> bool:
    return isinstance(outcome, Closure)


def sentence(outcome: Outcome) -> str:
    assert isinstance(outcome, Rejected)
    return outcome.sentence


STRAIGHT = np.array([yaw_transform(0.0, (2.0 * i, 0.0, 0.0)) for i in range(100)])
STREETS = {"a": session(STRAIGHT), "b": session(STRAIGHT), "c": session(STRAIGHT)}
COPIED = range(20, 40)


def in_street(k: int, target_keyframe: int, query: str = "a", target: str = "b") -> Alignment:
    here = {
        "query_session": query,
        "target_session": target,
        "target_keyframe": target_keyframe,
        "target_stamp_ns": target_keyframe,
        "target_T_query": np.eye(4),
    }
    return dataclasses.replace(alignment(k, 0.999), **here)  # type: ignore[arg-type]

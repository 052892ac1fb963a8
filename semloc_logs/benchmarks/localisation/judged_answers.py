"""Localisation, judged: the query keyframes of a condition, the error of an answer, and the figures
of many answers.

Every system gives for each query the pose that it ranks first, in the database's map, and a score
of its own. It is judged against the database keyframe nearest to that pose, so that the drift of
the map does not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.benchmarks.localisation.city import (
    CROSSING,
    DATABASE,
    OPPOSITE,
    UNSEEN,
    WorldDrive,
)
from semloc_logs.closures.query import query_keyframes
from semloc_logs.evaluation.truth import read_tum
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse, rotation_angle
from semloc_logs.settings import Resolved
from semloc_logs.workspace import Workspace

NEAR_M = {CROSSING: 10.0}  # of the database's road; elsewhere:
LANE_M = 5.0
WINDOW = np.radians(30.0)  # about the heading of the condition
# metres and degrees within which an answer is right
LIMITS = {"1 m": (1.0, 5.0), "5 m": (5.0, 20.0)}


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer of a system to the query at ``keyframe``.

    Errors of its first pose (None: it found none), its score, seconds, and errors of the pose that
    it accepted after all queries (None: it accepted none), if it ``decides`` at all.
    """

    keyframe: int
    seconds: float
    score: float = -np.inf
    error_m: float | None = None
    error_deg: float | None = None
    decides: bool = False
    accepted_m: float | None = None
    accepted_deg: float | None = None

    def right(self, limit: str) -> bool:
        """Whether the first pose is within a limit of ``LIMITS``."""
        return _within(limit, self.error_m, self.error_deg)

    @property
    def accepted(self) -> bool:
        """Whether it accepted a pose."""
        return self.accepted_m is not None

    @property
    def accepted_right(self) -> bool:
        """Whether it accepted a pose that is within the least of ``LIMITS``."""
        return _within("1 m", self.accepted_m, self.accepted_deg)

    def to_json(self) -> dict[str, Any]:
        return asdict(self) | {"score": float(np.nan_to_num(self.score, neginf=-1e300))}


def _within(limit: str, error_m: float | None, error_deg: float | None) -> bool:
    metres, degrees = LIMITS[limit]
    return (
        error_m is not None and error_deg is not None and error_m <= metres and error_deg <= degrees
    )


@dataclass(eq=False)
class World:
    """A fused query session and the database, with their truth."""

    work: Workspace
    drive: WorldDrive

    @cached_property
    def query(self) -> SessionMap:
        return SessionMap(self.work.session(self.drive.name))

    @cached_property
    def database(self) -> SessionMap:
        return SessionMap(self.work.session(DATABASE))

    @cached_property
    def true_query(self) -> F64:
        """True poses (n, 4, 4) of the query session's keyframes."""
        return read_tum(self.drive.truth).at(self.query.stamps_ns)[0]

    @cached_property
    def true_database(self) -> F64:
        """True poses (n, 4, 4) of the database's keyframes."""
        database = WorldDrive(self.drive.folder, DATABASE, "lidar", DATABASE)
        return read_tum(database.truth).at(self.database.stamps_ns)[0]

    def keyframes(self, settings: Resolved, most: int) -> list[int]:
        """At most ``most`` query keyframes, evenly among those that meet the condition."""
        possible = [k for k in query_keyframes(self.query, settings) if self._meets_condition(k)]
        if len(possible) <= most:
            return possible
        return [possible[round(i)] for i in np.linspace(0, len(possible) - 1, most)]

    def nearest(self, keyframe: int, count: int) -> list[int]:
        """The database's keyframes truly nearest to the query's."""
        return [int(i) for i in np.argsort(self._away(keyframe), kind="stable")[:count]]

    def _away(self, keyframe: int) -> F64:
        return np.asarray(
            np.linalg.norm(self.true_database[:, :3, 3] - self.true_query[keyframe, :3, 3], axis=1)
        )

    def _meets_condition(self, keyframe: int) -> bool:
        condition = self.drive.condition
        if condition == UNSEEN:
            return True
        away = self._away(keyframe)
        nearest = int(np.argmin(away))
        ahead = self.true_database[nearest, :3, 0] @ self.true_query[keyframe, :3, 0]
        between = float(np.arccos(np.clip(ahead, -1.0, 1.0)))
        wanted = np.radians(float(condition)) if condition in (CROSSING, OPPOSITE) else 0.0
        return bool(
            away[nearest] <= NEAR_M.get(condition, LANE_M) and abs(between - wanted) < WINDOW
        )

    def errors(self, keyframe: int, map_T_base: F64) -> tuple[float, float]:
        """Metres and degrees by which ``map_T_base`` (4, 4), the base at ``keyframe`` in the
        database's map, is wrong.
        """
        if self.drive.condition == UNSEEN:
            return float("inf"), 180.0
        nearest = int(
            np.argmin(
                np.linalg.norm(self.database.map_T_base[:, :3, 3] - map_T_base[:3, 3], axis=1)
            )
        )
        target_T_query = inverse(self.database.map_T_base[nearest]) @ map_T_base
        rest = (
            inverse(inverse(self.true_database[nearest]) @ self.true_query[keyframe])
            @ target_T_query
        )
        return float(np.linalg.norm(rest[:3, 3])), float(np.degrees(rotation_angle(rest[:3, :3])))


def read_world(work: Path, drive: WorldDrive) -> World:
    """The world of ``drive``, fused in the workspace ``work``."""
    return World(Workspace(work), drive)


def recall_at_full_precision(
    answers: Sequence[Answer], elsewhere: Sequence[Answer], limit: str = "5 m"
) -> float:
    """Share of ``answers`` that are right and score above every wrong one, among those from
    ``elsewhere`` too, which are all wrong.
    """
    wrong = [
        a.score for a in (*answers, *elsewhere) if a.error_m is not None and not a.right(limit)
    ]
    worst = max(wrong, default=-np.inf)
    return float(np.mean([a.right(limit) and a.score > worst for a in answers])) if answers else 0.0


def figures_of(answers: Sequence[Answer], elsewhere: Sequence[Answer]) -> dict[str, float]:
    """The figures of one system under one condition, by name; of no ``answers`` only those that
    count.
    """
    if not answers:
        return {}
    out = {f"recall {limit}": float(np.mean([a.right(limit) for a in answers])) for limit in LIMITS}
    out["recall at 100 % precision"] = recall_at_full_precision(answers, elsewhere)
    errors = [a.error_m for a in answers if a.right("1 m") and a.error_m is not None]
    if errors:
        out["median error"] = float(np.median(errors))
    out["time"] = float(np.median([a.seconds for a in answers]))
    if answers[0].decides:
        out["accepted and right"] = float(np.mean([a.accepted_right for a in answers]))
        out["accepted and wrong"] = float(
            sum(a.accepted and not a.accepted_right for a in (*answers, *elsewhere))
        )
    return out


UNITS = {
    "median error": "m, of those within 1 m",
    "time": "s a query, median, one thread",
    "accepted and right": "share",
    "accepted and wrong": "queries, unseen city included",
}

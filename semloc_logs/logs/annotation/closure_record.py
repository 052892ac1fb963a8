"""A loop closure as the channels of a log need it: a row of closures.parquet, and where it lies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.errors import ContractError
from semloc_logs.numerics.transforms import transform


@dataclass(frozen=True, slots=True, eq=False)
class ClosureRecord:
    """A row of closures.parquet, and where it lies for those who look at the log.

    ``covariance`` has 36 numbers. ``session_T_query`` (4, 4) is the pose of the query's base frame
    in the *target's* session frame, None when the target has no poses. ``session_position`` (3,) is
    the place of this log's end in this log's session frame, None without poses; ``session_other``
    (3,) the place of the other end there, as the closure gives it.
    """

    query_session: str
    target_session: str
    query_stamp_ns: int
    target_stamp_ns: int
    t_x: float
    t_y: float
    t_z: float
    q_x: float
    q_y: float
    q_z: float
    q_w: float
    covariance: tuple[float, ...]
    overlap: float
    probability: float
    inliers: int
    words: int
    session_T_query: F64 | None = None
    session_position: F64 | None = None
    session_other: F64 | None = None

    @classmethod
    def from_row(
        cls,
        row: Mapping[str, object],
        *,
        session_T_query: F64 | None = None,
        session_position: F64 | None = None,
        session_other: F64 | None = None,
    ) -> ClosureRecord:
        """From a row of the table as plain Python values.

        ``ContractError`` when a column is missing or has another type.
        """
        try:
            values: dict[str, object] = {}
            for name in COLUMNS:
                value = row[name]
                kind = _TYPES[name]
                if kind is tuple:
                    value = tuple(float(x) for x in value)  # type: ignore[attr-defined]
                values[name] = kind(value)
        except (KeyError, TypeError, ValueError) as error:
            raise ContractError(
                f"A row of closures.parquet lacks a good value for {error}; "
                "write the table again with `semloc close`."
            ) from error
        if len(values["covariance"]) != 36:  # type: ignore[arg-type]
            raise ContractError(
                "The covariance of a row of closures.parquet has not 36 numbers; "
                "write the table again with `semloc close`."
            )
        values |= {
            "session_T_query": session_T_query,
            "session_position": session_position,
            "session_other": session_other,
        }
        return cls(**values)  # type: ignore[arg-type]

    def columns(self) -> dict[str, object]:
        """The columns of closures.parquet, in their order."""
        return {name: getattr(self, name) for name in COLUMNS}

    def target_T_query(self) -> F64:
        """Pose of the query's base frame in the target's base frame (4, 4)."""
        return transform(
            np.array([self.t_x, self.t_y, self.t_z]),
            np.array([self.q_x, self.q_y, self.q_z, self.q_w]),
        )

    def covariance_in_session(self) -> F64:
        """(6, 6) covariance of ``session_T_query`` due to the closure.

        The same errors, along the axes of the target's session frame.
        """
        session_T_query = np.eye(4) if self.session_T_query is None else self.session_T_query
        session_R_target = session_T_query[:3, :3] @ self.target_T_query()[:3, :3].T
        turn = np.kron(np.eye(2), session_R_target)
        return np.asarray(turn @ np.array(self.covariance).reshape(6, 6) @ turn.T)


COLUMNS = tuple(f.name for f in fields(ClosureRecord) if not f.name.startswith("session_"))
_TYPES: dict[str, type] = {
    name: str
    if name.endswith("_session")
    else int
    if name.endswith("_ns") or name in ("inliers", "words")
    else float
    for name in COLUMNS
} | {"covariance": tuple}

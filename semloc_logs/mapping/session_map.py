"""A fused session as later stages read it: its keyframes, poses and submaps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.errors import WorkspaceError
from semloc_logs.labels.space import KNOWS_CLASSES
from semloc_logs.logs.log import MAP_FORMAT
from semloc_logs.mapping.drift import UNMEASURED, Drift
from semloc_logs.tables.table import read_json, read_table
from semloc_logs.voxels.store import Keyframe, poses_of, read_keyframe
from semloc_logs.workspace import SessionFolder

KEPT = 64  # keyframes in memory: a query of 20 m and the next one


@dataclass(eq=False)
class SessionMap:
    """A fused session: the content of its tables and its session.json, read when needed."""

    folder: SessionFolder

    @cached_property
    def json(self) -> dict[str, Any]:
        """The content of session.json."""
        return read_json(self.folder.session_json)

    @cached_property
    def frames(self) -> pa.Table:
        """The table of keyframes."""
        return read_table(self.folder.frames)

    @cached_property
    def fixes(self) -> pa.Table | None:
        """The satellite fixes; None in sessions of earlier versions."""
        return read_table(self.folder.fixes) if self.folder.fixes.exists() else None

    @cached_property
    def map_T_base(self) -> F64:
        """Poses (n, 4, 4) of the keyframes."""
        return poses_of(self.frames)

    @cached_property
    def stamps_ns(self) -> NDArray[np.int64]:
        """When each keyframe (n,) was measured."""
        return np.asarray(self.frames["stamp_ns"].to_numpy())

    @cached_property
    def distance(self) -> F64:
        """Road travelled up to each keyframe (n,), metres."""
        return np.asarray(self.frames["distance"].to_numpy())

    @cached_property
    def ground_z(self) -> F64:
        """Height of the ground below each keyframe (n,), metres in the map frame."""
        return np.asarray(self.frames["ground_z"].to_numpy())

    @cached_property
    def origins(self) -> F64:
        """Centres (n, 3) of the sensor in the base frame, metres."""
        return self._vectors("origin")

    def _vectors(self, name: str) -> F64:
        """The columns name_x, name_y, name_z (n, 3) of the keyframes."""
        return np.stack([self.frames[f"{name}_{c}"].to_numpy() for c in "xyz"], 1).astype(float)

    @cached_property
    def topics(self) -> NDArray[np.object_]:
        """The stream (n,) of each keyframe's points."""
        return np.array(self.frames["topic"].to_pylist(), object)

    @cached_property
    def views(self) -> F64:
        """Means (n, 3) of the points around the sensor of each keyframe, metres in the map frame.

        Raises WorkspaceError when an earlier version fused the session.
        """
        self.check_version()
        view = self._vectors("view")
        rotated = np.einsum("nij,nj->ni", self.map_T_base[:, :3, :3], view)
        return np.asarray(rotated + self.map_T_base[:, :3, 3])

    def view_means(self) -> list[tuple[float, ...]]:
        """As :attr:`views`, but in the base frame; empty where an earlier version lacks them."""
        if "view_x" not in self.frames.column_names:
            return []
        return [tuple(view) for view in self._vectors("view").tolist()]

    def check_version(self) -> None:
        """Raises WorkspaceError when an earlier version fused the session."""
        if "view_x" not in self.frames.column_names:
            raise WorkspaceError(
                f"{self.folder.frames} is of an earlier version:"
                f" fuse session {self.folder.name} again with --overwrite."
            )

    @property
    def label_source(self) -> str:
        """Source of the classes, such as ``log`` or ``geometry``."""
        return str(self.json["label_source"])

    @cached_property
    def keyframe(self) -> Callable[[int], Keyframe]:
        """Reads a keyframe; the last ones stay in memory, as neighbouring queries share them."""
        return lru_cache(maxsize=KEPT)(partial(read_keyframe, self.folder.keyframes))

    @property
    def misfits(self) -> list[str]:
        """Why its poses cannot be right, a sentence each; empty where nothing is known."""
        fit = self.json.get("fit") or {"track": None, "streams": []}
        texts = [] if fit["track"] is None else [fit["track"]]
        for stream in fit["streams"]:
            wrong = (f["text"] for f in stream["findings"] if f["severity"] == "wrong")
            texts += [f"{stream['topic']}: {text}" for text in wrong]
        return texts

    @cached_property
    def measured_drift(self) -> Drift | None:
        """How its poses drift, where its range data showed it."""
        measured = (self.json.get("fit") or {}).get("drift")
        return None if measured is None else Drift.from_json(measured)

    @property
    def drift(self) -> Drift:
        """How its poses drift, measured or as odometry usually does."""
        return self.measured_drift or UNMEASURED

    @property
    def is_map(self) -> bool:
        """Whether it was made from maps of points alone, which nobody drove through."""
        return {log["format"] for log in self.json["logs"]} == {MAP_FORMAT}

    @property
    def frame_id(self) -> str:
        """The frame of the log's poses; ``semloc/SESSION`` where the log does not name it."""
        return str(self.json.get("session_frame") or "") or f"semloc/{self.folder.name}"

    @property
    def posed(self) -> bool:
        """Whether the log has poses."""
        return bool(self.json["posed"])

    @property
    def submaps(self) -> list[dict[str, Any]]:
        """Number, first and last keyframe, ground and blocks of each submap."""
        return list(self.json["submaps"])

    def road(self, submap: dict[str, Any]) -> F64:
        """Positions (m, 2) of a submap's keyframes in the map frame, metres."""
        return self.map_T_base[submap["first"] : submap["last"] + 1, :2, 3]

    @property
    def has_classes(self) -> bool:
        """Whether labels come from a log or a model, as the semantic network needs them."""
        return self.json["label_source"] in KNOWS_CLASSES

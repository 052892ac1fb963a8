"""The pass over a log: keyframes, thinned and kept on disk until gravity and labels are known."""

from __future__ import annotations

import errno
import os
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semloc_logs import progress
from semloc_logs.arrays import F32, F64
from semloc_logs.errors import WorkspaceError
from semloc_logs.frames import Header, PosedCloud
from semloc_logs.labels.camera_labels import PointLabels
from semloc_logs.labels.labeller import Labeller
from semloc_logs.logs.session.session import Session
from semloc_logs.mapping.selection import KeyframeSelector, thin
from semloc_logs.mapping.up_direction import FlatPlaces, flat_places
from semloc_logs.numerics.evenly import evenly
from semloc_logs.numerics.prefetch import prefetched
from semloc_logs.settings import ResolvedFusion

MOST_VIEWS = 20  # keyframes that show where up is


@dataclass(slots=True, eq=False)
class Collected:
    """Keyframe by keyframe: ``headers``, ``poses`` session_T_base (4, 4) or None, ``origins``.

    ``origins`` (3,) are the sensor in the base frame. The points, thinned to one a ``cell`` (m),
    are in files of the folder ``scratch``.
    """

    scratch: Path
    cell: float
    headers: list[Header] = field(default_factory=list)
    poses: list[F64 | None] = field(default_factory=list)
    origins: list[F32] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.headers)

    def add(
        self, cloud: PosedCloud, kept: NDArray[np.int64], label: PointLabels | None = None
    ) -> None:
        """Add a keyframe: points ``kept`` (m,) of ``cloud``, their labels (m,) or None."""
        number = len(self)
        self._save(number, "points", cloud.points[kept])
        self._save(number, "label", label)
        self._save(number, "sigma", None if cloud.sigma is None else cloud.sigma[kept])
        self.headers.append(cloud.header)
        self.poses.append(cloud.session_T_base)
        self.origins.append(cloud.origin)

    def load(self, keyframe: int) -> tuple[F32, PointLabels | None, F32 | None]:
        """Points (n, 3) in the base frame, labels as recorded, standard deviation of the ranges.

        The latter two are None where there are none. WorkspaceError when somebody removed the
        files, as a second ``fuse`` of the same session does.
        """
        points = self._load(keyframe, "points")
        if points is None:
            raise WorkspaceError(
                f"{self.scratch} was removed meanwhile: fuse a session in one process at a time."
            )
        return points, self._load(keyframe, "label"), self._load(keyframe, "sigma")

    def flat_places(self, most: int = MOST_VIEWS) -> dict[int, FlatPlaces]:
        """The flat places that ``most`` keyframes show, evenly spread, by number of the keyframe.

        They are relative to the sensor, in the axes of the session frame, or of the base frame
        without poses.
        """
        out = {}
        for i in evenly(len(self), most).tolist():
            points, _, sigma = self.load(i)
            noise = 0.0 if sigma is None else float(np.median(sigma))
            places = flat_places(points, self.origins[i], 2 * self.cell, noise)
            pose = self.poses[i]
            out[i] = places if pose is None else places.turned(pose[:3, :3])
        return out

    def _save(self, keyframe: int, what: str, values: NDArray[Any] | None) -> None:
        if values is None:
            return
        path = self.scratch / f"{keyframe}-{what}.npy"
        try:
            np.save(path, values, allow_pickle=False)
        except OSError as problem:
            if problem.errno is None:  # numpy counts bytes where the disk is full
                code = errno.ENOSPC
                raise OSError(code, os.strerror(code), str(path)) from None
            raise

    def _load(self, keyframe: int, what: str) -> NDArray[Any] | None:
        path = self.scratch / f"{keyframe}-{what}.npy"
        return np.load(path, allow_pickle=False) if path.exists() else None


def collect(
    session: Session,
    labeller: Labeller,
    fusion: ResolvedFusion,
    scratch: Path,
    name: str,
) -> Collected:
    """Read the log once: the thinned points of its keyframes go to files of ``scratch``.

    Progress is reported under the ``name`` of the session.
    """
    collected = Collected(scratch, fusion.keyframe_resolution)
    selector = KeyframeSelector(fusion)
    share = _ShareRead(session, name)
    clouds = session.clouds(labeller.on_image, labeller.images)
    # pictures come through the labeller in the same pass: they must not overtake the clouds that
    # they are painted on
    with closing(
        prefetched(clouds) if labeller.on_image is None else (cloud for cloud in clouds)
    ) as coming:
        for cloud in coming:
            share.reach(cloud.header.log_time_ns)
            if selector.wants(cloud.header.topic, cloud.header.stamp_ns, cloud.session_T_base):
                kept = thin(cloud.points, collected.cell)
                collected.add(cloud, kept, labeller.take(cloud, kept))
    share.finish()
    return collected


class _ShareRead:
    """Reports how much of the logs is read, in whole seconds of their time."""

    def __init__(self, session: Session, name: str) -> None:
        starts = [log.start_ns for log in session.logs if log.start_ns is not None]
        ends = [log.end_ns for log in session.logs if log.end_ns is not None]
        self._name = name
        self._start_ns = min(starts, default=0)
        self._total = max(1, (max(ends) - self._start_ns) // 10**9) if starts and ends else None
        self._done = 0

    def reach(self, log_time_ns: int) -> None:
        """A message of this time is read."""
        done = (log_time_ns - self._start_ns) // 10**9
        if self._total is not None and self._done < done < self._total:
            self._done = done
            progress.report("fuse", self._name, done, self._total, "s of log")

    def finish(self) -> None:
        if self._total is not None:
            progress.report("fuse", self._name, self._total, self._total, "s of log")

"""The pass over a log: which clouds become keyframes, thinned and kept on disk until gravity and the meaning of labels are known."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semloc_logs.frames import Header
from semloc_logs.labels.labeller import Labeller
from semloc_logs.logs.session import Session
from semloc_logs.settings import Fusion
from semloc_logs.voxels.ahead import ahead
from semloc_logs.voxels.gravity import surface_normals
from semloc_logs.voxels.selection import KeyframeSelector, thin

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
MOST_NORMALS = 40  # keyframes whose normals say where up is


@dataclass(slots=True, eq=False)
class Collected:
    """Keyframe by keyframe: ``header``, ``session_T_base`` (4, 4) or None, ``origin`` (3,) of the sensor in the base frame; their points,
    and of some of them ``normals``: (keyframe, unit vectors (m, 3) in the session frame, or the base frame without poses, weights)."""

    scratch: Path
    headers: list[Header] = field(default_factory=list)
    poses: list[F64 | None] = field(default_factory=list)
    origins: list[F32] = field(default_factory=list)
    normals: list[tuple[int, F64, F64]] = field(default_factory=list)
    _every: int = 1  # keyframes with normals are this far apart

    def __len__(self) -> int:
        return len(self.headers)

    def load(self, keyframe: int) -> tuple[F32, NDArray[np.uint32] | None, F32 | None]:
        """Points (n, 3) in the base frame, their labels as recorded and the standard deviation of their range, where there are any."""
        points, label, sigma = (self.scratch / f"{keyframe}{what}.npy" for what in ("", "-label", "-sigma"))
        return _load(points), _load(label) if label.exists() else None, _load(sigma) if sigma.exists() else None

    def add(self, raw: RawKeyframe, cell: float) -> None:
        """The next keyframe; its points are in the scratch folder already."""
        number = len(self)
        self.headers.append(raw.header)
        self.poses.append(raw.session_T_base)
        self.origins.append(raw.origin)
        if number % self._every == 0:
            noise = 0.0 if raw.sigma is None else float(np.median(raw.sigma))
            normals, weights = surface_normals(raw.points, raw.origin, cell, noise)
            turned = normals if raw.session_T_base is None else normals @ raw.session_T_base[:3, :3].T
            self.normals.append((number, turned, weights))
            if len(self.normals) > MOST_NORMALS:
                self._every *= 2
                self.normals = [k for k in self.normals if k[0] % self._every == 0]


@dataclass(frozen=True, slots=True, eq=False)
class RawKeyframe:
    """A thinned cloud before its classes are known; the fields are those of a PosedCloud."""

    header: Header
    session_T_base: F64 | None
    origin: F32
    points: F32
    sigma: F32 | None


def collect(session: Session, labeller: Labeller, fusion: Fusion, scratch: Path, on_progress: Callable[[str], None]) -> Collected:
    """Read the log once: thinned points of its keyframes go to files of ``scratch``, what is small stays in memory."""
    cell = fusion.keyframe_resolution or 0.1
    collected = Collected(scratch)
    for raw in ahead(_keyframes(session, labeller, KeyframeSelector(fusion), cell, scratch)):
        collected.add(raw, 2 * cell)
        if len(collected) % 50 == 0:
            on_progress(f"read {len(collected)} keyframes")
    return collected


def _keyframes(session: Session, labeller: Labeller, selector: KeyframeSelector, cell: float, scratch: Path) -> Iterator[RawKeyframe]:
    number = 0
    for cloud in session.clouds(labeller.on_image, labeller.images):
        if not selector.wants(cloud.header.topic, cloud.header.stamp_ns, cloud.session_T_base):
            continue
        keep = thin(cloud.points, cell)
        points = cloud.points[keep]
        _save(scratch, number, "", points)
        _save(scratch, number, "-label", labeller.take(cloud, keep))
        sigma = None if cloud.sigma is None else cloud.sigma[keep]
        _save(scratch, number, "-sigma", sigma)
        yield RawKeyframe(cloud.header, cloud.session_T_base, cloud.origin, points, sigma)
        number += 1


def _save(scratch: Path, keyframe: int, what: str, values: NDArray[np.generic] | None) -> None:
    if values is not None:
        np.save(scratch / f"{keyframe}{what}.npy", values, allow_pickle=False)


def _load(path: Path) -> NDArray[Any]:
    values: NDArray[Any] = np.load(path, allow_pickle=False)
    return values

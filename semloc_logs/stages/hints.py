"""What may help where nothing was found."""

from __future__ import annotations

import numpy as np

from semloc_logs.logs.inspection.verdict import far_range, voxel_size
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.workspace import Workspace

_LOOKED_AT = 10  # keyframes of a session


def voxel_size_hint(work: Workspace) -> str | None:
    """A sentence where the voxels are too large for what the sensors reach, as in rooms."""
    smaller: dict[str, tuple[float, float, float]] = {}
    for folder in work.sessions():
        session = SessionMap(folder)
        count = len(session.stamps_ns)
        chosen = np.unique(np.linspace(0, count - 1, min(count, _LOOKED_AT)).astype(int))
        points = [session.keyframe(int(k)).points - session.origins[k] for k in chosen]
        far = far_range(np.linalg.norm(np.concatenate(points), axis=1)) if points else None
        size, present = voxel_size(far), float(session.json["voxel_size"])
        if far is not None and size < present:
            smaller[folder.name] = (size, far, present)
    if not smaller:
        return None
    name, (size, far, present) = min(smaller.items(), key=lambda item: item[1])
    return (
        f"Nearly all points of {name} lie within {far:.1f} m, where voxels of {present:g} m are too"
        f" large: make the maps again with --set fusion.voxel_size={size:.2f} in another workspace,"
        " or with --overwrite."
    )

"""What tables tell about themselves: the key ``semloc`` of their metadata
(docs/reference/tables.md).
"""

from __future__ import annotations

from typing import Any

import semloc_logs
from semloc_logs.arrays import F64

SCHEMA_VERSION = 1  # of all tables, and of the JSON files beside them


def origin() -> dict[str, Any]:
    """The version of the contracts, and of the program."""
    return {"schema_version": SCHEMA_VERSION, "version": semloc_logs.__version__}


def map_metadata(voxel_size: float, session_T_map: F64, label_source: str) -> dict[str, Any]:
    """Of tables in the voxels of a map: metres, (4, 4), and where its classes are from."""
    return origin() | {
        "voxel_size": voxel_size,
        "session_T_map": session_T_map.tolist(),
        "label_space": "cityscapes",
        "label_source": label_source,
    }

"""True poses as a TUM file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import translation_quaternion
from semloc_logs.tables.atomic_files import replacing_file


def write_truth(path: Path, stamps_ns: NDArray[np.int64], world_T_base: F64) -> None:
    """True poses (n, 4, 4) as a TUM file: seconds with 9 decimals, metres, quaternion xyzw."""
    translation, quaternion = translation_quaternion(world_T_base)
    rows = [
        f"{stamp // 10**9}.{stamp % 10**9:09d} " + " ".join(f"{v:.9f}" for v in (*t, *q))
        for stamp, t, q in zip(stamps_ns.tolist(), translation, quaternion, strict=True)
    ]
    with replacing_file(path) as temporary:
        temporary.write_text("\n".join(rows) + "\n", encoding="ascii")

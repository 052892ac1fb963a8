"""Arrays as text for the page: a type and the little-endian bytes in base64."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

# names of the page's typed arrays
FLOAT, INDEX, SIGNED, BYTE = "f4", "u2", "i4", "u1"


def packed(values: ArrayLike, kind: str = FLOAT) -> list[str]:
    """``values`` in row-major order as ``[kind, base64]``."""
    array = np.ascontiguousarray(np.asarray(values), dtype=np.dtype(kind).newbyteorder("<"))
    return [kind, base64.b64encode(array.tobytes()).decode("ascii")]


def unpacked(text: list[str]) -> Any:
    """The values (n,) of :func:`packed`."""
    kind, data = text
    return np.frombuffer(base64.b64decode(data), np.dtype(kind).newbyteorder("<"))

"""Some of many, evenly spread."""

import numpy as np
from numpy.typing import NDArray


def evenly(count: int, most: int) -> NDArray[np.int64]:
    """Numbers of at most ``most`` of ``count`` things, ascending, with the first and the last; of a
    single one the middle.
    """
    if not count:
        return np.zeros(0, np.int64)
    if most == 1:
        return np.array([count // 2], np.int64)
    return np.unique(np.linspace(0, count - 1, most).round().astype(np.int64))

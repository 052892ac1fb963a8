"""The errors that a labelling network makes: wrong patches that stay in place or come and go, and
classes that bleed over edges.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import U8
from semloc_logs.simulation.sensors.echoes import hash_cells

# what a labelling network takes a class for when it is wrong
CONFUSIONS: dict[int, tuple[int, ...]] = {
    0: (1, 9, 1),
    1: (0, 9, 0),
    2: (3, 4, 8, 255),
    3: (2, 4, 8),
    4: (3, 8, 2),
    5: (8, 7, 2, 255),
    6: (5, 7, 8),
    7: (5, 2, 8),
    8: (9, 4, 2, 255),
    9: (8, 1, 0),
    11: (12, 8, 5),
    12: (11, 18, 17),
    13: (14, 2, 15),
    14: (13, 15, 2),
    15: (14, 13, 2),
    16: (15, 14, 2),
    17: (18, 13, 11),
    18: (17, 8, 4),
    255: (2, 8, 3),
}
_BLEED = 0.35  # of the points beside an edge, at a rate of 0.15


def _table() -> U8:
    table = np.full((256, 12), 255, np.uint8)
    for label, wrong in CONFUSIONS.items():
        table[label] = np.resize(np.asarray(wrong, np.uint8), 12)
    return table


def corrupt_labels(
    points: NDArray[np.floating],
    labels: U8,
    seed: int,
    rate: float,
    *,
    frame: int | None = None,
    beyond: U8 | None = None,
) -> U8:
    """The labels (n,) with about the share ``rate`` of them wrong as a network's are: in patches of
    0.5 m and 2.5 m and single points.

    Patches follow from ``points`` (n, 3) and ``seed``: points in a fixed frame and the same seed
    give the same errors in every sweep. With the number of a ``frame`` about half of them belong to
    that frame alone. ``beyond`` (n,) is the class across the nearest edge
    (:func:`semloc_logs.simulation.sensors.echoes.beyond_edges`), which bleeds over as the label of
    masks that are laid over a scan does.
    """
    table = _table()
    out = labels.copy()
    exact = np.asarray(points, np.float64)
    if beyond is not None:
        rows = np.flatnonzero(beyond != labels)
        patch = hash_cells(
            np.floor(exact[rows] / 0.7).astype(np.int64), seed * 3 + 7 + 65_537 * (frame or 0)
        )
        bleeds = rows[patch % 4096 < 4096 * min(1.0, _BLEED * rate / 0.15)]
        out[bleeds] = beyond[bleeds]
        rate = max(0.0, rate - len(bleeds) / max(1, len(labels)))
    passing = 0 if frame is None else 1_000_003 * (frame + 1)
    kinds = [(2.5, 0.45, 0), (0.5, 0.4, 0)]  # size (m), share of the errors, of which frame
    if frame is not None:
        kinds = [(2.5, 0.25, 0), (0.5, 0.2, 0), (1.5, 0.25, passing), (0.4, 0.15, passing)]
    # errors of several kinds fall on the same points, so that each kind has to make a little more
    # of them
    more = -np.log1p(-min(rate, 0.999)) / rate if rate > 0 else 0.0
    for k, (size, share, of_frame) in enumerate([*kinds, (0.0, 0.15, passing)]):
        if size:
            cells = np.floor(exact / size).astype(np.int64)
        else:
            cells = np.arange(len(exact), dtype=np.int64)[:, None] * np.array([1, 0, 0])
        # the class takes part in the hash, so that a patch is a piece of one object
        cells[:, 2] = cells[:, 2] * 256 + labels
        draw = hash_cells(cells, seed * 3 + k + of_frame)
        wrong = (draw % 4096) < 4096 * share * rate * more
        out[wrong] = table[labels[wrong], (draw[wrong] >> 12) % 12]
    return out

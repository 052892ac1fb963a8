"""Subvolumes to look at, as in figure 3 of the paper: rows of input, output and truth as boxes seen
from above and aside.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.labels.space import UNLABELLED, cityscapes
from semloc_logs.tables.atomic_files import replacing_file
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]

EDGE = 12.0  # pixels of a voxel's edge
INK = (40, 40, 40)
LETTERS = cv2.FONT_HERSHEY_SIMPLEX
_FACES = (  # corners of the faces that show, the neighbour that would hide them, brightness
    (((1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)), (1, 0, 0), 0.62),
    (((0, 1, 0), (1, 1, 0), (1, 1, 1), (0, 1, 1)), (0, 1, 0), 0.8),
    (((0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)), (0, 0, 1), 1.0),
)


def colours() -> U8:
    """RGB (256, 3) of voxel states: the classes of Cityscapes, grey where the class is unknown."""
    table = np.full((256, 3), 150, np.uint8)
    table[: len(cityscapes().colours)] = cityscapes().colours
    return table


def render(state: U8) -> U8:
    """RGB picture of the occupied voxels of ``state`` (x, y, z) as boxes: isometric, seen from +x,
    +y and above.
    """
    filled = (state != FREE_STATE) & (state != UNOBSERVED_STATE)
    nx, ny, nz = state.shape
    width, height = (int(EDGE * n) + 4 for n in ((nx + ny) * 0.866, (nx + ny) * 0.5 + nz))
    image = np.full((height, width, 3), 255, np.uint8)
    floor = np.array([[0, 0, 0], [nx, 0, 0], [nx, ny, 0], [0, ny, 0]], float)
    cv2.polylines(image, [_pixels(floor, nx, ny, nz)], True, (205, 205, 205), 1, cv2.LINE_AA)
    table = colours()
    open_side = np.pad(~filled, ((0, 1), (0, 1), (0, 1)), constant_values=True)
    voxel = np.argwhere(filled)
    for i, j, k in voxel[np.argsort(voxel.sum(1), kind="stable")]:
        colour = table[state[i, j, k]].astype(float)
        for corners, (dx, dy, dz), bright in _FACES:
            if open_side[i + dx, j + dy, k + dz]:
                shape = _pixels(np.array(corners, float) + np.array([i, j, k]), nx, ny, nz)
                cv2.fillConvexPoly(image, shape, tuple((colour * bright).tolist()))
                cv2.polylines(image, [shape], True, tuple((colour * bright * 0.8).tolist()), 1)
    return image


def _pixels(points: F64, nx: int, ny: int, nz: int) -> NDArray[np.int32]:
    """Pixels (n, 2) of points (n, 3) in voxels."""
    u = (points[:, 1] - points[:, 0] + nx) * 0.866
    v = (points[:, 0] + points[:, 1]) * 0.5 + nz - points[:, 2]
    return np.asarray(np.round(EDGE * np.stack([u, v], 1)) + 2, np.int32)


def draw_completions(path: Path, title: str, given: U8, said: U8, truth: U8) -> None:
    """PNG with a row for each subvolume: voxel states (n, 32, 32, 32) of the input, the output and
    the truth; classes in a legend.

    What the truth did not observe is left out of the output too: nothing is known to compare it
    with.
    """
    shown = np.where(truth == UNOBSERVED_STATE, UNOBSERVED_STATE, said)
    rows = [
        np.hstack([render(view[k]) for view in (given, shown, truth)]) for k in range(len(truth))
    ]
    body = np.vstack(rows) if rows else np.full((10, 900, 3), 255, np.uint8)
    head = np.full((70, body.shape[1], 3), 255, np.uint8)
    for k, name in enumerate(("input", f"output, {title}", "truth")):
        cv2.putText(
            head, name, (k * body.shape[1] // 3 + 20, 48), LETTERS, 1.2, INK, 2, cv2.LINE_AA
        )
    image = np.vstack([head, body, _legend(np.concatenate([given, shown, truth]), body.shape[1])])
    with replacing_file(path) as temporary:
        _, data = cv2.imencode(".png", np.ascontiguousarray(image[:, :, ::-1]))
        temporary.write_bytes(data.tobytes())


def _legend(states: U8, width: int) -> U8:
    """Names of the classes that occur beside their colours, the most frequent first."""
    counts = np.bincount(states.ravel(), minlength=256)
    counts[[FREE_STATE, UNOBSERVED_STATE]] = 0
    present = sorted(np.flatnonzero(counts).tolist(), key=lambda c: -counts[c])
    names = cityscapes().names
    columns = max(1, width // 300)
    image = np.full((20 + 50 * -(-max(len(present), 1) // columns), width, 3), 255, np.uint8)
    for n, label in enumerate(present):
        x = 20 + 300 * (n % columns)
        y = 10 + 50 * (n // columns)
        cv2.rectangle(
            image, (x, y), (x + 30, y + 30), tuple(colours()[label].astype(float).tolist()), -1
        )
        name = (
            names[label]
            if label < len(names)
            else "occupied"
            if label == UNLABELLED
            else str(label)
        )
        cv2.putText(image, name, (x + 42, y + 25), LETTERS, 0.8, INK, 1, cv2.LINE_AA)
    return image

"""A bird's-eye picture of a session map: class colours, shaded by height, with the trajectory."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.labels.space import cityscapes
from semloc_logs.tables import read_table, replacing_file

LARGEST = 4000  # pixels along an edge


def colour_table() -> NDArray[np.uint8]:
    """RGB (256, 3) of class ids; light grey where unlabelled."""
    table = np.full((256, 3), 200, np.uint8)
    table[: len(cityscapes().colours)] = cityscapes().colours
    return table


def bird_view(
    ijk: NDArray[np.integer], label: NDArray[np.uint8], low: NDArray[np.integer], shape: tuple[int, int], step: int = 1
) -> NDArray[np.uint8]:
    """RGB picture (height, width, 3), x right, y up, of voxels (n, 3); the highest voxel of a column shows, brighter when higher."""
    image = np.full((shape[1], shape[0], 3), 255, np.uint8)
    if not len(ijk):
        return image
    order = np.argsort(ijk[:, 2], kind="stable")
    x, y = ((ijk[order, :2] - low[:2]) // step).T
    z = ijk[order, 2]
    bottom, top = np.percentile(z, [2, 98])
    bright = 0.65 + 0.5 * np.clip((z - bottom) / max(top - bottom, 1), 0, 1)
    image[shape[1] - 1 - y, x] = np.clip(colour_table()[label[order]] * bright[:, None], 0, 255)
    return image


def draw_map(voxels: Path, trajectory: NDArray[np.floating], voxel_size: float, path: Path) -> None:
    """PNG of the tables in ``voxels``; ``trajectory`` (n, 3) metres in the map frame is a red line, green where it starts."""
    tables = [read_table(p, ["ix", "iy", "iz", "label"]) for p in sorted(voxels.rglob("*.parquet"))]
    ijk = np.concatenate([np.stack([t[c].to_numpy() for c in ("ix", "iy", "iz")], 1) for t in tables])
    label = np.concatenate([t["label"].to_numpy() for t in tables])
    track = np.floor(np.asarray(trajectory, float) / voxel_size)
    every = np.concatenate([ijk[:, :2], track[:, :2].astype(np.int64)]) if len(ijk) or len(track) else np.zeros((1, 2), np.int64)
    low, high = every.min(0) - 4, every.max(0) + 5
    step = int(max(1, np.ceil((high - low).max() / LARGEST)))
    size = (high - low + step - 1) // step
    image = bird_view(ijk, label, low, (int(size[0]), int(size[1])), step)
    zoom = max(1, 1000 // max(image.shape[:2]))
    image = np.asarray(cv2.resize(image, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST), np.uint8)
    line = (
        np.stack([(track[:, 0] - low[0]) / step * zoom, (size[1] - 1 - (track[:, 1] - low[1]) / step) * zoom], 1)
        if len(track)
        else np.zeros((0, 2))
    )
    cv2.polylines(image, [np.round(line).astype(np.int32).reshape(-1, 1, 2)], False, (255, 0, 0), max(2, zoom))
    for point in line[:1]:
        cv2.circle(image, tuple(np.round(point).astype(int).tolist()), 4 * max(1, zoom), (0, 160, 0), -1)
    with replacing_file(path) as temporary:
        ok, data = cv2.imencode(".png", image[:, :, ::-1])
        temporary.write_bytes(data.tobytes() if ok else b"")

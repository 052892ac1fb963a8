"""The map of a session from above as a small picture that shows through where nothing was seen."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import U8
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.pictures.map_picture import bare_map

SHEET = 1100  # pixels along the longer edge of a session's map, at most
LEAST_SHEET = 360
ALL_SHEETS = 12e6  # pixels of all maps together
QUALITY = 55  # of WebP


@dataclass(frozen=True, slots=True)
class MapSheet:
    """A map from above: WebP in base64; its left and upper edge and its extent in the map frame.

    Metres; ``below_roof`` where it was cut at the height of the sensor.
    """

    picture: str
    left: float
    upper: float
    width: float
    height: float
    below_roof: bool


def sheet_size(sessions: int) -> int:
    """Pixels along the longer edge, so that the maps of all sessions fit into one page."""
    return int(np.clip(np.sqrt(ALL_SHEETS / max(sessions, 1)), LEAST_SHEET, SHEET))


def map_sheet(session: SessionMap, most: int) -> MapSheet | None:
    """The map of ``session``, at most ``most`` pixels wide and high; None where it is empty."""
    size = float(session.json["voxel_size"])
    positions = session.map_T_base[:, :3, 3] if session.posed else np.zeros((0, 3))
    canvas, below_roof = bare_map(session.folder.voxels, positions / size, most)
    if not canvas.seen.any():
        return None
    pixel = canvas.step * size
    height, width = canvas.top.shape
    left, lower = (canvas.low * size).tolist()
    picture = webp(canvas.image(), canvas.seen)
    return MapSheet(
        picture, left, lower + height * pixel, width * pixel, height * pixel, below_roof
    )


def webp(image: U8, seen: NDArray[np.bool_] | None = None, quality: int = QUALITY) -> str:
    """RGB ``image`` (height, width, 3) as WebP in base64, transparent where not ``seen``."""
    channels = [image[..., 2], image[..., 1], image[..., 0]]
    if seen is not None:
        channels.append(np.where(seen, 255, 0).astype(np.uint8))
    _, data = cv2.imencode(".webp", np.stack(channels, -1), [cv2.IMWRITE_WEBP_QUALITY, quality])
    return base64.b64encode(data.tobytes()).decode("ascii")

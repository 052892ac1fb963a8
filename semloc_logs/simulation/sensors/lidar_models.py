"""Lidars as their makers describe them: where the beams point, from which height, how far and how
well they measure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32, F64


@dataclass(frozen=True, slots=True)
class LidarModel:
    """A lidar: beam elevations in degrees from the top, columns a turn, height over ground and
    longest range in metres.

    ``pattern``: ``spin`` turns about z; ``raster`` scans lines at the elevations over
    ``width_deg``, the uppermost first; ``rosette`` leads a row of beams through two turning prisms
    (Risley), which draws another flower of ``width_deg`` x ``rise_deg`` at every moment. Standard
    deviations: ``noise`` of a range (m); ``beam_bias`` of the constant that each beam adds to its
    ranges (m); ``pointing_deg`` of the angle between the measured and the reported column.
    ``divergence``: full angle of a beam (rad), inside which an edge mixes two ranges. ``lift``:
    heights of the beams' origins over the sensor's (m). ``blocked``: (from, to, below) degrees of
    azimuth, anticlockwise, and elevation where the vehicle itself is in the way.
    """

    name: str
    elevations_deg: tuple[float, ...]
    columns: int
    height: float
    max_range: float
    noise: float = 0.02
    min_range: float = 1.0
    pattern: str = "spin"
    width_deg: float = 360.0
    rise_deg: float = 0.0
    beam_bias: float = 0.01
    pointing_deg: float = 0.01
    divergence: float = 0.002
    lift: tuple[float, ...] = ()
    blocked: tuple[tuple[float, float, float], ...] = ()


def _even(top: float, bottom: float, beams: int) -> tuple[float, ...]:
    return tuple(float(e) for e in np.linspace(top, bottom, beams))


MODELS = {
    # two blocks of 32 lasers 0.09 m apart (HDL-64E manual, appendix on calibration); on the roof of
    # a station wagon
    "hdl64": LidarModel(
        "hdl64",
        _even(1.95, -8.7, 32) + _even(-9.3, -24.4, 32),
        2083,
        1.73,
        80.0,
        noise=0.01,
        beam_bias=0.012,
        divergence=0.003,
        lift=(0.21,) * 32 + (0.12,) * 32,
        blocked=(
            (153.0, 210.0, -18.3),
            (284.0, 306.0, -16.9),
            (127.0, 145.0, -21.0),
            (228.0, 244.0, -21.0),
            (320.0, 334.0, -23.0),
        ),
    ),
    "hdl32": LidarModel("hdl32", _even(10.67, -30.67, 32), 1500, 1.9, 70.0),
    "vlp32": LidarModel(
        "vlp32",
        (15.0, 10.3, 7.0, *_even(4.67, -4.67, 22), -6.0, -7.3, -9.0, -11.3, -14.0, -18.0, -25.0),
        1500,
        1.9,
        90.0,
    ),
    "vlp16": LidarModel("vlp16", _even(15.0, -15.0, 16), 1800, 1.8, 80.0),
    # solid state, looking ahead: Livox Avia (six beams, 240,000 points a second), and a scanning
    # mirror
    "rosette": LidarModel(
        "rosette",
        _even(0.7, -0.7, 6),
        4000,
        1.8,
        120.0,
        pattern="rosette",
        width_deg=70.4,
        rise_deg=77.2,
        beam_bias=0.004,
    ),
    "raster": LidarModel(
        "raster",
        _even(10.0, -15.0, 80),
        500,
        1.8,
        120.0,
        pattern="raster",
        width_deg=120.0,
        beam_bias=0.004,
    ),
}
_PRISMS_HZ = 121.57, -77.73  # of the two prisms (Livox Mid-40: 7294 and -4664 turns a minute)


def beam_directions(
    model: LidarModel, columns: int, sector: tuple[float, float] | None = None, moment: float = 0.0
) -> tuple[F32, NDArray[np.uint16], F64]:
    """Unit directions (n, 3) in the sensor frame, ring (n,) from the top, and share of the sweep's
    time (n,).

    The rows are a grid of columns x beams: what one beam measures next is ``beams`` rows further.
    ``sector`` = azimuths in radians. ``moment`` in seconds since the sensor was switched on turns a
    rosette; of a spinning sensor the share of a column counts.
    """
    shape = columns, len(model.elevations_deg)
    step = (np.arange(columns) + 0.5) / columns
    elevation = np.broadcast_to(np.radians(np.asarray(model.elevations_deg)), shape)
    if model.pattern == "rosette":
        angle = 2 * np.pi * np.outer(moment + 0.1 * step, _PRISMS_HZ)
        azimuth = np.broadcast_to(
            np.radians(model.width_deg / 4) * np.cos(angle).sum(1)[:, None], shape
        )
        elevation = elevation + np.radians(model.rise_deg / 4) * np.sin(angle).sum(1)[:, None]
        turn = np.broadcast_to(step[:, None], shape)
    elif model.pattern == "raster":
        azimuth = np.broadcast_to(np.radians(model.width_deg) * (0.5 - step)[:, None], shape)
        turn = (np.arange(shape[1]) + step[:, None]) / shape[1]
    else:
        azimuth = np.broadcast_to(
            (np.pi - 2 * np.pi * (step + (moment * 1e3 % 1.0) / columns))[:, None], shape
        )
        turn = np.broadcast_to(step[:, None], shape)
    keep = (
        np.ones(columns, bool)
        if sector is None
        else (azimuth[:, 0] >= sector[0]) & (azimuth[:, 0] <= sector[1])
    )
    a = azimuth[keep]
    e = elevation[keep]
    directions = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(
        -1, 3
    )
    ring = np.tile(np.arange(shape[1], dtype=np.uint16), int(keep.sum()))
    return directions.astype(np.float32), ring, turn[keep].reshape(-1)


def is_blocked(model: LidarModel, directions: F32) -> NDArray[np.bool_]:
    """Which directions (n, 3) hit the vehicle that carries the sensor."""
    azimuth = np.degrees(np.arctan2(directions[:, 1], directions[:, 0])) % 360.0
    elevation = np.degrees(np.arcsin(np.clip(directions[:, 2], -1, 1)))
    out = np.zeros(len(directions), bool)
    for start, end, below in model.blocked:
        out |= (azimuth >= start) & (azimuth <= end) & (elevation < below)
    return out

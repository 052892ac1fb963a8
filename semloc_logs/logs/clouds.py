"""Point clouds as recorded, a block of bytes and a list of fields, to arrays; without a loop over points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semloc_logs.frames import F32
from semloc_logs.logs.definitions import UndecodableError

LABELS = ("label", "semantic", "class", "objtag")
RINGS = ("ring", "line")
TIMES = ("t", "time", "timestamp", "time_stamp", "offset_time", "time_offset")
_SWEEP_NS = 1_000_000_000  # no time of a point is further from its header than a second
_LEAST_SPAN_NS = 5_000_000  # a sweep takes longer than this, which tells milliseconds from microseconds


@dataclass(frozen=True, slots=True)
class Field:
    """One value of a point: ``kind`` is a numpy type code such as ``f4``."""

    name: str
    offset: int
    kind: str


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """``points`` (n, 3) with label, time (relative to the header stamp) and ring where recorded."""

    points: F32
    label: NDArray[np.uint32] | None
    offset_ns: NDArray[np.int64] | None
    ring: NDArray[np.uint16] | None


@dataclass(frozen=True, slots=True)
class Layout:
    """``height`` rows of ``width`` points; bytes from point to point and from row to row."""

    width: int
    height: int
    point_step: int
    row_step: int
    big_endian: bool = False


def decode_points(data: bytes | memoryview, layout: Layout, fields: Sequence[Field], stamp_ns: int) -> Points:
    """Points whose position is finite and not exactly zero. UndecodableError when the layout does not fit the data."""
    if layout.width == 0 or layout.height == 0:
        return Points(np.empty((0, 3), np.float32), None, None, None)  # its fields may be missing too
    rows = _rows(data, layout, fields)
    columns = {name.lower(): name for name in reversed(rows.dtype.names or ())}
    for axis in "xyz":
        if axis not in columns:
            raise UndecodableError(f"it has no field {axis}")
        if rows.dtype[columns[axis]].kind != "f":
            raise UndecodableError(f"its field {axis} is no floating point number")
    xyz = np.empty((rows.size, 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # float64 beyond float32 becomes infinite and is dropped below
        for k, axis in enumerate("xyz"):
            xyz[:, k].reshape(rows.shape)[...] = rows[columns[axis]]
    valid = np.isfinite(xyz[:, 0]) & np.isfinite(xyz[:, 1]) & np.isfinite(xyz[:, 2])
    valid &= (xyz[:, 0] != 0) | (xyz[:, 1] != 0) | (xyz[:, 2] != 0)
    everything = bool(valid.all())

    def column(names: Sequence[str], kinds: str) -> NDArray[np.generic] | None:
        for name in names:
            if name in columns and rows.dtype[columns[name]].kind in kinds:
                values = rows[columns[name]].reshape(-1)
                return values if everything else values[valid]
        return None

    label, ring, time = column(LABELS, "iu"), column(RINGS, "iu"), column(TIMES, "iuf")
    return Points(
        points=xyz if everything else xyz[valid],
        label=None if label is None else label.astype(np.uint32),
        offset_ns=None if time is None else offsets_ns(time, stamp_ns),
        ring=None if ring is None else ring.astype(np.uint16),
    )


def _rows(data: bytes | memoryview, layout: Layout, fields: Sequence[Field]) -> NDArray[np.void]:
    """A view (height, width) of the points as records."""
    width, height, step, row = layout.width, layout.height, layout.point_step, layout.row_step
    if height <= 1 or row < width * step:
        row = width * step  # often left at zero, or wrong where it does not matter
    names: dict[str, Field] = {}
    for field in fields:
        if field.name and field.offset >= 0 and field.offset + np.dtype(field.kind).itemsize <= step:
            names.setdefault(field.name, field)
    order = ">" if layout.big_endian else "<"
    dtype = np.dtype(
        {
            "names": list(names),
            "formats": [order + f.kind for f in names.values()],
            "offsets": [f.offset for f in names.values()],
            "itemsize": max(step, 1),
        }
    )
    needed = (height - 1) * row + width * step
    if step <= 0 or needed > len(data):
        raise UndecodableError(f"{width} x {height} points of {step} bytes need {needed} bytes, but it has {len(data)}")
    return np.ndarray((height, width), dtype, buffer=data, strides=(row, step))


def offsets_ns(time: NDArray[np.generic], stamp_ns: int) -> NDArray[np.int64] | None:
    """Times of points relative to ``stamp_ns``, whatever their unit and origin; None when nothing makes sense of them.

    The unit (s, ms, us, ns) and origin (the stamp, or the epoch) are those with which the points span more than 5 ms and
    stay within a second of the stamp; failing that (a flash sensor) those that keep them within a second at all.
    """
    if time.size == 0:
        return np.zeros(0, np.int64)
    low, high = time.min().item(), time.max().item()
    if not (np.isfinite(low) and np.isfinite(high)):
        return None
    units = (1, 1_000, 1_000_000, 1_000_000_000) if time.dtype.kind in "iu" else (1_000_000_000, 1_000_000, 1_000, 1)
    fallback = None
    for unit in units:
        for origin in (0, stamp_ns):
            # in integers, because nanoseconds since 1970 do not fit a float64; the parts of a second are exact enough as float
            first, last = _to_ns(low, unit) - origin, _to_ns(high, unit) - origin
            if max(abs(first), abs(last)) < _SWEEP_NS:
                if last - first >= _LEAST_SPAN_NS:
                    return _shift(time, unit, origin)
                fallback = fallback or (unit, origin)
    return None if fallback is None else _shift(time, *fallback)


def _to_ns(value: float, unit: int) -> int:
    return int(value) * unit + int((value - int(value)) * unit)


def _shift(time: NDArray[np.generic], unit: int, origin: int) -> NDArray[np.int64]:
    """``time * unit - origin`` as int64; only called where every result is below a second."""
    if time.dtype.kind in "iu":
        whole, rest = divmod(origin, unit)
        # unsigned 64-bit arithmetic wraps, so the small difference is right even where the times are not
        difference = time.astype(np.uint64) - np.uint64(whole % (1 << 64))
        return difference.view(np.int64) * np.int64(unit) - np.int64(rest)
    seconds = time.astype(np.float64)
    base = np.floor(seconds.min())
    fraction = np.rint((seconds - base) * unit).astype(np.int64)
    return np.asarray(fraction + np.int64(int(base) * unit - origin), np.int64)

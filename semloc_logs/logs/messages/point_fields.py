"""Recorded point clouds, a block of bytes and a list of fields, to arrays without a loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32, F64
from semloc_logs.frames import PointTimeRemark
from semloc_logs.logs.messages.definitions import UndecodableError
from semloc_logs.logs.messages.point_times import offsets_ns

LABELS = ("label", "semantic", "class", "objtag")
RINGS = ("ring", "line")
TIMES = (
    "t", "time", "timestamp", "time_stamp", "offset_time", "time_offset", "time_offset_ns",
    "timestamp_offset", "point_time_offset", "relative_timestamp",
)  # fmt: skip
TAG = "tag"  # of Livox, whose drivers record it beside "line"
_NOISE = (1, 2)  # of the two bits of a judgement
_USED = {"x", "y", "z", TAG, *LABELS, *RINGS, *TIMES}


@dataclass(frozen=True, slots=True)
class Field:
    """One value of a point: ``kind`` is a numpy type code such as ``f4``."""

    name: str
    offset: int
    kind: str


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """``points`` (n, 3) with label, time (relative to the header stamp) and ring where recorded.

    ``not_finite`` counts the positions with NaN or infinity, ``without_return`` the ones at a range
    that many share, ``unclaimed`` the ones beside width and height; ``remark`` is about the times.
    """

    points: F32
    label: NDArray[np.uint32] | None
    offset_ns: NDArray[np.int64] | None
    ring: NDArray[np.uint16] | None
    not_finite: int = 0
    remark: PointTimeRemark | None = None
    without_return: int = 0
    unclaimed: int = 0


# points at one range, all within so small a share of it, are rays without a return where they are
# so large a share of a sweep: surfaces at just one range are spheres about the sensor
_SAME_RANGE = 1e-5
_WITHOUT_RETURN = 0.05
_WITHIN = 0.1  # the least share below the greatest range: radars have few ranges
_NOTHING_ELSE = 0.95  # and no larger: such clouds are made up
# points of a circle, or of two on floor and ceiling, are this share at least in few slices across
# its axis: so wide (of the range), and so many where the border of two slices cuts each circle
_ON_CIRCLES, _DIRECTION, _SLICES = 0.6, 0.02, 4
# m; coordinates of a measured point lie between these, but for a few and for zeros
_NEAREST, _FARTHEST = 1e-7, 1e7
# shares of coordinates between them, in the wrong order of bytes and in the right one
_NONSENSE, _SENSE = 0.5, 0.95
_LOOKED_AT = 1000  # points
_FEWEST = 100  # points that show what their ranges have in common
# bytes beside the rows hold points where their ranges differ by such factors from the cloud's usual
# in the median, and so many times for nearly all of them
_AS_FAR, _RANGES = 3.0, 100.0


@dataclass(frozen=True, slots=True)
class Layout:
    """``height`` rows of ``width`` points; bytes from point to point and from row to row."""

    width: int
    height: int
    point_step: int
    row_step: int
    big_endian: bool = False


def decode_points(
    data: bytes | memoryview, layout: Layout, fields: Sequence[Field], stamp_ns: int
) -> Points:
    """Points whose position is finite and not exactly zero, and that are not tagged as noise.

    UndecodableError when the layout does not fit the data.
    """
    if layout.width == 0 or layout.height == 0:
        # its fields may be missing too
        return Points(np.empty((0, 3), np.float32), None, None, None)
    _check_places(fields, layout.point_step)
    rows = _in_true_order(_rows(data, layout, fields))
    columns = {name.lower(): name for name in reversed(rows.dtype.names or ())}
    for axis in "xyz":
        if axis not in columns:
            raise UndecodableError(f"it has no field {axis}")
        if rows.dtype[columns[axis]].kind != "f":
            raise UndecodableError(
                f"its field {axis} is {rows.dtype[columns[axis]].name}, not floating point"
            )
    xyz = np.empty((rows.size, 3), np.float32)
    # float64 beyond float32 becomes infinite and is dropped below
    with np.errstate(over="ignore", invalid="ignore"):
        for k, axis in enumerate("xyz"):
            xyz[:, k].reshape(rows.shape)[...] = rows[columns[axis]]
    valid = np.isfinite(xyz[:, 0]) & np.isfinite(xyz[:, 1]) & np.isfinite(xyz[:, 2])
    finite = int(np.count_nonzero(valid))
    valid &= (xyz[:, 0] != 0) | (xyz[:, 1] != 0) | (xyz[:, 2] != 0)
    if {TAG, "line"} <= columns.keys() and rows.dtype[columns[TAG]] == np.uint8:
        valid &= ~is_noise(rows[columns[TAG]].reshape(-1))
    measured = _have_returned(xyz, valid)
    without_return = 0 if measured is None else int(np.count_nonzero(valid & ~measured))
    if measured is not None:
        valid &= measured
    everything = bool(valid.all())

    def column(names: Sequence[str], kinds: str) -> NDArray[np.generic] | None:
        for name in names:
            if name in columns and rows.dtype[columns[name]].kind in kinds:
                values = rows[columns[name]].reshape(-1)
                return values if everything else values[valid]
        return None

    label = column(LABELS, "iu")
    ring = column(RINGS, "iu")
    time = column(TIMES, "iuf")
    offset, remark = _offsets(time, stamp_ns)
    return Points(
        points=xyz if everything else xyz[valid],
        label=None if label is None else label.astype(np.uint32),
        offset_ns=offset,
        ring=None if ring is None else ring.astype(np.uint16),
        not_finite=len(xyz) - finite,
        remark=remark,
        without_return=without_return,
        unclaimed=_unclaimed(data, layout, rows, xyz if everything else xyz[valid]),
    )


def _unclaimed(
    data: bytes | memoryview, layout: Layout, rows: NDArray[np.void], points: F32
) -> int:
    """How many points lie in bytes that width and height leave out; 0 where these are padding.

    ``points`` (n, 3) are the ones that they claim. Rays without a return are none. Bytes whose
    ranges are not like the cloud's are padding.
    """
    row, rest = divmod(rows.strides[0], layout.point_step)
    count = len(data) // layout.point_step
    if rest or count == layout.width * layout.height:  # no whole points behind a row, or none
        return 0
    places = np.arange(count)
    is_claimed = (places // row < layout.height) & (places % row < layout.width)
    others = np.frombuffer(data, rows.dtype, count)[~is_claimed]
    if not len(points):
        return 0
    columns = {name.lower(): name for name in reversed(rows.dtype.names or ())}
    with np.errstate(over="ignore", invalid="ignore"):
        xyz = np.stack([others[columns[axis]].astype(np.float64) for axis in "xyz"], 1)
        xyz = xyz[np.isfinite(xyz).all(1) & xyz.any(1)]
        ranges = np.linalg.norm(xyz, axis=1)
    if len(xyz) < _FEWEST:
        return 0
    own = points[:: max(1, len(points) // _LOOKED_AT)].astype(np.float64)
    usual = float(np.median(np.linalg.norm(own, axis=1)))
    is_point = (ranges > usual / _RANGES) & (ranges < usual * _RANGES)
    middle = float(np.median(ranges[is_point])) if is_point.mean() > _SENSE else 0.0
    return len(xyz) if usual / _AS_FAR < middle < usual * _AS_FAR else 0


def _have_returned(xyz: F32, valid: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    """Which points (n,) of a sensor are measured, where it gives one range to all others.

    None where it does not. Below the greatest range such points have to lie in many directions: a
    ring of a LIDAR on a level floor has one range, too.
    """
    some = xyz[valid][:: max(1, len(xyz) // _LOOKED_AT)].astype(np.float64)
    if len(some) < _FEWEST:
        return None
    ranges = np.linalg.norm(some, axis=1)
    order = np.sort(ranges)
    ends = np.searchsorted(order, order * (1.0 + _SAME_RANGE), side="right")
    best = int(np.argmax(ends - np.arange(len(order))))
    usual = float(order[best])
    for shared in (float(order[-1]), usual):
        is_shared = np.abs(ranges - shared) <= _SAME_RANGE * shared
        share = float(np.mean(is_shared))
        if not _WITHOUT_RETURN <= share <= _NOTHING_ELSE:
            continue
        is_within = shared < float(order[-1])
        if is_within and (share < _WITHIN or not _is_spread(some[is_shared], shared)):
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            distances = np.linalg.norm(xyz.astype(np.float64), axis=1)
            return np.asarray(~(np.abs(distances - shared) <= _SAME_RANGE * shared))
    return None


def _is_spread(points: F64, distance: float) -> bool:
    """Whether points (n, 3) at one ``distance`` lie in many directions, not on a circle or two."""
    _, axes = np.linalg.eigh(np.cov(points.T))
    slices = np.floor(points @ axes / (_DIRECTION * distance)).astype(np.int64)
    for column in slices.T:
        _, counts = np.unique(column, return_counts=True)
        if np.sort(counts)[-_SLICES:].sum() > _ON_CIRCLES * len(points):
            return False
    return True


def is_noise(tag: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Which points (n,) a Livox tags as noise.

    Bits 0 and 1 judge a point by its neighbours, bits 2 and 3 by its intensity: 0 is a normal
    point, 1 and 2 are noise of high and moderate confidence (Livox SDK communication protocol;
    moderate and low confidence of the point itself in the second generation). Bits 4 and 5 are the
    number of the return: all returns are surfaces.
    """
    bits = tag.astype(np.uint8)
    by_place = bits & 3
    by_intensity = (bits >> 2) & 3
    return np.isin(by_place, _NOISE) | np.isin(by_intensity, _NOISE)


def _offsets(
    time: NDArray[np.generic] | None, stamp_ns: int
) -> tuple[NDArray[np.int64] | None, PointTimeRemark | None]:
    """Times relative to ``stamp_ns`` where they make sense, and a remark where they are unusual."""
    if time is None:
        return None, None
    offset, is_other_clock = offsets_ns(time, stamp_ns)
    if offset is None:
        return None, PointTimeRemark.UNUSABLE
    return offset, PointTimeRemark.OTHER_CLOCK if is_other_clock else None


def _check_places(fields: Sequence[Field], point_step: int) -> None:
    """UndecodableError where coordinates lie beyond a point, or in one another."""
    axes: dict[str, tuple[int, int]] = {}
    for field in fields:
        name = field.name.lower()
        end = field.offset + np.dtype(field.kind).itemsize
        if name in ("x", "y", "z"):
            if end > point_step:
                raise UndecodableError(
                    f"its field {field.name} ends at byte {end}, but a point has {point_step} bytes"
                )
            axes.setdefault(name, (field.offset, end))
    placed = sorted(axes, key=lambda axis: axes[axis])
    for name, other in pairwise(placed):
        if axes[other][0] < axes[name][1]:
            raise UndecodableError(
                f"its fields {name} and {other} share bytes: an offset or a type is wrong"
            )


def _rows(data: bytes | memoryview, layout: Layout, fields: Sequence[Field]) -> NDArray[np.void]:
    """A view (height, width) of the points as records."""
    width = layout.width
    height = layout.height
    step = layout.point_step
    row = layout.row_step
    if height <= 1 or row < width * step:
        row = width * step  # often left at zero, or wrong where it does not matter
    needed = (height - 1) * row + width * step
    if step <= 0 or needed > len(data):
        raise UndecodableError(
            f"{width} x {height} points of {step} bytes need {needed} bytes, but it has {len(data)}"
        )
    names: dict[str, Field] = {}
    for field in fields:
        end = field.offset + np.dtype(field.kind).itemsize
        if field.name.lower() in _USED and field.offset >= 0 and end <= step:
            names.setdefault(field.name, field)
    order = ">" if layout.big_endian else "<"
    dtype = np.dtype(
        {
            "names": list(names),
            "formats": [order + f.kind for f in names.values()],
            "offsets": [f.offset for f in names.values()],
            "itemsize": step,
        }
    )
    return np.ndarray((height, width), dtype, buffer=data, strides=(row, step))


def _in_true_order(rows: NDArray[np.void]) -> NDArray[np.void]:
    """The same bytes in the order of bytes that makes sense.

    Writers fill in the flag for the order of bytes wrongly: floats read in the other order than
    they were written are tiny, huge or no numbers. A few points do not tell.
    """
    swapped = rows.view(rows.dtype.newbyteorder())
    if rows.size >= _FEWEST and _sense(rows) < _NONSENSE and _sense(swapped) > _SENSE:
        return swapped
    return rows


def _sense(rows: NDArray[np.void]) -> float:
    """The share of floating-point coordinates that are distances; 1 without any."""
    floats = [
        name
        for name in rows.dtype.names or ()
        if name.lower() in ("x", "y", "z") and rows.dtype[name].kind == "f"
    ]
    shares = []
    for name in floats:
        some = rows[name].ravel()[:: max(1, rows.size // _LOOKED_AT)]
        with np.errstate(invalid="ignore"):  # bytes in the wrong order are any number
            sizes = np.abs(some.astype(np.float64))
        sizes = sizes[np.isfinite(sizes) & (sizes > 0)]
        if len(sizes):
            shares.append(float(np.mean((sizes > _NEAREST) & (sizes < _FARTHEST))))
    return min(shares, default=1.0)

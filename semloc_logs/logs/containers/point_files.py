"""Points of PCD, PLY, LAS and LAZ files, thinned while they are read.

PCD: the format of the Point Cloud Library, version 0.7. PLY: Turk 1994, vertices alone. LAS 1.0 to
1.4 and LAZ by laspy (extra ``las``).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import F64, I64, U8, U32
from semloc_logs.errors import LogError
from semloc_logs.logs.containers.memory import Memory
from semloc_logs.logs.messages.point_fields import LABELS

Rows = Iterator[tuple[F64, U32 | None]]
THIN = 0.1  # m: one point is kept of each cube of this edge
BATCH = 1 << 20  # points that are read at once
HEADER = 1 << 16  # bytes; a longer header is damage
POINT_BYTES = 36  # of a kept point: coordinates, label, key
_CELL_BITS = 21  # of each axis of a cube's key
_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
PCD_MAGIC = (b"# .PCD", b"VERSION", b"FIELDS")
PLY_MAGIC = (b"ply\n", b"ply\r")
LAS_MAGIC = b"LASF"
OWN_LABELS = b"label = Cityscapes train id"  # in the header of our own PLY and PCD files
TRAIN_ID = "train_id"  # the dimension of Cityscapes train ids that our own LAS files have


@dataclass(frozen=True, slots=True, eq=False)
class MapPoints:
    """Points ``xyz`` (n, 3), metres, in the order of their cubes, with ``label`` (n,) if recorded.

    ``skipped`` points had no finite coordinates. ``label_space`` is "" where the file leaves it
    open.
    """

    xyz: F64
    label: U32 | None
    skipped: int
    label_space: str = ""


def is_point_file(head: bytes) -> bool:
    """Whether a file that starts with ``head`` is one of points."""
    return head.startswith((*PCD_MAGIC, *PLY_MAGIC, LAS_MAGIC))


def read_points(path: Path, memory: Memory) -> MapPoints:
    """The points of a file, one of each cube of ``THIN`` metres.

    LogError for a damaged file, and for more points than fit into ``memory``.
    """
    try:
        with path.open("rb") as file:
            head = file.read(HEADER)
            file.seek(0)
            if head.startswith(LAS_MAGIC):
                rows = _las_rows(path)
            else:
                is_ply = head.startswith(PLY_MAGIC)
                rows = _ply_rows(file) if is_ply else _pcd_rows(file, memory)
            points = _thinned(rows, memory)
            ours = head.startswith(LAS_MAGIC) or OWN_LABELS in head
            return replace(points, label_space="cityscapes") if ours else points
    except (OSError, ValueError, LogError) as error:
        raise LogError(f"{path} cannot be read as a map of points: {error}") from error


def _thinned(rows: Rows, memory: Memory) -> MapPoints:
    """The first point of each cube; cubes are counted from the first point, which stays exact."""
    keys = np.zeros(0, np.int64)
    xyz = np.zeros((0, 3))
    label: U32 | None = None
    origin: F64 | None = None
    skipped = 0
    for batch, labels in rows:
        finite = np.isfinite(batch).all(1)
        skipped += int((~finite).sum())
        batch = batch[finite]
        if not len(batch):
            continue
        origin = np.floor(batch[0]) if origin is None else origin
        new = _keys(batch - origin)
        if labels is not None:
            label = np.zeros(0, np.uint32) if label is None else label
            label = np.concatenate([label, labels[finite]])
        # of equal keys the first one
        keys, first = np.unique(np.concatenate([keys, new]), return_index=True)
        xyz = np.concatenate([xyz, batch])[first]
        label = None if label is None else label[first]
        if len(keys) * POINT_BYTES > memory.limit // 2:
            raise LogError(
                f"more than {len(keys)} cubes of {THIN} m hold points: cut the map into parts, or"
                " set logs.memory to more."
            )
    if not len(keys):
        raise LogError("it holds no points.")
    return MapPoints(xyz, label, skipped)


def _keys(points: F64) -> I64:
    cell = np.floor(points / THIN).astype(np.int64) + (1 << (_CELL_BITS - 1))
    if cell.min() < 0 or cell.max() >= 1 << _CELL_BITS:
        extent = (1 << (_CELL_BITS - 1)) * THIN / 1000
        raise LogError(
            f"its points lie more than {extent:.0f} km apart: remove those that are far outside."
        )
    return np.asarray((cell[:, 0] << _CELL_BITS | cell[:, 1]) << _CELL_BITS | cell[:, 2])


def _columns(record: NDArray[Any]) -> tuple[F64, U32 | None]:
    """Coordinates and labels of structured rows."""
    names = record.dtype.names or ()
    by_name = {name.lower(): name for name in names}
    if not {"x", "y", "z"} <= by_name.keys():
        raise LogError(f"its points have no x, y, z but {', '.join(names)}.")
    xyz = np.stack([record[by_name[c]].astype(float) for c in "xyz"], 1)
    name = next((by_name[n] for n in LABELS if n in by_name), None)
    if name is None or record[name].dtype.kind not in "iu":
        return xyz, None
    return xyz, record[name].astype(np.uint32)


# -- PCD


def _pcd_rows(file: BinaryIO, memory: Memory) -> Rows:
    header = _pcd_header(file)
    try:
        fields = header["FIELDS"]
        counts = [int(c) for c in header.get("COUNT", ["1"] * len(fields))]
        kinds = [
            f"<{t.lower()}{int(size)}"
            for t, size in zip(header["TYPE"], header["SIZE"], strict=True)
        ]
        form = header["DATA"][0]
        points = int(header.get("POINTS", ["-1"])[0])
        if points < 0:
            points = int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
        dtype = np.dtype(
            [
                # padding fields are all called _
                (f"{name}{i}" if name == "_" else name, kind, (count,) if count != 1 else ())
                for i, (name, kind, count) in enumerate(zip(fields, kinds, counts, strict=True))
            ]
        )
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise LogError(f"its header is damaged ({error}).") from error
    if form == "binary":
        yield from _binary_rows(file, dtype, points)
    elif form == "ascii":
        yield from _text_rows(file, dtype, points)
    elif form == "binary_compressed":
        yield _compressed(file, dtype, points, memory)
    else:
        raise LogError(f"its data are {form!r}: ascii, binary and binary_compressed are known.")


def _pcd_header(file: BinaryIO) -> dict[str, list[str]]:
    header: dict[str, list[str]] = {}
    while "DATA" not in header:
        line = file.readline(HEADER)
        if not line or file.tell() > HEADER:
            raise LogError("its header has no end.")
        words = line.decode("ascii", "replace").split("#", 1)[0].split()
        if words:
            header[words[0].upper()] = words[1:]
    return header


def _compressed(
    file: BinaryIO, dtype: np.dtype[Any], points: int, memory: Memory
) -> tuple[F64, U32 | None]:
    """LZF, column by column."""
    sizes = file.read(8)
    if len(sizes) < 8:
        raise LogError("it is cut off before its points.")
    packed, plain = struct.unpack("<II", sizes)
    if plain != points * dtype.itemsize:
        raise LogError(f"it claims {plain} bytes for {points} points of {dtype.itemsize}.")
    memory.check(plain)
    data = file.read(packed)
    if len(data) < packed:
        raise LogError("it is cut off within its points.")
    out = np.zeros(plain, np.uint8)
    if _unpack_lzf(np.frombuffer(data, np.uint8), out) != plain:
        raise LogError("its compressed points are damaged.")
    record = np.zeros(points, dtype)
    start = 0
    for name in dtype.names or ():
        size = dtype[name].itemsize
        column = out[start : start + size * points]
        record[name] = column.view(dtype[name].base).reshape(record[name].shape)
        start += size * points
    return _columns(record)


@njit(cache=True, nogil=True)
def _unpack_lzf(data: U8, out: U8) -> int:
    """Bytes unpacked into ``out``, -1 for damage (LibLZF, Lehmann 2000 to 2008)."""
    i = np.int64(0)
    n = np.int64(0)
    while i < len(data):
        control = np.int64(data[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > len(data) or n + length > len(out):
                return -1
            out[n : n + length] = data[i : i + length]
            i += length
            n += length
            continue
        length = control >> 5
        if length == 7:
            if i >= len(data):
                return -1
            length += np.int64(data[i])
            i += 1
        if i >= len(data):
            return -1
        back = n - ((control & 31) << 8) - np.int64(data[i]) - 1
        i += 1
        length += 2
        if back < 0 or n + length > len(out):
            return -1
        for k in range(length):
            out[n + k] = out[back + k]
        n += length
    return int(n)


# -- PLY


def _ply_rows(file: BinaryIO) -> Rows:
    form, points, dtype = _ply_header(file)
    if form == "ascii":
        return _text_rows(file, dtype, points)
    return _binary_rows(file, dtype, points)


def _ply_header(file: BinaryIO) -> tuple[str, int, np.dtype[Any]]:
    """Form, number and fields of the vertices, which come first."""
    form = ""
    points = -1
    properties: list[tuple[str, str]] = []
    in_vertices = False
    while True:
        line = file.readline(HEADER)
        if not line or file.tell() > HEADER:
            raise LogError("its header has no end.")
        words = line.decode("ascii", "replace").split()
        try:
            if words[:1] == ["format"]:
                form = words[1]
            elif words[:1] == ["element"]:
                in_vertices = words[1] == "vertex"
                if in_vertices:
                    points = int(words[2])
                elif points < 0:
                    raise LogError(f"{words[1]} elements come before the vertices.")
            elif words[:1] == ["property"] and in_vertices:
                if words[1] == "list":
                    raise LogError("its vertices have lists.")
                properties.append((words[2], _PLY_TYPES[words[1]]))
            elif words[:1] == ["end_header"]:
                order = _PLY_ORDERS[form]
                return form, points, np.dtype([(n, order + kind) for n, kind in properties])
        except (IndexError, KeyError, ValueError) as error:
            raise LogError(f"its header is damaged ({line[:60]!r}).") from error


# -- LAS


def _las_rows(path: Path) -> Rows:
    """ASPRS classes do not tell a road from grass, so only our own classes count as labels."""
    try:
        import laspy
    except ImportError:
        raise LogError(
            "LAS needs the package laspy, which is not installed: run"
            " pip install 'semloc_logs[las]'."
        ) from None
    try:
        with laspy.open(path) as file:
            for points in file.chunk_iterator(BATCH):
                xyz = np.stack([np.asarray(points[c], float) for c in "xyz"], 1)
                has_ids = TRAIN_ID in points.point_format.dimension_names
                yield xyz, np.asarray(points[TRAIN_ID], np.uint32) if has_ids else None
    except (laspy.errors.LaspyException, RuntimeError, struct.error) as error:
        raise LogError(f"{error}.") from error


# -- rows


def _binary_rows(file: BinaryIO, dtype: np.dtype[Any], points: int) -> Rows:
    if dtype.itemsize == 0 or points < 0:
        raise LogError("its header gives points without fields, or no number of points.")
    for first in range(0, points, BATCH):
        count = min(BATCH, points - first)
        data = file.read(count * dtype.itemsize)
        if len(data) < count * dtype.itemsize:
            whole = first + len(data) // dtype.itemsize
            raise LogError(f"it is cut off after {whole} of {points} points.")
        yield _columns(np.frombuffer(data, dtype))


def _text_rows(file: BinaryIO, dtype: np.dtype[Any], points: int) -> Rows:
    single = [dtype[name].shape == () for name in dtype.names or ()]
    if not all(single):
        raise LogError("its fields have several numbers each, which are read from binary files.")
    for first in range(0, points, BATCH):
        count = min(BATCH, points - first)
        lines = [file.readline(HEADER).split() for _ in range(count)]
        short = next((i for i, words in enumerate(lines) if len(words) < len(single)), None)
        if short is not None:
            raise LogError(f"point {first + short} of {points} has too few numbers.")
        yield _columns(_parsed(lines, dtype))


def _parsed(lines: Sequence[Sequence[bytes]], dtype: np.dtype[Any]) -> NDArray[Any]:
    record = np.zeros(len(lines), dtype)
    for column, name in enumerate(dtype.names or ()):
        as_number: Callable[[bytes], float] = float if dtype[name].kind == "f" else int
        record[name] = [as_number(words[column]) for words in lines]
    return record

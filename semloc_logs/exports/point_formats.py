"""Point clouds as files: PLY, PCD, LAS and LAZ, XYZ text.

Written batch by batch, so memory does not grow with the map.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import semloc_logs
from semloc_logs.arrays import F64, U8
from semloc_logs.errors import SemlocError, WorkspaceError
from semloc_logs.exports.map_points import SessionPoints
from semloc_logs.labels.space import BUILDING, GROUND, UNLABELLED, VEGETATION, cityscapes

Batches = Iterator[tuple[F64, U8]]
LAS_SCALE = 0.001  # metres
LAS_ROWS = 1 << 20  # laspy and lazrs write so many points at once


def point_colours() -> U8:
    """RGB (256, 3) of train ids, as Cityscapes defines them; grey where unlabelled."""
    table = np.full((256, 3), 128, np.uint8)
    table[: len(cityscapes().colours)] = cityscapes().colours
    return table


def asprs_classes() -> U8:
    """ASPRS standard classes (256,) of train ids (LAS 1.4 R15, table 17).

    2 ground (road, sidewalk, terrain), 5 high vegetation, 6 building, 1 unclassified where
    unlabelled. The standard lacks the other classes: they get 64 + train id, which it leaves to
    users.
    """
    table = np.full(256, 1, np.uint8)
    known = np.arange(len(cityscapes().names))
    table[known] = 64 + known
    table[list(GROUND)] = 2
    table[VEGETATION] = 5
    table[BUILDING] = 6
    table[UNLABELLED] = 1
    return table


def write_ply(path: Path, points: SessionPoints) -> None:
    """Binary PLY: x y z (m), red green blue, label (train id).

    Coordinates are doubles where floats would be too coarse.
    """
    real, size = ("float", "<f4") if points.fits_float32 else ("double", "<f8")
    fields = np.dtype(
        [*((c, size) for c in "xyz"), *((c, "u1") for c in ("red", "green", "blue", "label"))]
    )
    kinds = {
        **dict.fromkeys("xyz", real),
        **dict.fromkeys(("red", "green", "blue", "label"), "uchar"),
    }
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {_comment(points)}",
        f"element vertex {points.count()}",
    ]
    head += [f"property {kind} {name}" for name, kind in kinds.items()]
    colours = point_colours()

    def rows() -> Iterator[NDArray[Any]]:
        for xyz, label in points.batches():
            out = np.empty(len(label), fields)
            out["x"], out["y"], out["z"] = xyz.T
            out["red"], out["green"], out["blue"] = colours[label].T
            out["label"] = label
            yield out

    _binary(path, "\n".join([*head, "end_header\n"]), rows(), points.count())


def write_pcd(path: Path, points: SessionPoints) -> None:
    """Binary PCD v0.7 with the fields of PCL's PointXYZRGBL.

    x y z (m), label (train id, uint32), rgb (0x00RRGGBB in the bits of a float). Raises
    WorkspaceError where 32-bit coordinates, the only ones that PCL's points have, are too coarse.
    """
    if not points.fits_float32:
        raise WorkspaceError(
            f"Session {points.session.folder.name} lies so far from the origin of its frame that "
            f"the 32-bit coordinates of a PCD are {points.float32_step:g} m apart: "
            "use --frame map, or --format las."
        )
    fields = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("label", "<u4"), ("rgb", "<u4")])
    count = points.count()
    head = f"""# .PCD v0.7 - Point Cloud Data file format
# {_comment(points)}
VERSION 0.7
FIELDS x y z label rgb
SIZE 4 4 4 4 4
TYPE F F F U F
COUNT 1 1 1 1 1
WIDTH {count}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {count}
DATA binary
"""
    packed = point_colours().astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)

    def rows() -> Iterator[NDArray[Any]]:
        for xyz, label in points.batches():
            out = np.empty(len(label), fields)
            out["x"], out["y"], out["z"] = xyz.T
            out["label"] = label
            out["rgb"] = packed[label]
            yield out

    _binary(path, head, rows(), count)


def write_las(path: Path, points: SessionPoints) -> None:
    """LAS 1.4, point format 7; LAZ where ``path`` ends in .laz.

    Coordinates to the millimetre, RGB, ASPRS classes, and the train id in the extra dimension
    ``train_id`` (255 unlabelled). Raises SemlocError when laspy, or lazrs for LAZ, is not
    installed.
    """
    laspy = _laspy(path.suffix == ".laz")
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.add_extra_dim(
        laspy.ExtraBytesParams(
            name="train_id", type=np.uint8, description="Cityscapes, 255 unlabelled"
        )
    )
    header.scales = np.full(3, LAS_SCALE)
    header.offsets = points.origin
    header.creation_date = points.day  # and not today, so that the same map gives the same file
    header.generating_software = f"semloc_logs {semloc_logs.__version__}"[:32]
    # point formats from 6 on require it; without a WKT record the frame is a local one
    header.global_encoding.wkt = True
    zone = None if points.common is None else points.common.zone
    if zone is not None:
        from laspy.vlrs.known import WktCoordinateSystemVlr

        header.vlrs.append(WktCoordinateSystemVlr(zone.wkt()))
    colours = point_colours().astype(np.uint16) * 257
    classes = asprs_classes()
    with laspy.open(path, mode="w", header=header, do_compress=path.suffix == ".laz") as file:
        for xyz, label in _joined(points.batches()):
            out = laspy.ScaleAwarePointRecord.zeros(len(label), header=header)
            out.x, out.y, out.z = xyz.T
            out.red, out.green, out.blue = colours[label].T
            out.classification = classes[label]
            out.train_id = label
            out.return_number[:] = out.number_of_returns[:] = 1
            file.write_points(out)


def _laspy(compressed: bool) -> Any:
    try:
        import laspy

        if compressed:
            import lazrs  # noqa: F401
    except ImportError as problem:
        form = "LAZ" if compressed else "LAS"
        raise SemlocError(
            f"{form} needs the package {problem.name}, which is not installed: "
            "run pip install 'semloc_logs[las]'."
        ) from None
    return laspy


def _joined(batches: Batches) -> Batches:
    """Small batches put together to about LAS_ROWS."""
    held: list[tuple[F64, U8]] = []
    for batch in batches:
        held.append(batch)
        if sum(len(label) for _, label in held) >= LAS_ROWS:
            yield np.concatenate([b[0] for b in held]), np.concatenate([b[1] for b in held])
            held = []
    if held:
        yield np.concatenate([b[0] for b in held]), np.concatenate([b[1] for b in held])


def write_xyz(path: Path, points: SessionPoints) -> None:
    """Text, a line a point: x y z in metres to a tenth of a millimetre, train id; no header."""
    import pyarrow as pa
    from pyarrow import csv

    options = csv.WriteOptions(include_header=False, delimiter=" ")
    with path.open("wb") as file:
        for xyz, label in points.batches():
            rounded = np.round(xyz, 4) + 0.0  # no -0
            columns = {**dict(zip("xyz", rounded.T.copy(), strict=True)), "label": label}
            csv.write_csv(pa.table(columns), file, options)


def _comment(points: SessionPoints) -> str:
    name = " ".join(points.session.folder.name.split())
    return (
        f"semloc_logs {semloc_logs.__version__}: {points.what} of session {name}, "
        f"{points.frame} frame, metres, label = Cityscapes train id"
    )


def _binary(path: Path, head: str, rows: Iterator[NDArray[Any]], count: int) -> None:
    """Write header and rows; WorkspaceError when they are not as many as the header gives."""
    written = 0
    with path.open("wb") as file:
        file.write(head.encode())
        for batch in rows:
            file.write(batch.tobytes())
            written += len(batch)
    if written != count:
        raise WorkspaceError(
            f"The map changed while it was exported ({written} points instead of {count}): "
            "export it again."
        )

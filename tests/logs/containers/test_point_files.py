"""Points of PCD, PLY and LAS files, written by hand and by other programs."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semloc_logs.errors import LogError
from semloc_logs.logs.containers.memory import Memory
from semloc_logs.logs.containers.point_files import (
    OWN_LABELS,
    THIN,
    _unpack_lzf,
    is_point_file,
    read_points,
)

POINTS = [(0.0, 0.0, 0.0, 7), (1.5, -2.0, 0.25, 8), (-3.0, 4.0, 12.5, 9)]


def pcd(form: str, body: bytes, fields: str = "x y z label", types: str = "F F F U") -> bytes:
    count = len(fields.split())
    return (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {fields}\nSIZE {' '.join(['4'] * count)}\nTYPE {types}\n"
        f"COUNT {' '.join(['1'] * count)}\nWIDTH 3\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS 3\nDATA {form}\n"
    ).encode() + body


def ply(form: str, body: bytes) -> bytes:
    return (
        f"ply\nformat {form} 1.0\ncomment by hand\nelement vertex 3\nproperty float x\n"
        "property float y\nproperty float z\nproperty uint label\nelement face 0\n"
        "property list uchar int vertex_indices\nend_header\n"
    ).encode() + body


def literal_lzf(data: bytes) -> bytes:
    """LZF without any reference back: runs of at most 32 bytes."""
    runs = [data[i : i + 32] for i in range(0, len(data), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


TEXT = b"".join(b"%r %r %r %d\n" % point for point in POINTS)
ROWS = b"".join(struct.pack("<fffI", *point) for point in POINTS)
COLUMNS = b"".join(
    struct.pack("<3I" if k == 3 else "<3f", *(point[k] for point in POINTS)) for k in range(4)
)
COMPRESSED = literal_lzf(COLUMNS)
FILES = {
    "text": pcd("ascii", TEXT),
    "binary": pcd("binary", ROWS),
    "compressed": pcd(
        "binary_compressed", struct.pack("<II", len(COMPRESSED), len(COLUMNS)) + COMPRESSED
    ),
    "ply text": ply("ascii", TEXT),
    "ply": ply("binary_little_endian", ROWS),
    "ply big": ply("binary_big_endian", b"".join(struct.pack(">fffI", *point) for point in POINTS)),
}


def read(path: Path, content: bytes, memory: Memory | None = None) -> Any:
    path.write_bytes(content)
    return read_points(path, memory or Memory())


def by_label(points: Any) -> list[tuple[float, float, float, int]]:
    rows = zip(points.xyz.tolist(), points.label.tolist(), strict=True)
    return sorted(((*xyz, label) for xyz, label in rows), key=lambda row: row[3])


@pytest.mark.parametrize("name", FILES)
def test_points_and_labels_are_read(tmp_path: Path, name: str) -> None:
    points = read(tmp_path / "map", FILES[name])
    assert by_label(points) == POINTS
    assert points.skipped == 0
    assert points.label_space == ""
    assert is_point_file(FILES[name])


def test_las_of_laspy_has_no_labels_but_our_own(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = [0.01] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = (np.array([point[k] for point in POINTS]) for k in range(3))
    las.classification = [2, 6, 5]
    las.write(tmp_path / "map.las")
    points = read_points(tmp_path / "map.las", Memory())
    assert points.label is None
    assert sorted(map(tuple, points.xyz.tolist())) == sorted(point[:3] for point in POINTS)

    las.add_extra_dim(laspy.ExtraBytesParams("train_id", "uint8"))
    las.train_id = [7, 8, 9]
    las.write(tmp_path / "own.las")
    own = read_points(tmp_path / "own.las", Memory())
    assert by_label(own) == POINTS
    assert own.label_space == "cityscapes"


def test_our_own_files_say_which_labels_they_have(tmp_path: Path) -> None:
    content = FILES["binary"].replace(b"# .PCD v0.7", b"# .PCD v0.7 " + OWN_LABELS, 1)
    assert read(tmp_path / "map.pcd", content).label_space == "cityscapes"


def test_one_point_of_a_cube_is_kept(tmp_path: Path) -> None:
    points = [(0.01, 0.01, 0.01), (0.05, 0.02, 0.09), (THIN + 0.01, 0.01, 0.01)]
    body = b"".join(struct.pack("<fff", *point) for point in points)
    kept = read(tmp_path / "map.pcd", pcd("binary", body, "x y z", "F F F")).xyz
    np.testing.assert_array_equal(kept, np.float32(np.array(points)[[0, 2]]))


def test_points_that_are_not_numbers_are_counted(tmp_path: Path) -> None:
    points = [(0.0, 0.0, 0.0), (np.nan, 0.0, 0.0), (1.0, np.inf, 0.0)]
    body = b"".join(struct.pack("<fff", *point) for point in points)
    read_map = read(tmp_path / "map.pcd", pcd("binary", body, "x y z", "F F F"))
    assert read_map.skipped == 2
    assert len(read_map.xyz) == 1


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (FILES["binary"][:-20], "cut off after 1 of 3 points"),
        (FILES["ply"][:-1], "cut off after 2 of 3 points"),
        (FILES["text"][:-8], "point 2 of 3 has too few numbers"),
        (FILES["compressed"][:-1], "cut off within its points"),
        (FILES["binary"].replace(b"DATA binary", b"DATA other!"), "its data are 'other!'"),
        (FILES["binary"].split(b"DATA")[0], "header has no end"),
        (FILES["binary"].replace(b"TYPE F F F U", b"TYPE F F F Q"), "header is damaged"),
        (FILES["binary"].replace(b"FIELDS x y z", b"FIELDS a b c"), "no x, y, z but a, b, c"),
        (FILES["binary"].replace(b"POINTS 3", b"POINTS 0"), "holds no points"),
        (FILES["ply"].replace(b"property float x", b"property real x"), "header is damaged"),
        (FILES["ply"].replace(b"float x", b"list uchar int x"), "its vertices have lists"),
    ],
)
def test_damage_is_one_sentence(tmp_path: Path, content: bytes, sentence: str) -> None:
    path = tmp_path / "map.pcd"
    with pytest.raises(LogError, match=sentence) as caught:
        read(path, content)
    assert str(path) in str(caught.value)


def test_compressed_points_that_claim_too_much_are_refused(tmp_path: Path) -> None:
    huge = FILES["compressed"].replace(b"POINTS 3", b"POINTS 99999999")
    start = huge.index(b"DATA binary_compressed\n") + len(b"DATA binary_compressed\n")
    body = struct.pack("<II", 8, 16 * 99_999_999) + huge[start + 8 :]
    with pytest.raises(LogError, match="claims 1599999984 bytes, and at most"):
        read(tmp_path / "map.pcd", huge[:start] + body)


def test_a_map_that_does_not_fit_into_memory_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"logs\.memory"):
        read(tmp_path / "map.pcd", FILES["binary"], Memory(100))


@given(st.binary(max_size=200), st.integers(0, 300))
def test_damaged_lzf_never_leaves_its_room(data: bytes, size: int) -> None:
    out = np.zeros(size, np.uint8)
    assert -1 <= _unpack_lzf(np.frombuffer(data, np.uint8), out) <= size


def test_lzf_refers_back() -> None:
    # "ab", then 6 bytes from 2 back: control 4 << 5 (length 4 + 2), distance 2 - 1
    packed = np.frombuffer(b"\x01ab" + bytes([4 << 5, 1]), np.uint8)
    out = np.zeros(8, np.uint8)
    assert _unpack_lzf(packed, out) == 8
    assert out.tobytes() == b"abababab"

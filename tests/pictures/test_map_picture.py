"""Pictures of small maps made by hand: which colour is where, and how large a picture may get."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.pictures.canvas import Canvas
from semloc_logs.pictures.colours import class_colours, class_legend
from semloc_logs.pictures.map_picture import LARGE_MAP, Caption, draw_map
from semloc_logs.tables import contracts
from semloc_logs.tables.table import write_table


def write(folder: Path, ijk: NDArray[np.integer], label: NDArray[np.integer]) -> Path:
    """Tiles of 256 voxels."""
    for n, tile in enumerate(np.unique(ijk[:, :2] // 256, axis=0)):
        of = (ijk[:, :2] // 256 == tile).all(1)
        columns = dict(zip(("ix", "iy", "iz"), ijk[of].T, strict=True)) | {
            "label": label[of],
            "occupancy": np.ones(of.sum()),
            "hits": np.ones(of.sum(), int),
        }
        write_table(
            folder / f"voxels/tile={n}/part-0.parquet", contracts.table("voxels", columns), {}
        )
    return folder / "voxels"


def drawn(path: Path) -> NDArray[np.uint8]:
    """RGB."""
    image = cv2.imread(str(path))
    assert image is not None
    return np.asarray(image[:, :, ::-1], np.uint8)


def box(low: tuple[int, int, int], high: tuple[int, int, int]) -> NDArray[np.int64]:
    return np.stack(
        np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)), indexing="ij"), -1
    ).reshape(-1, 3)


def floor_and_block(ceiling: bool) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """40 x 20 voxels of road at z = 0, vegetation on its left third up to z = 2, and perhaps a
    ceiling at z = 9.
    """
    parts = [(box((0, 0, 0), (40, 20, 1)), 0), (box((0, 0, 1), (13, 20, 3)), 8)]
    if ceiling:
        parts.append((box((0, 0, 9), (40, 20, 10)), 2))
    return np.concatenate([p for p, _ in parts]), np.concatenate(
        [np.full(len(p), c) for p, c in parts]
    )


DRIVE = np.array([[4.0, 2.0, 0.9], [16.0, 2.0, 0.9]])  # along x, 0.5 m voxels


def share(image: NDArray[np.uint8], label: int) -> float:
    """Of the pixels that are any class of the three, the share that is near the colour of ``label``
    in hue.
    """

    def direction(colour: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(colour / np.maximum(np.linalg.norm(colour, axis=-1, keepdims=True), 1))

    pixels = image.reshape(-1, 3).astype(float)
    pixels = pixels[(pixels < 245).any(1) & (pixels > 60).any(1)]
    names = (0, 2, 8)
    nearest = np.argmax(
        direction(pixels)
        @ np.stack([direction(class_colours()[c].astype(float)) for c in names]).T,
        1,
    )
    return float(np.mean(nearest == names.index(label)))


def test_the_highest_voxel_shows_and_the_lowest_class_id_among_equals() -> None:
    canvas = Canvas.over(np.array([0, 0]), np.array([4, 2]), 1)
    canvas.add(np.array([[0, 0, 5], [0, 0, 3], [1, 0, 2]], np.int32), np.array([2, 8, 0], np.uint8))
    canvas.add(
        np.array([[0, 0, 5], [3, 1, -7], [4, 0, 0], [-1, 0, 0]], np.int32),
        np.array([8, 13, 1, 1], np.uint8),
    )
    assert canvas.top[1].tolist()[:2] == [5, 2]
    assert canvas.label.tolist() == [[255, 255, 255, 13], [2, 0, 255, 255]]  # y points up
    assert canvas.seen.tolist() == [[False, False, False, True], [True, True, False, False]]
    names = [name for name, _ in class_legend(canvas.label[canvas.seen])]
    assert names == ["road", "building", "car"]
    assert (canvas.image()[~canvas.seen] == 255).all()
    assert (canvas.image()[canvas.seen] < 255).all()


def test_tiles_in_any_order_give_the_same_picture() -> None:
    rng = np.random.default_rng(0)
    ijk = rng.integers(0, 20, (2000, 3)).astype(np.int32)
    label = rng.integers(0, 19, 2000).astype(np.uint8)
    a, b = (Canvas.over(np.zeros(2, np.int64), np.full(2, 20), 3) for _ in "ab")
    a.add(ijk, label)
    for part in np.array_split(rng.permutation(2000), 7):
        b.add(ijk[part], label[part])
    np.testing.assert_array_equal(a.top, b.top)
    np.testing.assert_array_equal(a.label, b.label)


def test_a_ceiling_over_the_drive_is_left_out(tmp_path: Path) -> None:
    shares = []
    for name, ceiling, drive in (
        ("open", False, DRIVE),
        ("roofed", True, DRIVE),
        ("nobody", True, DRIVE[:0]),
    ):
        path = tmp_path / f"{name}.png"
        draw_map(
            write(tmp_path / name, *floor_and_block(ceiling)),
            drive,
            Caption(name, "log", 0.5),
            path,
        )
        shares.append([share(drawn(path), label) for label in (2, 8)])
    assert shares[0][1] > 0.25
    assert shares[1][1] == pytest.approx(shares[0][1], abs=0.05)  # as without the ceiling
    assert shares[2][1] < 0.05  # without a drive nobody knows where a roof begins
    assert shares[2][0] > 0.8


def test_the_picture_of_a_long_drive_is_bounded(tmp_path: Path) -> None:
    ijk = np.stack([np.arange(0, 40_000, 7), np.zeros(5715, int), np.zeros(5715, int)], 1)
    drive = np.stack([np.linspace(0, 12_000, 50), np.zeros(50), np.ones(50)], 1)
    draw_map(
        write(tmp_path, ijk, np.zeros(len(ijk), int)),
        drive,
        Caption("a long drive", "geometry", 0.3),
        tmp_path / "map.png",
    )
    height, width, _ = drawn(tmp_path / "map.png").shape
    assert LARGE_MAP < width < 1.2 * LARGE_MAP
    assert height < LARGE_MAP


@pytest.mark.parametrize("drive", [np.zeros((0, 3)), np.zeros((1, 3)), np.zeros((5, 3)), DRIVE])
@pytest.mark.parametrize("voxels", [0, 1])
def test_pictures_of_next_to_nothing(
    voxels: int, drive: NDArray[np.float64], tmp_path: Path
) -> None:
    ijk = np.zeros((voxels, 3), int)
    folder = write(tmp_path, ijk, np.full(voxels, 255)) if voxels else tmp_path
    draw_map(folder, drive, Caption("Straße 5", "uniform", 0.3), tmp_path / "map.png")
    image = drawn(tmp_path / "map.png")
    assert min(image.shape[:2]) > 100
    assert (image < 128).any()


def test_the_same_map_gives_the_same_picture(tmp_path: Path) -> None:
    folder = write(tmp_path, *floor_and_block(True))
    for name in ("a", "b"):
        draw_map(folder, DRIVE, Caption("one", "log", 0.5), tmp_path / f"{name}.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()

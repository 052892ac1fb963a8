from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.pictures.solids import Solid, View, draw_solids, top_view

RED = np.array([[200, 0, 0]], np.uint8)
BLUE = np.array([[0, 0, 200]], np.uint8)


def cube(
    ijk: tuple[int, int, int], rgb: np.ndarray = RED, size: float = 1.0, yaw: float = 0.0
) -> Solid:
    return Solid(np.array([ijk], np.int32), rgb, size, yaw_transform(yaw))


def coloured(image: np.ndarray, channel: int) -> np.ndarray:
    """Pixels (n, 2) x, y whose ``channel`` leads."""
    others = [c for c in range(3) if c != channel]
    lead = image[..., channel].astype(int) - image[..., others].max(2)
    return np.argwhere(lead > 50)[:, ::-1]


def test_a_voxel_from_above_covers_its_place() -> None:
    image = draw_solids([cube((2, 1, 0))], top_view((0.0, 0.0, 0.0), 100, 80, 0.1))
    red = coloured(image, 0)
    # x from 2 m to 3 m right of the middle at 10 pixels a metre, y from 1 m to 2 m above it
    assert np.abs(red.min(0) - (70, 20)).max() <= 1
    assert np.abs(red.max(0) - (79, 29)).max() <= 1
    assert len(red) == pytest.approx(100, abs=25)


def test_the_nearer_voxel_hides_the_other() -> None:
    low = cube((0, 0, 0), RED)
    high = cube((0, 0, 3), BLUE)
    for solids in ([low, high], [high, low]):
        image = draw_solids(solids, top_view((0.5, 0.5, 0.0), 60, 60, 0.05))
        assert len(coloured(image, 2)) > 200
        assert len(coloured(image, 0)) == 0


def test_aside_both_are_seen_one_above_the_other() -> None:
    view = View(0.3, np.radians(20), (0.5, 0.5, 2.0), 120, 120, 0.06)
    image = draw_solids([cube((0, 0, 0), RED), cube((0, 0, 3), BLUE)], view)
    # rows count downwards
    assert coloured(image, 2)[:, 1].mean() < coloured(image, 0)[:, 1].mean() - 30


def test_a_turned_grid_is_turned() -> None:
    view = top_view((0.0, 0.0, 0.0), 100, 100, 0.1)
    middle = coloured(draw_solids([cube((3, 0, 0), yaw=np.pi / 2)], view), 0).mean(0)
    # (3.5, 0.5) turned by 90 degrees
    np.testing.assert_allclose(middle, view.pixels(np.array([[-0.5, 3.5, 0.5]]))[0, :2], atol=1)


def test_nothing_is_white_and_what_lies_outside_is_left_out() -> None:
    view = top_view((0.0, 0.0, 0.0), 40, 30, 0.1)
    none = Solid(np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8), 0.3, np.eye(4))
    assert (draw_solids([none], view) == 255).all()
    assert (draw_solids([], view) == 255).all()
    assert (draw_solids([cube((500, 0, 0))], view) == 255).all()


def test_view_axes_are_a_right_handed_frame() -> None:
    for azimuth, elevation in ((0.0, 0.0), (2.0, 0.5), (-1.0, np.pi / 2)):
        axes = View(azimuth, elevation, (0.0, 0.0, 0.0), 10, 10, 1.0).axes
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(np.cross(axes[0], axes[1]), axes[2], atol=1e-12)

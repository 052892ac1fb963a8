"""Painting: a near board before a far wall, seen by a camera beside the LIDAR; ground, windows."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.frames import Camera, Header
from semloc_logs.labels.painting import PaintedPoints, Viewpoint, paint, without_borders
from semloc_logs.labels.projection import Projector
from semloc_logs.labels.space import UNPAINTED
from semloc_logs.numerics.transforms import inverse

HEIGHT, WIDTH, FOCAL = 400, 1200, 700.0
BOARD, WALL = 1, 2
UP = np.array([0.0, 0.0, 1.0])
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
PROJECTOR = Projector(
    Camera(
        Header("/info", 0, 0, ""),
        WIDTH,
        HEIGHT,
        K,
        np.zeros(0),
        np.eye(3),
        np.zeros((3, 4)),
        "plumb_bob",
    ),
    HEIGHT,
    WIDTH,
)
# x right, y down, z forward in a base with x forward, y left, z up
AXES = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def camera_at(x: float, y: float, z: float) -> F64:
    base_T_camera = np.eye(4)
    base_T_camera[:3, :3], base_T_camera[:3, 3] = AXES, (x, y, z)
    return base_T_camera


def rays(
    rings: float, step: float = 0.2, reach: float = 45.0, low: float = -14.0, high: float = 10.0
) -> F64:
    """Unit vectors (n, 3) of a spinning LIDAR: rings and points every so many degrees."""
    elevation, azimuth = np.meshgrid(
        np.radians(np.arange(low, high, rings)),
        np.radians(np.arange(-reach, reach, step)),
        indexing="ij",
    )
    return np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=-1,
    ).reshape(-1, 3)


def hit(origin: F64, directions: F64, x: float, half_y: float, half_z: float) -> F64:
    """Distance (n,) along the rays to the upright rectangle at ``x``, infinite where they miss."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (x - origin[0]) / directions[:, 0]
    p = origin + directions * np.where(np.isfinite(t), t, 0)[:, None]
    return np.where(
        np.isfinite(t) & (t > 0) & (np.abs(p[:, 1]) <= half_y) & (np.abs(p[:, 2]) <= half_z),
        t,
        np.inf,
    )


def seen(origin: F64, directions: F64) -> tuple[F64, NDArray[np.int64]]:
    """Distance to the scene and which of BOARD and WALL it is, 0 for neither."""
    board = hit(origin, directions, 8.0, 1.0, 1.0)
    wall = hit(origin, directions, 20.0, 12.0, 4.0)
    nearest = np.minimum(board, wall)
    return nearest, np.where(~np.isfinite(nearest), 0, np.where(board <= wall, BOARD, WALL))


def picture(base_T_camera: F64) -> NDArray[np.uint32]:
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    optical = np.stack(
        [(u - K[0, 2]) / FOCAL, (v - K[1, 2]) / FOCAL, np.ones(u.shape)], axis=-1
    ).reshape(-1, 3)
    return seen(base_T_camera[:3, 3], optical @ AXES.T)[1].reshape(HEIGHT, WIDTH).astype(np.uint32)


def painted(
    points: F64, labels: NDArray[np.uint32], base_T_camera: F64, axis: F64 = UP
) -> PaintedPoints:
    cloud = points.astype(np.float32)
    return paint(
        cloud,
        np.arange(len(cloud)),
        Viewpoint(np.zeros(3), axis),
        labels,
        inverse(base_T_camera),
        PROJECTOR,
    )


@pytest.mark.parametrize(
    "offset", [(0.3, 0.5, -0.2), (0.3, -0.5, -0.2), (0.0, 0.0, -0.8), (-0.5, 1.2, 0.4)]
)
@pytest.mark.parametrize("rings", [0.4, 2.0])
def test_a_board_before_a_wall(offset: tuple[float, float, float], rings: float) -> None:
    base_T_camera = camera_at(*offset)
    directions = rays(rings)
    distance, truth = seen(np.zeros(3), directions)
    points = directions[truth > 0] * distance[truth > 0, None]
    truth = truth[truth > 0]
    label, _, inside = painted(points, without_borders(picture(base_T_camera), 2), base_T_camera)
    # what the camera sees: the first thing on its line to the point is the point itself
    lines = points - base_T_camera[:3, 3]
    is_visible = seen(base_T_camera[:3, 3], lines)[0] > 1 - 1e-6
    pixels, _ = PROJECTOR.pixels(
        points @ base_T_camera[:3, :3] - base_T_camera[:3, 3] @ base_T_camera[:3, :3]
    )
    hidden = inside & ~is_visible & (truth == WALL)
    assert hidden.sum() > (20 if rings < 1 else 3)  # otherwise there is nothing to test
    bleeding = inside & (truth == WALL) & (label == BOARD)
    naive = inside & (truth == WALL) & (picture(base_T_camera)[_pixel(pixels)] == BOARD)
    assert naive.sum() >= hidden.sum()
    assert bleeding.sum() <= 0.02 * naive.sum()
    assert (label[hidden] == UNPAINTED).mean() > 0.95
    assert not (inside & (truth == BOARD) & (label == WALL)).any()
    # away from the board's silhouette nearly everything is painted, as what it is
    silhouette = np.abs(
        _angles(points, base_T_camera) - _board_middle(base_T_camera)
    ) - _board_half(base_T_camera)
    clear = (
        inside
        & is_visible
        & ((silhouette > np.radians(0.7)).any(1) | (silhouette < -np.radians(0.4)).all(1))
    )
    assert (label[clear] == truth[clear]).mean() > 0.985


def _pixel(pixels: F64) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    whole = np.rint(np.nan_to_num(pixels, nan=-1)).astype(int)
    return np.clip(whole[:, 1], 0, HEIGHT - 1), np.clip(whole[:, 0], 0, WIDTH - 1)


def _angles(points: F64, base_T_camera: F64) -> F64:
    d = points - base_T_camera[:3, 3]
    return np.stack([d[:, 1] / d[:, 0], d[:, 2] / d[:, 0]], axis=1)


def _board_middle(base_T_camera: F64) -> F64:
    return np.asarray(_angles(np.array([[8.0, 0, 0]]), base_T_camera)[0])


def _board_half(base_T_camera: F64) -> F64:
    return np.full(2, 1.0 / (8.0 - base_T_camera[0, 3]))


def test_a_lidar_on_its_side() -> None:
    """The rings of a sensor that turns about y are upright; its azimuth counts about that axis."""
    base_T_camera = camera_at(0.3, 0.5, -0.2)
    turned = rays(1.0, reach=30.0, low=-30.0, high=30.0)[:, [0, 2, 1]]
    distance, truth = seen(np.zeros(3), turned)
    points = turned[truth > 0] * distance[truth > 0, None]
    truth = truth[truth > 0]
    labels = without_borders(picture(base_T_camera), 2)
    label, _, inside = painted(points, labels, base_T_camera, axis=np.array([0.0, 1.0, 0.0]))
    assert (label[inside & (truth == WALL)] == BOARD).mean() < 0.002
    assert (label[inside] == truth[inside]).mean() > 0.9


@pytest.mark.parametrize("offset", [(0.3, 0.3, -0.3), (1.5, 0.0, -0.3)])
def test_the_ground_and_a_wall_along_the_road_do_not_hide_themselves(
    offset: tuple[float, float, float],
) -> None:
    directions = rays(0.4, low=-24.0)
    ground = -1.73 / np.minimum(directions[:, 2], -1e-9)
    wall = 4.0 / np.maximum(directions[:, 1], 1e-9)
    distance = np.minimum(ground, wall)
    points = (directions * distance[:, None])[distance < 45]
    label, _, inside = painted(points, np.zeros((HEIGHT, WIDTH), np.uint32), camera_at(*offset))
    assert inside.sum() > 10_000
    assert (label[inside] == 0).mean() > 0.97


def test_points_behind_a_window_are_doubtful() -> None:
    """A board with a window before a wall, all of one label in the picture."""
    base_T_camera = camera_at(0.2, 0.1, -0.1)
    directions = rays(0.4)
    distance, _ = seen(np.zeros(3), directions)
    at_board = directions * (8.0 / directions[:, :1])
    window = (np.abs(at_board[:, 1]) < 0.5) & (np.abs(at_board[:, 2]) < 0.3)
    distance[window] = hit(np.zeros(3), directions, 20.0, 12.0, 4.0)[window]
    kept = np.isfinite(distance)
    points = (directions[kept] * distance[kept, None]).astype(np.float32)
    window = window[kept]
    viewpoint = Viewpoint(np.zeros(3), UP)
    out, is_doubtful, _ = paint(
        points,
        np.arange(len(points)),
        viewpoint,
        picture(base_T_camera),
        inverse(base_T_camera),
        PROJECTOR,
    )
    through = window & (out == BOARD)
    assert through.sum() > 100
    assert is_doubtful[through].mean() > 0.99
    front = (points[:, 0] < 9) & (out != UNPAINTED)
    assert not is_doubtful[front].any()
    assert not is_doubtful[out == UNPAINTED].any()
    assert (out[~window & (points[:, 0] > 9)] == UNPAINTED).mean() < 0.9


def test_points_behind_beside_and_without_any_company() -> None:
    points = np.array([[-5.0, 0, 0], [5.0, 0, 0], [5.0, 30.0, 0]])
    label, _, inside = painted(points, np.full((HEIGHT, WIDTH), 7, np.uint32), camera_at(0, 0, 0))
    assert inside.tolist() == [False, True, False]
    assert label.tolist() == [UNPAINTED, 7, UNPAINTED]
    label, _, inside = painted(
        np.zeros((0, 3)), np.full((HEIGHT, WIDTH), 7, np.uint32), camera_at(0, 0, 0)
    )
    assert len(label) == len(inside) == 0


def test_borders_by_hand() -> None:
    labels = np.array([[1, 1, 1, 2, 2, 2]] * 3, np.uint32)
    n = UNPAINTED
    assert without_borders(labels, 0).tolist() == labels.tolist()
    assert without_borders(labels, 1)[0].tolist() == [1, 1, n, n, 2, 2]
    assert without_borders(labels, 2)[1].tolist() == [1, n, n, n, n, 2]
    assert (without_borders(labels, 3) == n).all()
    one = np.zeros((5, 5), np.uint32)
    one[2, 2] = 9
    assert (without_borders(one, 1) == n).sum() == 5  # the pixel and its four neighbours

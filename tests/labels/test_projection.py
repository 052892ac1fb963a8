"""Projection against OpenCV, against the rays of depth images, and far outside of the picture."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from semloc_logs.errors import LogError
from semloc_logs.frames import Camera, Header
from semloc_logs.labels.projection import Projector
from semloc_logs.logs.sensors.depth import Unprojector


def camera(
    D: tuple[float, ...] = (),
    model: str = "plumb_bob",
    focal: float = 500.0,
    width: int = 640,
    height: int = 480,
) -> Camera:
    K = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1.0]])
    P = np.hstack([K * [[2], [2], [1]], np.zeros((3, 1))])
    return Camera(
        Header("/info", 0, 0, "optical"), width, height, K, np.array(D), np.eye(3), P, model
    )


def test_by_hand() -> None:
    pixels, front = Projector(camera(), 480, 640).pixels(
        np.array([[0.2, -0.1, 2.0], [0.2, -0.1, -2.0], [0, 0, 0.01]])
    )
    assert front.tolist() == [True, False, False]
    np.testing.assert_allclose(pixels[0], [319.5 + 50, 239.5 - 25])
    assert np.isnan(pixels[1:]).all()


@pytest.mark.parametrize(
    ("D", "model"),
    [
        ((), "plumb_bob"),
        ((-0.28, 0.07, 0.0002, 0.00002, 0.0), "plumb_bob"),
        ((0.1, -0.05, 0.001, 0.001, 0.01, 0.05, 0.0, 0.0), "rational_polynomial"),
        ((0.02, -0.01, 0.0, 0.0), "equidistant"),
    ],
)
def test_there_and_back_through_the_rays_of_a_depth_image(D: tuple[float, ...], model: str) -> None:
    depth = np.full((480, 640), 3.0, np.float32)
    points, index = Unprojector(camera(D, model), 480, 640, stride=16).points(depth, 0, 80)
    pixels, front = Projector(camera(D, model), 480, 640).pixels(points)
    assert front.all()
    # OpenCV's inverse is iterative and gives up at the rim
    np.testing.assert_allclose(pixels, np.stack([index % 640, index // 640], axis=1), atol=0.3)


def test_a_distortion_that_turns_back_does_not_fold_the_surroundings_into_the_picture() -> None:
    calibration = camera((-0.4, 0.0, 0.0, 0.0, 0.0))
    angle = np.radians(np.linspace(0, 80, 100))
    points = 10 * np.stack([np.sin(angle), np.zeros(100), np.cos(angle)], axis=1)
    projector = Projector(calibration, 480, 640)
    inside = projector.inside(projector.pixels(points)[0])
    folded = np.asarray(
        cv2.projectPoints(points, np.zeros(3), np.zeros(3), calibration.K, calibration.D)[0], float
    )[:, 0]
    assert projector.inside(folded)[-25:].any()  # the polynomial alone does fold
    assert not inside[angle > np.radians(50)].any()
    assert inside[angle < np.radians(25)].all()


def test_scaled_and_rectified_pictures() -> None:
    point = np.array([[0.2, -0.1, 2.0]])
    half, _ = Projector(camera(), 240, 320).pixels(point)
    np.testing.assert_allclose(
        half[0], [(319.5 + 50 + 0.5) / 2 - 0.5, (239.5 - 25 + 0.5) / 2 - 0.5]
    )
    rectified, _ = Projector(camera((0.5, 0.5, 0, 0, 0)), 480, 640, rectified=True).pixels(point)
    np.testing.assert_allclose(rectified[0], [2 * 319.5 + 100, 2 * 239.5 - 50])


def test_unusable_calibrations_are_named() -> None:
    with pytest.raises(LogError, match="640 x 480 pixels but the picture has 640 x 640"):
        Projector(camera(), 640, 640)
    with pytest.raises(LogError, match="'double_sphere'"):
        Projector(camera((0.1, 0.2), "double_sphere"), 480, 640)
    with pytest.raises(LogError, match="no focal length"):
        Projector(camera(focal=0.0), 480, 640)

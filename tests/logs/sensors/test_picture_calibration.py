"""Binning, regions of interest and lens models of CameraInfo, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semloc_logs.errors import LogError
from semloc_logs.frames import WHOLE_PICTURE, Camera, Header, Region
from semloc_logs.labels.projection import Projector
from semloc_logs.logs.sensors.depth import Unprojector
from semloc_logs.logs.sensors.picture_calibration import fitted_camera, lens_of
from semloc_logs.logs.sensors.rectification import rectification


def camera(
    binning: tuple[int, int] = (1, 1),
    roi: Region = WHOLE_PICTURE,
    *,
    width: int = 640,
    height: int = 480,
    K: tuple[float, float, float, float] = (500.0, 400.0, 322.0, 236.0),
    baseline: float = 0.0,
) -> Camera:
    """A sensor of 640 x 480 pixels: fx, fy, cx, cy are ``K``."""
    fx, fy, cx, cy = K
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    P = np.hstack([matrix, np.array([[-fx * baseline], [0], [0]])])
    header = Header("/info", 0, 0, "optical")
    D = np.zeros(5)
    return Camera(header, width, height, matrix, D, np.eye(3), P, "plumb_bob", binning, roi)


def four(camera: Camera) -> list[float]:
    """fx, fy, cx, cy."""
    return [float(camera.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))]


def test_without_binning_and_region_nothing_changes() -> None:
    for given in (camera(), camera((0, 0)), camera(roi=Region(0, 0, 640, 480))):
        fitted, assumption = fitted_camera(given, 480, 640)
        assert four(fitted) == [500, 400, 322, 236]
        assert assumption == ""


def test_binning_divides_and_regions_shift() -> None:
    """K of the picture = (K - offset) / binning, and P alike with its baseline."""
    fitted, assumption = fitted_camera(camera((2, 4), baseline=0.1), 120, 320)
    assert four(fitted) == [250, 100, 161, 59]
    assert fitted.P[0].tolist() == [250, 0, 161, -25]
    assert (fitted.width, fitted.height, assumption) == (320, 120, "")

    region = Region(100, 200, 400, 240)
    fitted, assumption = fitted_camera(camera(roi=region), 240, 400)
    assert four(fitted) == [500, 400, 222, 36]
    assert assumption == ""

    fitted, assumption = fitted_camera(camera((2, 2), region), 120, 200)
    assert four(fitted) == [250, 200, 111, 18]
    assert assumption == ""


def test_an_odd_size_may_be_rounded_either_way() -> None:
    for height, width in ((240, 320), (241, 321)):
        given = camera((2, 2), width=641, height=481)
        assert four(fitted_camera(given, height, width).camera) == [250, 200, 161, 118]


def test_a_driver_that_writes_the_size_and_k_of_the_picture() -> None:
    """All agree, so nothing is assumed."""
    given = camera((2, 2), width=320, height=240, K=(250, 200, 161, 118))
    fitted, assumption = fitted_camera(given, 240, 320)
    assert four(fitted) == [250, 200, 161, 118]
    assert assumption == ""


@pytest.mark.parametrize(
    ("matrix", "is_assumed"),
    [((500, 400, 322, 236), False), ((1000, 800, 644, 472), True), ((250, 200, 161, 118), True)],
    ids=["of the picture", "twice as large", "half as large"],
)
def test_a_calibration_of_a_picture_of_another_size_is_named(
    matrix: tuple[int, int, int, int], is_assumed: bool
) -> None:
    fitted, assumption = fitted_camera(camera(K=matrix), 480, 640)
    assert four(fitted) == list(matrix)
    assert ("as of a picture of another size" in assumption) == is_assumed
    assert f"lies at ({matrix[2]}, {matrix[3]})" in assumption or not is_assumed


@pytest.mark.parametrize(
    ("middle", "is_told"), [((236, 322), True), ((322, 236), False), ((270, 280), False)]
)
def test_a_principal_point_with_its_axes_exchanged_is_named(
    middle: tuple[int, int], is_told: bool
) -> None:
    _, assumption = fitted_camera(camera(K=(500, 400, *middle)), 480, 640)
    assert ("x and y are exchanged, or of a picture that was turned" in assumption) == is_told
    _, assumption = fitted_camera(camera(K=(500, 500, 322, 322), width=640, height=640), 640, 640)
    assert assumption == ""


def test_a_driver_that_writes_the_size_of_the_picture_but_k_of_the_sensor() -> None:
    fitted, assumption = fitted_camera(camera((2, 2), width=320, height=240), 240, 320)
    assert four(fitted) == [250, 200, 161, 118]
    assert "CameraInfo /info is for 320 x 240 pixels, but its K is for a larger" in assumption


def test_a_driver_that_writes_k_of_the_picture() -> None:
    given = camera((2, 2), K=(250, 200, 161, 118))
    fitted, assumption = fitted_camera(given, 240, 320)
    assert four(fitted) == [250, 200, 161, 118]
    assert "its K fits the reduced picture: it is taken as it is" in assumption

    # the same for a region: the middle of the full picture is at (220, 40) of it
    given = camera(roi=Region(100, 200, 400, 240), K=(500, 400, 222, 36))
    fitted, assumption = fitted_camera(given, 240, 400)
    assert four(fitted) == [500, 400, 222, 36]
    assert "a region of interest of 400 x 240 at (100, 200)" in assumption


def test_a_region_so_near_the_edge_that_k_may_be_either() -> None:
    given = camera(roi=Region(20, 0, 620, 480), K=(500, 400, 305, 236))
    fitted, assumption = fitted_camera(given, 480, 620)
    assert four(fitted) == [500, 400, 285, 236]
    assert "cannot be told" in assumption


def test_only_one_of_the_two_fits_the_picture() -> None:
    both = camera((2, 2), Region(100, 200, 400, 240))
    fitted, assumption = fitted_camera(both, 240, 320)
    assert four(fitted) == [250, 200, 161, 118]
    assert "only the binning is applied" in assumption
    fitted, assumption = fitted_camera(both, 240, 400)
    assert four(fitted) == [500, 400, 222, 36]
    assert "only the region is applied" in assumption
    # the region is where the picture is valid, not its remainder
    fitted, assumption = fitted_camera(camera(roi=Region(10, 10, 600, 400)), 480, 640)
    assert four(fitted) == [500, 400, 322, 236]
    assert assumption == ""


def test_a_size_that_nothing_explains_is_refused() -> None:
    with pytest.raises(LogError, match="is for 640 x 480 pixels but the picture has 320 x 240"):
        fitted_camera(camera(), 240, 320)
    with pytest.raises(LogError, match=r"640 x 480 \(binning 2 x 2: 320 x 240\) pixels but the"):
        fitted_camera(camera((2, 2)), 120, 160)
    # a picture that was shrunk after it was cut out: from 400 x 240 to half of that
    region = Region(100, 200, 400, 240)
    fitted, _ = fitted_camera(camera(roi=region), 120, 200, scaled=True)
    assert four(fitted) == [250, 200, (222.5 / 2) - 0.5, (36.5 / 2) - 0.5]


def test_depth_images_with_binning() -> None:
    """A wall at 2 m: the same rays as every second pixel of the full picture, where the sensor
    has its pixels."""
    full, _ = Unprojector(camera(), 480, 640, stride=2).points(
        np.full((480, 640), 2.0, np.float32), 0.0, 9.0
    )
    binned = Unprojector(camera((2, 2)), 240, 320, stride=1)
    points, _ = binned.points(np.full((240, 320), 2.0, np.float32), 0.0, 9.0)
    np.testing.assert_allclose(points, full, atol=1e-6)
    assert binned.assumptions == []


def test_pictures_for_labels_with_a_region() -> None:
    projector = Projector(camera(roi=Region(100, 200, 400, 240)), 240, 400)
    # straight ahead: the principal point (322, 236) less the offset
    pixels, _ = projector.pixels(np.array([[0.0, 0.0, 5.0]]))
    assert pixels.tolist() == [[222, 36]]


def test_stereo_pairs_with_binning() -> None:
    left = camera((2, 2), K=(500, 500, 322, 236))
    right = camera((2, 2), K=(500, 500, 322, 236), baseline=0.1)
    how = rectification(left, right, (240, 320), None, rectified=True)
    assert (how.focal, how.centre) == (250, (161, 118))
    assert how.baseline == pytest.approx(0.1)
    assert how.assumptions == ()
    half = replace(right, K=right.K * [[0.5], [0.5], [1]], P=right.P * [[0.5], [0.5], [1]])
    how = rectification(left, half, (240, 320), None, rectified=True)
    assert how.focal == 250
    assert how.baseline == pytest.approx(0.1)
    assert "P fits the reduced picture" in how.assumptions[0]
    # K does not matter to rectified pictures
    how = rectification(left, replace(right, K=half.K), (240, 320), None, rectified=True)
    assert how.assumptions == ()


def test_rectified_pictures_are_turned_back_into_the_frame_of_the_camera() -> None:
    """R turns the camera's frame into the rectified one: a quarter turn about the optical axis."""
    R = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    turned = replace(camera(K=(500, 500, 320, 240)), R=R)
    depth = np.zeros((480, 640), np.float32)
    depth[240, 420] = 5.0
    points, _ = Unprojector(turned, 480, 640, rectified=True, stride=1).points(depth, 0.0, 9.0)
    # x = 1 m in the rectified frame is y in the camera's
    np.testing.assert_allclose(points, [[0, 1, 5]], atol=1e-6)
    pixels, _ = Projector(turned, 480, 640, rectified=True).pixels(points)
    np.testing.assert_allclose(pixels, [[420, 240]], atol=1e-4)
    plain, _ = Unprojector(turned, 480, 640, stride=1).points(depth, 0.0, 9.0)
    np.testing.assert_allclose(plain, [[1, 0, 5]], atol=1e-6)


# -- lens models


def with_lens(model: str, D: list[float]) -> Camera:
    return replace(camera(), model=model, D=np.array(D, float))


@pytest.mark.parametrize(
    "model",
    [
        "",
        "none",
        "pinhole",
        "plumb_bob",
        "Plumb Bob",
        "rational_polynomial",
        "thin_prism",
        "inverse_brown_conrady",
        "modified_brown_conrady",
    ],
)
@pytest.mark.parametrize("count", [0, 5])
def test_pinholes(model: str, count: int) -> None:
    lens = lens_of(with_lens(model, [0.0] * count))
    assert (lens.is_fisheye, len(lens.coefficients), lens.assumption) == (False, 0, "")


@pytest.mark.parametrize(
    ("model", "D", "expected"),
    [
        ("plumb_bob", [0.1, 0.2, 0, 0], [0.1, 0.2, 0, 0]),
        ("radtan", [0.1, 0.2, 0, 0], [0.1, 0.2, 0, 0]),
        ("plumb_bob", [0.1, 0.2, 0, 0, 0.3], [0.1, 0.2, 0, 0, 0.3]),
        ("plumb_bob", [0.1, 0, 0, 0, 0, 0], [0.1, 0, 0, 0]),
        ("rational_polynomial", [0.1] * 8, [0.1] * 8),
        ("thin_prism", [0.1] * 12, [0.1] * 12),
    ],
)
def test_polynomials(model: str, D: list[float], expected: list[float]) -> None:
    lens = lens_of(with_lens(model, D))
    assert lens.coefficients.tolist() == expected
    assert (lens.is_fisheye, lens.assumption) == (False, "")


@pytest.mark.parametrize(
    "model", ["equidistant", "fisheye", "kannala_brandt", "kannala_brandt4", "KannalaBrandt4"]
)
@pytest.mark.parametrize("count", [4, 5])
def test_fisheyes(model: str, count: int) -> None:
    lens = lens_of(with_lens(model, [0.1, 0.2, 0.3, 0.4, 0.0][:count]))
    assert lens.coefficients.tolist() == [0.1, 0.2, 0.3, 0.4]
    assert (lens.is_fisheye, lens.assumption) == (True, "")


def test_a_fisheye_without_coefficients_has_angles_proportional_to_the_radius() -> None:
    lens = lens_of(with_lens("equidistant", []))
    assert "'equidistant' without coefficients" in lens.assumption
    depth = np.zeros((480, 640), np.float32)
    depth[236, 572] = 1.0
    points, _ = Unprojector(with_lens("equidistant", [0, 0, 0, 0]), 480, 640, stride=1).points(
        depth, 0.0, 9.0
    )
    # 250 pixels right of the principal point, at focal length 500: half a radian
    np.testing.assert_allclose(points, [[np.tan(0.5), 0, 1]], atol=1e-5)


def test_coefficients_of_an_unnamed_model_are_an_assumption() -> None:
    lens = lens_of(with_lens("", [0.1, 0, 0, 0, 0]))
    assert "/info has 5 distortion coefficients but does not name their model" in lens.assumption


@pytest.mark.parametrize(
    ("model", "D"),
    [
        ("double_sphere", [0.0] * 5),
        ("fov", []),
        ("omnidirectional", [0.1] * 5),
        ("none", [0.1] * 5),
        ("inverse_brown_conrady", [0.1] * 5),
        ("plumb_bob", [0.1]),
        ("equidistant", [0.1] * 5),
        ("rational_polynomial", [0.1] * 20),
    ],
)
def test_unknown_models_are_refused_by_topic_and_model(model: str, D: list[float]) -> None:
    given = with_lens(model, D)
    message = f"CameraInfo /info has the distortion model '{model}' with {len(D)} coefficients"
    with pytest.raises(LogError, match=message):
        Unprojector(given, 480, 640)
    with pytest.raises(LogError, match=message):
        Projector(given, 480, 640)
    with pytest.raises(LogError, match=message):
        rectification(given, given, (480, 640), None, rectified=False)
    # the lens of a rectified picture does not matter
    assert Unprojector(given, 480, 640, rectified=True).assumptions == []

"""Depth from synthetic pairs: a textured slanted plane, drawn through known lenses."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError
from semloc_logs.frames import Camera, Header
from semloc_logs.logs.sensors.rectification import Rectification, bouguet_rotations, rectification
from semloc_logs.logs.sensors.stereo import StereoMatcher, disparity_noise
from semloc_logs.numerics.transforms import exp_se3, inverse

HEIGHT, WIDTH = 240, 320
# n . p = distance, in the left optical frame: a wall 3 m ahead that recedes to the right
NORMAL = np.array([0.35, 0.1, 1.0]) / np.linalg.norm([0.35, 0.1, 1.0])
DISTANCE = 2.8
LEFT_T_RIGHT = exp_se3(np.array([0.2, 0.006, -0.004]), np.array([0.02, -0.03, 0.015]))
MODELS = {
    "plumb_bob": (-0.28, 0.07, 0.0003, -0.0002, 0.0),
    "rational_polynomial": (0.6, -0.1, 0.0002, 0.0001, 0.01, 0.9, -0.05, 0.02),
    "equidistant": (-0.02, 0.01, -0.004, 0.001),
    "": (),
}


def camera(
    model: str = "", side: int = 0, K: F64 | None = None, R: F64 | None = None, P: F64 | None = None
) -> Camera:
    if K is None:
        K = np.array(
            [[210.0 + 3 * side, 0, 161.0 - 4 * side], [0, 209.0, 118.0 + 5 * side], [0, 0, 1]]
        )
    D = np.array(MODELS[model])
    P = np.hstack([K, np.zeros((3, 1))]) if P is None else P
    return Camera(
        Header(f"/cam{side}/camera_info", 0, 0, f"cam{side}"),
        WIDTH,
        HEIGHT,
        K,
        D,
        np.eye(3) if R is None else R,
        P,
        model,
    )


def texture(seed: int = 0) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    fine = cv2.GaussianBlur(rng.normal(size=(1024, 1024)).astype(np.float32), (0, 0), 1.0)
    coarse = cv2.GaussianBlur(rng.normal(size=(1024, 1024)).astype(np.float32), (0, 0), 5.0)
    mixed = fine / fine.std() + coarse / coarse.std()
    return np.asarray(np.clip(128 + 25 * mixed, 0, 255), np.float32)


def rays_of(lens: Camera) -> F64:
    """The ray of each pixel: the one that OpenCV projects back onto it, found by iteration."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)
    project = cv2.fisheye.projectPoints if lens.model == "equidistant" else cv2.projectPoints
    D = lens.D if len(lens.D) else np.zeros(4)
    flat = (pixels - lens.K[:2, 2]) / lens.K[[0, 1], [0, 1]]
    for _ in range(15):
        there, _ = project(
            np.hstack([flat, np.ones((len(flat), 1))])[:, None], np.zeros(3), np.zeros(3), lens.K, D
        )
        flat = flat - (there.reshape(-1, 2) - pixels) / lens.K[[0, 1], [0, 1]]
    return np.hstack([flat, np.ones((len(flat), 1))])


def drawn(
    lens: Camera, left_T_camera: F64, seed: int, noise: float = 2.0, contrast: float = 1.0
) -> tuple[NDArray[np.uint8], F64]:
    """The picture of the plane, and the true point of each pixel in the camera's frame."""
    rays = rays_of(lens)
    normal = left_T_camera[:3, :3].T @ NORMAL
    distance = DISTANCE - NORMAL @ left_T_camera[:3, 3]
    points = rays * (distance / (rays @ normal))[:, None]
    on_plane = points @ left_T_camera[:3, :3].T + left_T_camera[:3, 3]
    side = np.cross(NORMAL, [0, 1, 0])
    u = on_plane @ side / np.linalg.norm(side)
    v = on_plane @ np.cross(NORMAL, side) / np.linalg.norm(side)
    where = [(512 + 100 * a).reshape(HEIGHT, WIDTH).astype(np.float32) for a in (u, v)]
    grey = 128 + contrast * (
        cv2.remap(texture(), where[0], where[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        - 128
    )
    grey = grey + np.random.default_rng(seed).normal(scale=noise, size=grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8), points


def errors(points: NDArray[np.float32]) -> F64:
    """How much too long the ray to each point is (m)."""
    length = np.linalg.norm(points, axis=1)
    return np.asarray(length - DISTANCE / (points.astype(float) / length[:, None] @ NORMAL))


@pytest.mark.parametrize("model", list(MODELS))
def test_a_slanted_plane_through_each_lens(model: str) -> None:
    left = camera(model)
    right = camera(model, 1)
    how = rectification(left, right, (HEIGHT, WIDTH), inverse(LEFT_T_RIGHT), rectified=False)
    matcher = StereoMatcher(how, min_range=0.3, max_range=20.0)
    picture, truth = drawn(left, np.eye(4), 1)
    cloud = matcher.points(picture, drawn(right, LEFT_T_RIGHT, 2)[0])
    assert len(cloud.points) > 0.6 * HEIGHT * WIDTH
    error = errors(cloud.points)
    normalised = errors(cloud.points) / cloud.sigma
    assert abs(np.median(error)) < 0.01
    assert np.median(np.abs(error)) < 0.05
    # sigma is meant to hold, neither hopeful nor timid
    assert 0.75 < 1.4826 * np.median(np.abs(normalised - np.median(normalised))) < 1.25
    assert np.mean(np.abs(normalised) < 3) > 0.98
    # the pixel of a point is where it was seen: its ray, half a pixel to all sides
    seen = truth[cloud.pixels] / np.linalg.norm(truth[cloud.pixels], axis=1)[:, None]
    ray = cloud.points / np.linalg.norm(cloud.points, axis=1)[:, None]
    assert np.percentile(np.arccos(np.clip(np.sum(seen * ray, axis=1), -1, 1)), 99) < 0.8 / 200


@pytest.mark.parametrize("wrong", ["distortion", "rotation"])
def test_a_wrong_calibration_would_be_seen(wrong: str) -> None:
    left = camera("plumb_bob")
    right = camera("plumb_bob", 1)
    pictures = drawn(left, np.eye(4), 1)[0], drawn(right, LEFT_T_RIGHT, 2)[0]
    if wrong == "distortion":
        left = camera()
        right = camera(side=1)
    right_T_left = inverse(LEFT_T_RIGHT)
    if wrong == "rotation":
        right_T_left = right_T_left @ exp_se3(np.zeros(3), np.array([0.01, 0.01, 0.0]))
    how = rectification(left, right, (HEIGHT, WIDTH), right_T_left, rectified=False)
    cloud = StereoMatcher(how, min_range=0.3, max_range=20.0).points(*pictures)
    assert len(cloud.points) == 0 or np.mean(np.abs(errors(cloud.points)) < 0.05) < 0.5


def test_shrunk_pictures_and_thinned_points() -> None:
    left = camera("plumb_bob")
    right = camera("plumb_bob", 1)
    how = rectification(left, right, (HEIGHT, WIDTH), inverse(LEFT_T_RIGHT), rectified=False)
    pictures = drawn(left, np.eye(4), 1)[0], drawn(right, LEFT_T_RIGHT, 2)[0]
    whole, half = (StereoMatcher(how, min_range=0.3, max_range=20.0, stride=n) for n in (1, 2))
    a = whole.points(*pictures)
    b = half.points(*pictures)
    assert half.count < whole.count
    assert 0.15 < len(b.points) / len(a.points) < 0.35
    assert abs(np.median(errors(b.points))) < 0.01
    assert np.mean(np.abs(errors(b.points)) < 3 * b.sigma) > 0.97
    assert np.median(b.sigma) > 1.5 * np.median(a.sigma)
    large = StereoMatcher(_unturned(480, 640), min_range=0.3, max_range=20.0)
    assert (large.shrink, large.step) == (1, 2)
    assert StereoMatcher(_unturned(1200, 1920), min_range=0.3, max_range=20.0).shrink == 3


def _unturned(
    height: int, width: int, focal: float = 400.0, baseline: float = 0.1, shift: float = 0.0
) -> Rectification:
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    P = [
        np.array([[focal, 0, width / 2 + x, t], [0, focal, height / 2, 0], [0, 0, 1, 0]])
        for x, t in ((shift, 0.0), (0.0, -focal * baseline))
    ]
    infos = [
        Camera(
            Header(f"/{side}/camera_info", 0, 0, side),
            width,
            height,
            K,
            np.zeros(5),
            np.eye(3),
            p,
            "plumb_bob",
        )
        for side, p in zip(("left", "right"), P, strict=True)
    ]
    return rectification(infos[0], infos[1], (height, width), None, rectified=True)


@pytest.mark.parametrize(
    ("width", "nearest", "far", "expected"),
    [
        (640, 1.0, 20.0, (1, 48)),  # 40 px at 1 m, 2 px at 20 m, a pixel more at both ends
        (640, 0.01, 20.0, (1, 64)),  # 4000 px at 1 cm: no more than a tenth of the width
        (640, 2.0, 4.0, (9, 16)),
    ],
)
def test_disparities_follow_from_the_ranges(
    width: int, nearest: float, far: float, expected: tuple[int, int]
) -> None:
    matcher = StereoMatcher(_unturned(480, width), min_range=nearest, max_range=far, stride=1)
    assert (matcher.least, matcher.count) == expected


@pytest.mark.parametrize("shift", [0.0, 12.0, -30.0])
def test_a_step_by_hand_in_rectified_pictures(shift: float) -> None:
    """Two layers 20 and 8 pixels apart, at 2 and 5 m.

    With equal and with different principal points.
    """
    how = _unturned(240, 320, 400.0, 0.1, shift)
    noise = np.random.default_rng(3).integers(0, 255, (240, 700)).astype(np.uint8)
    left = noise[:, 100:420]
    right = np.empty_like(left)
    for rows, disparity in ((slice(0, 120), 20 + int(shift)), (slice(120, 240), 8 + int(shift))):
        right[rows] = noise[rows, 100 + disparity : 420 + disparity]
    cloud = StereoMatcher(how, min_range=0.5, max_range=20.0).points(left, right)
    for (first, last), depth in (((4, 110), 2.0), ((130, 236), 5.0)):
        inside = (cloud.pixels // 320 >= first) & (cloud.pixels // 320 < last)
        assert inside.sum() > 0.7 * 106 * 320
        assert np.mean(np.abs(cloud.points[inside, 2] - depth) < 0.03 * depth) > 0.98
    column = cloud.pixels % 320
    row = cloud.pixels // 320
    np.testing.assert_allclose(
        cloud.points[:, 0], (column - 160 - shift) / 400 * cloud.points[:, 2], rtol=1e-4, atol=1e-4
    )
    np.testing.assert_allclose(
        cloud.points[:, 1], (row - 120) / 400 * cloud.points[:, 2], rtol=1e-4, atol=1e-4
    )


def test_sigma_by_hand() -> None:
    """f b = 40 px m: at 2 m the disparity is 20, a fifth of a pixel is 4 / 40 / 5 = 2 cm."""
    noise = np.random.default_rng(3).integers(0, 255, (240, 700)).astype(np.uint8)
    cloud = StereoMatcher(_unturned(240, 320), min_range=0.5, max_range=20.0, noise=0.2).points(
        noise[:, 100:420], noise[:, 120:440]
    )
    middle = np.argmin(np.abs(cloud.pixels - (120 * 320 + 160)))
    assert cloud.sigma[middle] == pytest.approx(0.02, rel=0.1)
    ray = np.linalg.norm(cloud.points, axis=1) / cloud.points[:, 2]
    np.testing.assert_allclose(cloud.sigma / ray, cloud.sigma[middle], rtol=0.15)


def test_pictures_that_cannot_be_matched_give_nothing() -> None:
    matcher = StereoMatcher(_unturned(240, 320), min_range=0.5, max_range=20.0)
    rng = np.random.default_rng(0)
    flat = np.full((240, 320), 90, np.uint8)
    assert len(matcher.points(flat, flat).points) == 0
    faint = np.clip(90 + rng.normal(scale=0.6, size=(2, 240, 320)), 0, 255).astype(np.uint8)
    assert len(matcher.points(faint[0], faint[1]).points) == 0
    strangers = rng.integers(0, 255, (2, 240, 320)).astype(np.uint8)
    assert len(matcher.points(strangers[0], strangers[1]).points) < 0.01 * 240 * 320


def test_less_texture_is_less_certain() -> None:
    rng = np.random.default_rng(1)
    picture = np.full((60, 200), 100.0)
    picture[:, :100] += rng.normal(scale=40, size=(60, 100))
    picture[:, 100:] += rng.normal(scale=4, size=(60, 100))
    noise = disparity_noise(np.clip(picture, 0, 255).astype(np.uint8), 0.2)
    assert np.median(noise[:, :90]) == pytest.approx(0.2, abs=0.02)
    assert np.median(noise[:, 110:]) > 0.3


def test_any_number_of_threads_gives_the_same() -> None:
    left = camera("plumb_bob")
    right = camera("plumb_bob", 1)
    how = rectification(left, right, (HEIGHT, WIDTH), inverse(LEFT_T_RIGHT), rectified=False)
    pictures = drawn(left, np.eye(4), 1)[0], drawn(right, LEFT_T_RIGHT, 2)[0]
    before = cv2.getNumThreads()
    clouds = []
    try:
        for threads in (1, 2, 3):
            cv2.setNumThreads(threads)
            clouds.append(StereoMatcher(how, min_range=0.3, max_range=20.0).points(*pictures))
    finally:
        cv2.setNumThreads(before)
    for other in clouds[1:]:
        for a, b in zip(clouds[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_rotations_are_those_of_opencv() -> None:
    right_T_left = inverse(LEFT_T_RIGHT)
    ours = bouguet_rotations(right_T_left)
    K = camera().K
    D = np.zeros(5)
    theirs = cv2.stereoRectify(
        K, D, K, D, (WIDTH, HEIGHT), right_T_left[:3, :3], right_T_left[:3, 3:]
    )[:2]
    np.testing.assert_allclose(ours[0], theirs[0], atol=1e-9)
    np.testing.assert_allclose(ours[1], theirs[1], atol=1e-9)


def test_recorded_rotations_and_projections_serve_where_tf_is_missing() -> None:
    right_T_left = inverse(LEFT_T_RIGHT)
    lenses = camera("plumb_bob"), camera("plumb_bob", 1)
    turned = cv2.stereoRectify(
        lenses[0].K,
        lenses[0].D,
        lenses[1].K,
        lenses[1].D,
        (WIDTH, HEIGHT),
        right_T_left[:3, :3],
        right_T_left[:3, 3:],
        alpha=0,
    )
    left, right = (
        camera(
            "plumb_bob",
            side,
            R=np.asarray(turned[side], float),
            P=np.asarray(turned[2 + side], float),
        )
        for side in (0, 1)
    )
    how = rectification(left, right, (HEIGHT, WIDTH), None, rectified=False)
    assert how.baseline == pytest.approx(np.linalg.norm(LEFT_T_RIGHT[:3, 3]))
    cloud = StereoMatcher(how, min_range=0.3, max_range=20.0).points(
        drawn(left, np.eye(4), 1)[0], drawn(right, LEFT_T_RIGHT, 2)[0]
    )
    assert np.mean(np.abs(errors(cloud.points)) < 3 * cloud.sigma) > 0.97


def test_wide_lenses_keep_their_field_of_view_within_limits() -> None:
    how = rectification(
        camera("plumb_bob"),
        camera("plumb_bob", 1),
        (HEIGHT, WIDTH),
        inverse(LEFT_T_RIGHT),
        rectified=False,
    )
    assert 0.6 * 210 < how.focal < 210
    # 320 px of an equidistant lens of 100 px: 183 degrees
    K = np.array([[100.0, 0, 160], [0, 100, 120], [0, 0, 1]])
    wide = rectification(
        camera("equidistant", K=K),
        camera("equidistant", 1, K=K),
        (HEIGHT, WIDTH),
        inverse(LEFT_T_RIGHT),
        rectified=False,
    )
    assert wide.focal == pytest.approx(60.0)
    assert wide.valid[0].mean() > 0.9


def test_cameras_that_are_not_a_stereo_pair_are_refused_in_a_sentence() -> None:
    def refused(
        right_T_left: F64 | None, match: str, rectified: bool = False, right: Camera | None = None
    ) -> None:
        with pytest.raises(LogError, match=match) as error:
            rectification(
                camera("plumb_bob"),
                right or camera("plumb_bob", 1),
                (HEIGHT, WIDTH),
                right_T_left,
                rectified=rectified,
            )
        assert str(error.value).endswith(".")

    def apart(metres: float) -> Camera:
        """A right camera of the same pinhole, so far beside the left one."""
        P = np.hstack([camera().K, [[-210.0 * metres], [0.0], [0.0]]])
        return camera("plumb_bob", 1, P=P)

    ahead = exp_se3(np.array([-0.2, 0.0, 0.0]), np.zeros(3))
    refused(
        None, "The transform between the cameras of /cam0/camera_info, /cam1/camera_info is unknown"
    )
    refused(np.eye(4), "The transform between the cameras of")
    refused(None, "no baseline in P and no transform", rectified=True)
    refused(inverse(ahead), "sits right of the other: exchange them")
    refused(
        exp_se3(np.array([-0.2, 0, 0]), np.array([0, 1.9, 0])),
        "not form a stereo pair: they would have to be turned by 109 deg",
    )
    refused(
        exp_se3(np.array([-0.01, -0.2, 0]), np.zeros(3)),
        "not form a stereo pair: they would have to be turned by 87 deg",
    )
    small = Camera(
        Header("/s", 0, 0, ""),
        8,
        6,
        camera().K,
        np.zeros(5),
        np.eye(3),
        np.zeros((3, 4)),
        "plumb_bob",
    )
    refused(ahead, "CameraInfo /s is for 8 x 6 pixels but the picture has 320 x 240", right=small)
    odd = Camera(
        Header("/o", 0, 0, ""),
        0,
        0,
        camera().K,
        np.array([0.1, 0.2]),
        np.eye(3),
        np.zeros((3, 4)),
        "double_sphere",
    )
    refused(ahead, "distortion model 'double_sphere' with 2 coefficients", right=odd)
    other = camera(
        "plumb_bob", 1, P=np.array([[400.0, 0, 160, -80], [0, 400, 120, 0], [0, 0, 1, 0]])
    )
    refused(None, "do not belong to one rectified pair", rectified=True, right=other)
    refused(None, "would be 120 m apart: P.* is not in metres", right=apart(120.0))
    refused(None, "would be 120 m apart", rectified=True, right=apart(120.0))
    refused(exp_se3(np.array([-120.0, 0, 0]), np.zeros(3)), "would be 120 m apart")
    for rectified in (False, True):
        words = "are 0.3 m apart by P of their CameraInfos and 0.2 m by the transforms"
        refused(ahead, words, rectified=rectified, right=apart(0.3))
    far_off = np.array([[210.0, 0, 1e5], [0, 210, 120], [0, 0, 1]])
    refused(ahead, "Nothing of the pictures is left", right=camera("plumb_bob", 1, K=far_off))
    refused(
        ahead, "calibrations of .* make no sense", right=camera("plumb_bob", 1, K=far_off * 100)
    )
    refused(
        ahead,
        "calibrations of .* make no sense",
        right=camera("plumb_bob", 1, R=np.diag([1.0, 1.0, -1.0])),
    )
    with pytest.raises(LogError, match="320 x 20 pixels: too few"):
        rectification(
            replace(camera(), height=20),
            replace(camera(), height=20),
            (20, WIDTH),
            ahead,
            rectified=False,
        )
    with pytest.raises(
        LogError, match="disparities of 399 pixels and more, too many for pictures 320 pixels wide"
    ):
        StereoMatcher(_unturned(240, 320, 1000.0, 4.0), min_range=0.3, max_range=10.0)


def test_numbers_at_random_give_a_sentence_or_points() -> None:
    """OpenCV crashes on some of what a damaged calibration may hold."""
    rng = np.random.default_rng(5)
    outcomes = set()
    for _ in range(150):
        width, height = (
            int(n) for n in rng.choice([1, 31, 32, 50, 130], 2, p=[0.1, 0.1, 0.2, 0.3, 0.3])
        )
        infos = []
        for side in (0, 1):
            K = (
                np.array([[40.0, 0, width / 2], [0, 40, height / 2], [0, 0, 1]])
                + (rng.random() < 0.3) * rng.normal(size=(3, 3)) * 30
            )
            D = rng.normal(size=int(rng.choice([0, 4, 5, 8, 14]))) * 10.0 ** rng.choice([-2, 0, 3])
            P = np.hstack([K, np.array([[-8.0 * side], [0.0], [0.0]])]) * 10.0 ** rng.choice(
                [0, 0, 0, 9]
            )
            model = str(rng.choice(list(MODELS)))
            infos.append(Camera(Header(f"/{side}", 0, 0, ""), 0, 0, K, D, np.eye(3), P, model))
        transform = exp_se3(
            np.array([-0.2, 0, 0]) + rng.normal(size=3) * 0.05,
            rng.normal(size=3) * rng.choice([0, 0.1]),
        )
        try:
            how = rectification(
                infos[0], infos[1], (height, width), transform, rectified=bool(rng.integers(2))
            )
            pictures = rng.integers(0, 255, (2, height, width)).astype(np.uint8)
            StereoMatcher(how, min_range=0.0, max_range=10.0).points(pictures[0], pictures[1])
            outcomes.add("points")
        except LogError:
            outcomes.add("sentence")
    assert outcomes == {"points", "sentence"}

"""Partners by time, reasons for leaving pairs out, and a real pair of cameras in a room."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.frames import Camera, Header, ImageFrame, PosedCloud
from semloc_logs.logs.inspection.inspect import inspect_log
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.logs.problems import NoCloud, lost, sentences
from semloc_logs.logs.roles import Roles
from semloc_logs.logs.sensors import stereo_pairs
from semloc_logs.logs.sensors.depth import LabelImages, RangePoints
from semloc_logs.logs.sensors.rectification import Rectification, rectification
from semloc_logs.logs.sensors.stereo_pairs import StereoClouds, _grey
from semloc_logs.logs.session.session import SessionOptions, open_session
from semloc_logs.logs.session.tally import Tally
from semloc_logs.mapping.keyframes import Collected
from semloc_logs.mapping.selection import thin
from semloc_logs.mapping.up_direction import find_up
from semloc_logs.numerics.transforms import apply, exp_se3

MS = 1_000_000
REAL = "logs/euroc_v101_stereo.bag"
LEFT, RIGHT = "/left/image_rect", "/right/image_rect"
ROLES = Roles(
    image=(LEFT,),
    stereo_left=LEFT,
    stereo_right=RIGHT,
    camera_info=("/l", "/r"),
    info_of={LEFT: "/l", RIGHT: "/r"},
    label_image=("/ids",),
    label_of={LEFT: "/ids"},
)


def info(topic: str, t: float = 0.0, width: int = 160) -> Camera:
    K = np.array([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]])
    P = np.hstack([K, np.array([[t], [0.0], [0.0]])])
    return Camera(Header(topic, 0, 0, topic), width, 120, K, np.zeros(5), np.eye(3), P, "plumb_bob")


def picture(topic: str, stamp_ns: int, shift: int = 0, width: int = 160) -> ImageFrame:
    grain = np.random.default_rng(0).integers(0, 255, (120, 400)).astype(np.uint8)
    return ImageFrame(
        Header(topic, stamp_ns, stamp_ns, topic), grain[:, 50 + shift : 50 + shift + width], "mono8"
    )


def clouds(
    roles: Roles = ROLES,
    right_T_left: F64 | None = None,
    cameras: Iterable[Camera] = (info("/l"), info("/r", -20.0)),
) -> StereoClouds:
    return StereoClouds(
        roles,
        {c.header.topic: c for c in cameras},
        LabelImages(roles),
        lambda right, left, stamp_ns: right_T_left,
    )


def test_partners_are_the_nearest_within_half_a_period() -> None:
    stereo = clouds()
    for k in range(4):
        stereo.take_left(picture(LEFT, k * 40 * MS))
        if k != 2:
            stereo.take_right(picture(RIGHT, (k * 40 + 3) * MS, 10))
    assert stereo.tolerance_ns == 20 * MS
    reasons = [stereo.points(picture(LEFT, k * 40 * MS), 0.3, 20.0) for k in range(4)]
    assert reasons[2] == NoCloud.NO_PARTNER
    for cloud in (reasons[0], reasons[1], reasons[3]):
        assert isinstance(cloud, RangePoints)
        # 100 px * 0.2 m / 10 px
        np.testing.assert_allclose(np.median(cloud.points[:, 2]), 2.0, atol=0.02)


def test_a_pair_waits_for_all_that_belongs_to_it() -> None:
    stereo = clouds(cameras=[info("/l")])
    left = picture(LEFT, 10 * MS)
    assert not stereo.has_all(left)
    stereo.take_right(picture(RIGHT, 9 * MS, 10))
    assert not stereo.has_all(left)  # a nearer one may still come
    stereo.take_right(picture(RIGHT, 12 * MS, 10))
    assert not stereo.has_all(left)
    stereo = clouds()
    stereo.take_right(picture(RIGHT, 12 * MS, 10))
    assert not stereo.has_all(left)  # the label image
    stereo._labels.take(
        ImageFrame(Header("/ids", 10 * MS, 0, ""), np.zeros((120, 160), np.uint8), "mono8")
    )
    assert stereo.has_all(left)


def test_labels_belong_to_the_left_pixels() -> None:
    stereo = clouds()
    ids = np.arange(120 * 160, dtype=np.uint16).reshape(120, 160)
    stereo._labels.take(ImageFrame(Header("/ids", 0, 0, ""), ids, "mono16"))
    stereo.take_right(picture(RIGHT, 0, 10))
    cloud = stereo.points(picture(LEFT, 0), 0.3, 20.0)
    assert isinstance(cloud, RangePoints)
    assert cloud.label is not None
    column = 100 * cloud.points[:, 0] / cloud.points[:, 2] + 80
    np.testing.assert_allclose(cloud.label % 160, column, atol=1e-3)


def test_memory_is_bounded_when_no_left_picture_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of 160 x 120 bytes; 80 of them may be kept."""
    monkeypatch.setattr(stereo_pairs, "MOST_KEPT_BYTES", 80 * 160 * 120)
    stereo = clouds()
    for k in range(500):
        stereo.take_right(picture(RIGHT, k * MS))
    assert len(stereo._rights) == 80
    assert stereo._bytes == sum(r.image.nbytes for r in stereo._rights)


@pytest.mark.parametrize(
    ("right", "cameras", "reason"),
    [
        (picture(RIGHT, 0, 10, width=120), [info("/l"), info("/r", -20.0)], NoCloud.OTHER_SIZE),
        (picture(RIGHT, 0, 10), [info("/r", -20.0)], NoCloud.NO_CALIBRATION),
        (picture(RIGHT, 0, 10), [info("/l")], NoCloud.NO_RIGHT_CALIBRATION),
        (picture(RIGHT, 0, 0), [info("/l"), info("/r", -20.0)], NoCloud.SAME_PICTURE),
        (picture(RIGHT, 0, 10), [info("/l"), info("/r")], NoCloud.UNUSABLE_PAIR),
        (picture(RIGHT, 0, 10), [info("/l"), info("/r", 20.0)], NoCloud.UNUSABLE_PAIR),
        (picture(RIGHT, 0, 10), [info("/l", width=99), info("/r", -20.0)], NoCloud.UNUSABLE_PAIR),
    ],
)
def test_why_a_pair_gives_nothing(
    right: ImageFrame, cameras: list[Camera], reason: NoCloud
) -> None:
    stereo = clouds(cameras=cameras)
    stereo.take_right(right)
    assert stereo.points(picture(LEFT, 0), 0.3, 20.0) == reason
    assert len(sentences(stereo.problems)) == (reason is NoCloud.UNUSABLE_PAIR)
    tally = Tally()
    tally.saw(LEFT)
    tally.leave_out(picture(LEFT, 0).header, reason)
    [sentence] = sentences(tally.problems(PoseTrack(), "base_link"))
    assert sentence.startswith(f"{LEFT}: 1 of 1 frames are left out: ")


def test_transforms_serve_where_the_infos_have_no_baseline() -> None:
    right_T_left = np.eye(4)
    right_T_left[0, 3] = -0.2
    for left, right in ((LEFT, RIGHT), ("/left/image_raw", "/right/image_raw")):
        roles = replace(
            ROLES, stereo_left=left, stereo_right=right, info_of={left: "/l", right: "/r"}
        )
        stereo = clouds(roles, right_T_left, [info("/l"), info("/r")])
        stereo.take_right(picture(right, 0, 10))
        cloud = stereo.points(picture(left, 0), 0.3, 20.0)
        assert isinstance(cloud, RangePoints)
        assert np.median(cloud.points[:, 2]) == pytest.approx(2.0, abs=0.02)


def test_colour_and_sixteen_bits_become_the_same_grey() -> None:
    grey = picture(LEFT, 0).image.astype(np.uint8)
    deep = grey.astype(np.uint16)
    for image in (np.stack([grey] * 3, axis=2), deep * np.uint16(16), deep * np.uint16(256)):
        a, b = _grey(image, image)
        np.testing.assert_array_equal(a, grey)
        np.testing.assert_array_equal(b, grey)


# -- a real pair


def planes(
    points: NDArray[np.floating], count: int, width: float = 0.05
) -> list[tuple[F64, float, float]]:
    """The largest planes one after the other, by RANSAC.

    Unit normal, root mean square (m) and share of the points within ``width``.
    """
    rng = np.random.default_rng(0)
    fitted = []
    rest = np.asarray(points, float)
    for _ in range(count):
        some = rest[rng.permutation(len(rest))[:3000]]
        best = (np.zeros(3), np.zeros(3))
        most = 0
        for _ in range(300):
            a, b, c = some[rng.integers(len(some), size=3)]
            normal = np.cross(b - a, c - a)
            if np.linalg.norm(normal) > 1e-4:
                normal /= np.linalg.norm(normal)
                inliers = int((np.abs((some - a) @ normal) < width).sum())
                best, most = ((normal, a), inliers) if inliers > most else (best, most)
        normal, centre = best
        for _ in range(3):
            close_points = rest[np.abs((rest - centre) @ normal) < width]
            centre = close_points.mean(axis=0)
            normal = np.linalg.svd((close_points - centre).T @ (close_points - centre))[2][-1]
        distance = (rest - centre) @ normal
        inside = np.abs(distance) < width
        fitted.append(
            (normal, float(np.sqrt(np.mean(distance[inside] ** 2))), inside.sum() / len(points))
        )
        rest = rest[~inside]
    return fitted


def in_world(cloud: PosedCloud) -> F64:
    assert cloud.session_T_base is not None
    return apply(cloud.session_T_base, cloud.points)


def tilt(normal: F64) -> float:
    """Degrees between a plane and the horizontal of a world whose z is up."""
    return float(np.rad2deg(np.arccos(min(abs(normal[2]), 1.0))))


def is_the_room(points: F64) -> bool:
    """A level, flat floor at the height of the world's origin, and upright walls.

    The walls are mattresses, some of which lean by 20 degrees.
    """
    floor, *walls = planes(points, 3)
    height = np.percentile(points[:, 2], 25)  # the floor is nearly half of the points
    is_floor = tilt(floor[0]) < 2.0 and floor[1] < 0.018 and floor[2] > 0.4 and abs(height) < 0.03
    return (
        bool(is_floor)
        and all(tilt(n) > 60 and rms < 0.03 for n, rms, _ in walls)
        and float(sum(share for *_, share in (floor, *walls))) > 0.68
    )


@pytest.fixture(scope="module")
def room(shared: Callable[[str], Path]) -> list[PosedCloud]:
    session = open_session([shared(REAL)], SessionOptions(max_range=10.0))
    clouds = list(session.clouds())
    assert lost(session.problems) == []
    session.close()
    return clouds


def test_the_floor_is_level_and_walls_are_planes_in_each_frame(room: list[PosedCloud]) -> None:
    assert len(room) == 32
    for cloud in room[::10]:
        assert len(cloud.points) > 50_000
        assert is_the_room(in_world(cloud))


def test_all_frames_together_are_the_same_room(room: list[PosedCloud]) -> None:
    points = np.vstack([in_world(cloud)[::8] for cloud in room])
    assert is_the_room(points)
    # the wall ahead, and the one to the left at a right angle to it as seen from above
    ahead = points[points[:, 1] < 3.9]
    left = points[points[:, 1] > 4.75]
    normals = [planes(part[part[:, 2] > 0.2], 1, 0.10)[0][0] for part in (ahead, left)]
    yaws = [np.rad2deg(np.arctan2(n[1], n[0])) for n in normals]
    assert abs((yaws[0] - yaws[1]) % 180 - 90) < 12


def test_sigma_of_a_real_floor(room: list[PosedCloud]) -> None:
    cloud = room[0]
    points = in_world(cloud)
    normal, _, _ = planes(points, 1)[0]
    low_points = points[np.abs(points[:, 2]) < 0.3]
    centre = np.median(
        low_points[np.abs(low_points @ normal - np.median(low_points @ normal)) < 0.05], axis=0
    )
    assert cloud.sigma is not None
    assert cloud.session_T_base is not None
    rays = points - apply(cloud.session_T_base, cloud.origin[None])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    off = (points - centre) @ normal / np.abs(rays @ normal)
    floor = np.abs((points - centre) @ normal) < 0.08
    normalised = off[floor] / cloud.sigma[floor]
    assert 0.6 < 1.4826 * np.median(np.abs(normalised - np.median(normalised))) < 1.5


@pytest.mark.parametrize("voxel", [0.03, 0.05, 0.1, 0.3])
def test_the_direction_of_gravity_is_found_at_every_voxel_size(
    room: list[PosedCloud], voxel: float, tmp_path: Path
) -> None:
    """Leaning mattresses and noise of several voxels do not make the floor a slope."""
    collected = Collected(tmp_path, voxel / 3)
    for cloud in room[:3]:
        collected.add(cloud, thin(cloud.points, voxel / 3))
    places = collected.flat_places().values()
    normals = np.concatenate([p.normals for p in places])
    up = find_up(normals, np.concatenate([p.weights for p in places]), np.array([0.0, 0.0, 1.0]))
    assert tilt(up) < 1.5


@pytest.mark.parametrize("turn", [(0.0, 0.01, 0.0), (0.01, 0.0, 0.0), (0.0, 0.0, 0.03)])
def test_the_room_would_not_be_there_with_a_wrong_rectification(
    shared: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch, turn: tuple[float, float, float]
) -> None:
    log = shared(REAL)

    def wrong(
        left: Camera,
        right: Camera,
        shape: tuple[int, int],
        right_T_left: F64 | None,
        *,
        rectified: bool,
    ) -> Rectification:
        assert right_T_left is not None
        return rectification(
            left,
            right,
            shape,
            exp_se3(np.zeros(3), np.array(turn)) @ right_T_left,
            rectified=rectified,
        )

    monkeypatch.setattr("semloc_logs.logs.sensors.stereo_pairs.rectification", wrong)
    session = open_session([log], SessionOptions(max_range=10.0))
    cloud = next(session.clouds(), None)
    session.close()
    assert cloud is None or len(cloud.points) < 20_000 or not is_the_room(in_world(cloud))


def test_inspect_names_the_roles(shared: Callable[[str], Path]) -> None:
    log = shared(REAL)
    content = inspect_log(log)
    assert content["problems"] == []
    streams = content["streams"]
    assert isinstance(streams, list)
    roles = {s["topic"]: s["role"] for s in streams}
    assert (roles["/cam0/image_raw"], roles["/cam1/image_raw"]) == ("stereo_left", "stereo_right")
    [sentence] = [
        p
        for p in _listed(inspect_log(log, {"tf_static": "none"})["problems"])
        if "The transform between the cameras" in p
    ]
    assert sentence.endswith(".")
    swapped = _listed(
        inspect_log(log, {"stereo_left": "/cam1/image_raw", "stereo_right": "/cam0/image_raw"})[
            "problems"
        ]
    )
    assert any("sits right of the other: exchange them" in p for p in swapped)


def _listed(value: object) -> list[str]:
    assert isinstance(value, list)
    return value

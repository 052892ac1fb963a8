import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.arrays import U8
from semloc_logs.simulation.conditions import Condition
from semloc_logs.simulation.meshes.world import BUILDING, ROAD, MeshBuilder, Scene, World, box
from semloc_logs.simulation.sensors.camera import CAMERAS, base_T_camera, first_hits, pixel_rays
from semloc_logs.simulation.sensors.noise import Octaves, octaves
from semloc_logs.simulation.sensors.rendered_images import Painter
from semloc_logs.simulation.sensors.surface_colours import road_plan, surfaces
from semloc_logs.simulation.town.street import build_street

STEREO = CAMERAS["stereo"]
PATH = np.column_stack([np.arange(0.0, 160.0), np.zeros(160)])


@pytest.fixture(scope="module")
def street() -> World:
    return build_street(PATH, 4)


@pytest.fixture(scope="module")
def painter(street: World) -> Painter:
    return Painter(Scene(street))


def pose(x: float) -> NDArray[np.float64]:
    world_T_base = np.eye(4)
    world_T_base[:2, 3] = x, -1.5
    return world_T_base @ base_T_camera(STEREO)


def inliers(a: U8, b: U8) -> int:
    sift = cv2.SIFT.create()
    grey = [cv2.cvtColor(i, cv2.COLOR_RGB2GRAY) for i in (a, b)]
    (ka, da), (kb, db) = (sift.detectAndCompute(g, None) for g in grey)
    good = [m for m, n in cv2.BFMatcher().knnMatch(da, db, k=2) if m.distance < 0.8 * n.distance]
    pa = np.array([ka[m.queryIdx].pt for m in good])
    pb = np.array([kb[m.trainIdx].pt for m in good])
    return int(cv2.findFundamentalMat(pa, pb, cv2.FM_RANSAC, 1.5, 0.999)[1].sum())


def test_neighbouring_pictures_match_and_others_do_not(painter: Painter) -> None:
    """More than 100 inliers from 1.5 m away, fewer than 30 from another place."""
    rng = np.random.default_rng(0)
    here, beside, elsewhere = (painter.picture(pose(x), rng, STEREO) for x in (30.0, 31.5, 110.0))
    assert here.shape == (360, 640, 3)
    assert here.dtype == np.uint8
    assert inliers(here, beside) > 100
    assert inliers(here, elsewhere) < 30


def test_depth_comes_back_from_a_pair(painter: Painter) -> None:
    rng = np.random.default_rng(1)
    left = pose(60.0)
    right = left.copy()
    right[:3, 3] += STEREO.baseline * left[:3, 0]
    hits = first_hits(painter.scene, left, pixel_rays(STEREO))
    pair = [painter.picture(left, rng, STEREO, hits=hits), painter.picture(right, rng, STEREO)]
    matcher = cv2.StereoSGBM.create(
        0, 112, 5, 200, 800, 1, 31, 10, 100, 2, mode=cv2.STEREO_SGBM_MODE_HH
    )
    disparity = matcher.compute(*(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY) for i in pair)) / 16
    is_matched = (disparity > 1) & np.isfinite(hits.depth)
    error = disparity[is_matched] - STEREO.focal * STEREO.baseline / hits.depth[is_matched]
    assert is_matched.sum() > 0.5 * np.isfinite(hits.depth).sum()
    assert abs(np.median(error)) < 0.2
    assert (np.abs(error) < 1).mean() > 0.7


def test_surfaces_keep_their_colours_between_sessions(street: World) -> None:
    other = build_street(PATH, 4, Condition(1))
    a = surfaces(street)
    b = surfaces(other)
    houses_a, houses_b = (
        set(s.seed[s.piece[w.labels == BUILDING]].tolist()) for s, w in ((a, street), (b, other))
    )
    assert houses_a == houses_b
    assert len(houses_a) > 5


def test_light_and_season_change_the_picture(painter: Painter) -> None:
    def mean(condition: Condition, label: int | None) -> NDArray[np.float64]:
        hits = first_hits(painter.scene, pose(30.0), pixel_rays(STEREO))
        picture = Painter(painter.scene, condition).picture(
            pose(30.0), np.random.default_rng(0), STEREO, hits=hits
        )
        return np.asarray(
            picture[hits.triangle < 0 if label is None else hits.labels == label].mean(0),
            np.float64,
        )

    summer, snow = (
        mean(Condition(season=season, daytime="overcast"), 9) for season in ("summer", "snow")
    )
    assert snow.mean() > summer.mean() + 30  # lawns
    evening = mean(Condition(daytime="evening"), None)
    noon = mean(Condition(), None)
    # redder sky, though it is nearly white where the sun stands
    assert evening[0] - evening[2] > noon[0] - noon[2] + 10


def test_a_box_casts_a_shadow() -> None:
    builder = MeshBuilder(lambda x, y: np.zeros_like(x))
    builder.add(box(60, 60, 0.5, z=-0.5), ROAD, ground="none")
    # the sun of noon stands behind it
    builder.add(box(40, 1, 10, x=20, y=-6), BUILDING, ground="none")
    painter = Painter(Scene(builder.build()))
    camera = base_T_camera(STEREO)
    picture = painter.picture(camera, np.random.default_rng(0), STEREO).mean(2)
    # the shadow is 10 / tan(0.9) = 7.9 m long
    dark = picture[330, 560:600].mean()
    bright = picture[330, 40:80].mean()
    assert dark < 0.7 * bright


def test_noise_fades_with_the_size_of_the_pixel() -> None:
    points = np.random.default_rng(0).uniform(-50, 50, (2000, 3)).astype(np.float32)
    fine, far = (
        octaves(points, np.full(2000, f, np.float32), Octaves(1.0, 4, 0.8), 3) for f in (0.001, 3.0)
    )
    assert 0.2 < fine.std() < 1.5
    assert abs(fine.mean()) < 0.1
    assert not far.any()


def test_the_plan_knows_kerb_and_middle(street: World) -> None:
    plan = road_plan(street)
    column, row = ((np.array([80.0, 0.0]) - plan.corner) / plan.cell).astype(int)
    half = plan.half_width[row, column]
    assert 2.0 < half < 8.0
    assert abs(plan.beside[row, column] - half) < 0.5

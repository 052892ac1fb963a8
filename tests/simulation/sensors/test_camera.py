from dataclasses import replace

import numpy as np
import pytest

from semloc_logs.simulation.meshes.world import POLE, ROAD, WALL, MeshBuilder, Scene, box
from semloc_logs.simulation.sensors.camera import (
    CAMERAS,
    base_T_camera,
    camera_points,
    depth_frame,
    first_hits,
    pixel_rays,
)

STEREO = CAMERAS["stereo"]


@pytest.fixture(scope="module")
def yard() -> Scene:
    """A floor, a wall whose face is at x = 10, and a pole 0.4 m thick whose face is at x = 4."""
    builder = MeshBuilder(lambda x, y: np.zeros_like(x))
    builder.add(box(200, 200, 0.5, z=-0.5), ROAD, ground="none")
    builder.add(box(0.5, 60, 20, x=10.25), WALL, ground="none")
    builder.add(box(0.4, 0.4, 6, x=4.2), POLE, ground="none")
    return Scene(builder.build())


def test_mounting_turns_the_camera_to_the_left() -> None:
    ahead = base_T_camera(STEREO)
    assert np.allclose(ahead[:3, :3] @ [0, 0, 1], [1, 0, 0])
    assert np.allclose(ahead[:3, :3] @ [1, 0, 0], [0, -1, 0])
    left = base_T_camera(replace(STEREO, yaw=np.pi / 2))
    assert np.allclose(left[:3, :3] @ [0, 0, 1], [0, 1, 0])
    assert np.allclose(left[:3, :3] @ [0, 1, 0], [0, 0, -1])
    assert left[2, 3] == STEREO.mount_height


def test_errors_of_depth_grow_with_its_square(yard: Scene) -> None:
    model = replace(STEREO, bleed=0)
    for distance in (6.0, 12.0, 24.0):
        world_T_base = np.eye(4)
        world_T_base[:2, 3] = 9.7 - distance, 15.0  # beside the pole; the camera is 0.3 m ahead
        frame = depth_frame(
            yard, world_T_base @ base_T_camera(model), np.random.default_rng(0), model
        )
        wall = (frame.depth > 0) & (frame.label_image == WALL)
        error = frame.depth[wall] - distance
        expected = distance**2 * 0.25 / (320 * 0.5)
        assert abs(np.median(error)) < 0.3 * expected
        spread = 1.4826 * np.median(np.abs(error)) / expected
        assert 0.7 < spread < 1.3
        assert np.corrcoef(error[:-1], error[1:])[0, 1] > 0.6  # neighbours are wrong alike


def test_shadow_lies_to_the_left_of_what_is_near(yard: Scene) -> None:
    """Focal length 320, baseline 0.5: the pole's disparity is 320 * 0.5 / 3.7, the wall's 320 * 0.5
    / 9.7; the difference is 26.7 px.
    """
    model = replace(STEREO, bleed=0, disparity_noise=0.0)
    pose = base_T_camera(model)
    frame = depth_frame(yard, pose, np.random.default_rng(0), model)
    row = slice(120, 160)
    edge = int(np.flatnonzero(frame.label_image[140] == POLE)[0])
    width = int((frame.label_image[140] == POLE).sum())
    hole = frame.depth[row] == 0
    assert hole[:, edge - 26 : edge - 26 + width - 8][:, : 26 - 2].mean() > 0.95
    assert hole[:, edge + width + 4 : edge + width + 40].mean() < 0.5
    assert hole[:, : int(320 * 0.5 / 9.7)].all()  # the right picture does not reach there


def test_near_surfaces_bleed_over_far_ones(yard: Scene) -> None:
    model = replace(STEREO, disparity_noise=0.0)
    pose = base_T_camera(model)
    seen = first_hits(yard, pose, pixel_rays(model))
    frame = depth_frame(yard, pose, np.random.default_rng(0), model)
    true = (seen.labels[100:170] == POLE).sum(1).mean()
    measured = ((frame.depth > 3) & (frame.depth < 4.2))[100:170].sum(1).mean()
    assert true + 1 < measured < true + 2 * model.bleed + 1


def test_points_and_labels_are_those_of_the_images(yard: Scene) -> None:
    model = replace(CAMERAS["depth"], disparity_noise=0.0, bleed=0)
    pose = base_T_camera(model)
    frame = depth_frame(yard, pose, np.random.default_rng(1), model)
    assert np.array_equal(frame.labels, frame.label_image[frame.depth > 0])
    assert np.allclose(frame.points[:, 2], frame.depth[frame.depth > 0])
    assert (frame.depth <= model.max_range).all()
    world = frame.points @ pose[:3, :3].T + pose[:3, 3]
    assert np.abs(world[frame.labels == ROAD, 2]).max() < 1e-3
    assert np.abs(world[frame.labels == WALL, 0] - 10).max() < 1e-3
    assert (frame.labels == POLE).any()
    assert len(frame.sigma) == len(frame.points)


def test_a_thinned_cloud_is_in_the_base_frame(yard: Scene) -> None:
    model = replace(CAMERAS["depth"], disparity_noise=0.0, bleed=0, yaw=-np.pi / 2 + 0.9)
    world_T_base = np.eye(4)
    world_T_base[:2, 3] = 7.0, 5.0
    points, origin, labels, sigma = camera_points(
        yard, world_T_base, np.random.default_rng(2), model
    )
    assert points.dtype == origin.dtype == sigma.dtype == np.float32
    assert labels.dtype == np.uint8
    assert np.abs(points[labels == WALL, 0] - 3).max() < 1e-3
    assert np.abs(points[labels == ROAD, 2]).max() < 1e-3
    again = camera_points(yard, world_T_base, np.random.default_rng(2), model)[0]
    assert np.array_equal(points, again)


def test_what_moves_hides_what_stands(yard: Scene) -> None:
    builder = MeshBuilder(lambda x, y: np.zeros_like(x))
    builder.add(box(1.0, 8.0, 3.0, x=3.0), 14, ground="none")
    frame = depth_frame(
        yard,
        base_T_camera(STEREO),
        np.random.default_rng(0),
        STEREO,
        traffic=Scene(builder.build()),
        step=2,
    )
    assert frame.depth.shape == (180, 320)
    assert not (frame.labels == POLE).any()
    assert (frame.labels == 14).any()

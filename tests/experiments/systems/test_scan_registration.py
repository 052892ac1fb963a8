from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semloc_logs.experiments.systems.scan_registration import (
    Contexts,
    DensityMaps,
    ScanSystem,
    fit_on_points,
    gicp,
    kiss_matcher,
    level_pose,
    make_kiss_matcher,
    make_map_closures,
    make_scan_context,
)
from semloc_logs.numerics.transforms import (
    apply,
    exp_se3,
    inverse,
    rotation_angle,
    yaw_transform,
)


def test_a_level_pose_keeps_heading_and_place() -> None:
    tilted = yaw_transform(0.7, (1.0, 2.0, 3.0)) @ exp_se3(np.zeros(3), np.array([0.1, 0.0, 0.0]))
    level = level_pose(tilted)
    np.testing.assert_allclose(level, yaw_transform(0.7, (1.0, 2.0, 3.0)), atol=1e-9)


@pytest.mark.parametrize("name", ["own", "small_gicp", "kiss_matcher"])
def test_a_turned_cloud_is_registered(name: str, town: Any) -> None:
    if name != "own":
        pytest.importorskip(name)
    register = {"own": lambda: fit_on_points, "small_gicp": gicp, "kiss_matcher": kiss_matcher}
    points = town.view(yaw_transform(0.0, (20.0, 0.0, 0.0)), 0, False).points.astype(np.float64)
    target_T_query = yaw_transform(0.15, (0.8, -0.5, 0.1))
    query = (points - target_T_query[:3, 3]) @ target_T_query[:3, :3]
    pose, score = register[name]()(points, query, np.eye(4))
    assert score > 0.9
    assert np.linalg.norm(pose[:3, 3] - target_T_query[:3, 3]) < 0.1
    assert rotation_angle(pose[:3, :3] @ target_T_query[:3, :3].T) < 0.01


@pytest.mark.parametrize("make", [make_scan_context, make_kiss_matcher, make_map_closures])
@pytest.mark.parametrize("yaw", [0.1, 3.0])
def test_a_turned_query_is_localised(
    make: Any, yaw: float, point_drive: Any, options: Any, errors: Any
) -> None:
    needed = {make_kiss_matcher: "kiss_matcher", make_map_closures: "map_closures"}
    if make in needed:
        pytest.importorskip(needed[make])
    system = make(options)
    system.fit(point_drive.database)
    truth = yaw_transform(yaw, (20.3, 0.2, 0.0))
    poses = system.localise(point_drive.query_at(truth))
    assert [p.score for p in poses] == sorted((p.score for p in poses), reverse=True)
    metres, degrees = errors(poses[0], truth)
    assert metres < 0.5
    assert degrees < 3.0


def test_a_registration_that_fails_gives_no_pose(point_drive: Any, tmp_path: Path) -> None:
    system = ScanSystem("none", Contexts, lambda target, query, start: (start, 0.0), 3, tmp_path)
    system.fit(point_drive.database[:4])
    assert system.localise(point_drive.query_at(np.eye(4))) == []
    assert any(tmp_path.glob("*/*.npy"))
    del system
    assert not any(tmp_path.iterdir())


def test_density_maps_find_the_scan_and_the_turn_but_none_of_the_queries(town: Any) -> None:
    pytest.importorskip("map_closures")
    places = DensityMaps()
    scans = [
        town.view(yaw_transform(0.0, (x, 0.0, 0.0)), 0, False).points for x in (0.0, 15.0, 30.0)
    ]
    for scan in scans:
        places.add(scan)
    scan_T_points = yaw_transform(1.2, (0.5, -0.4, 0.0))
    turned = apply(inverse(scan_T_points), scans[1]).astype(np.float32)
    for _ in range(3):  # the library knows the first query by the second time
        (number, scan_T_query), *_ = places.nearest(turned, 2)
        assert number == 1
        off = inverse(scan_T_points) @ scan_T_query
        assert np.linalg.norm(off[:2, 3]) < 1.0  # two cells of the map
        assert rotation_angle(off[:3, :3]) < 0.05
    assert all(number < 3 for number, _ in places.nearest(turned, 20))

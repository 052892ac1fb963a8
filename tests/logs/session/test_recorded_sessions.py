"""Sessions over recorded logs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from semloc_logs.logs.session.session import SessionOptions, open_session
from semloc_logs.numerics.transforms import rotation_angle


class TestRecordedLogs:
    def test_basement_has_a_pose_for_every_sweep(self, shared: Callable[[str], Path]) -> None:
        for name, count in (("basement_a.mcap", 88), ("basement_b.bag", 87)):
            session = open_session([shared(f"logs/{name}")])
            clouds = list(session.clouds())
            assert len(clouds) == count
            assert all(c.session_T_base is not None for c in clouds)
            assert (session.base_frame, session.session_frame, session.problems) == (
                "base_link",
                "odom",
                [],
            )
            session.close()

    def test_the_two_basements_meet_in_their_common_frame(
        self, shared: Callable[[str], Path]
    ) -> None:
        """The last sweep of a and the first of b, within a second, show the same hall."""
        from scipy.spatial import cKDTree

        truth = json.loads(shared("logs/basement_truth.json").read_text())
        halls = []
        for name, which in (("basement_a.mcap", -1), ("basement_b.bag", 0)):
            session = open_session([shared(f"logs/{name}")])
            cloud = list(session.clouds())[which]
            assert cloud.session_T_base is not None
            pose = np.array(truth[name]["T_common_session"]) @ cloud.session_T_base
            halls.append(cloud.points @ pose[:3, :3].T + pose[:3, 3])
            session.close()
        distance, _ = cKDTree(halls[0]).query(halls[1][::20])
        assert np.median(distance) < 0.1

    @pytest.mark.parametrize("name", ["room_a.mcap", "room_b"])
    def test_room_depth_frames_overlap(self, shared: Callable[[str], Path], name: str) -> None:
        """Neighbouring depth images, put together by their poses, show the same surfaces."""
        from scipy.spatial import cKDTree

        session = open_session([shared(f"logs/{name}")], SessionOptions(stride=8))
        worlds = []
        for cloud, _ in zip(session.clouds(), range(6), strict=False):
            assert cloud.session_T_base is not None
            worlds.append(
                cloud.points @ cloud.session_T_base[:3, :3].T + cloud.session_T_base[:3, 3]
            )
        assert session.base_frame == "camera_optical"
        distance, _ = cKDTree(worlds[0]).query(worlds[-1])
        assert np.median(distance) < 0.04
        session.close()

    def test_kitti_sweeps_have_labels_and_one_pose(self, shared: Callable[[str], Path]) -> None:
        session = open_session([shared("logs/kitti00_000052.mcap")])
        (cloud,) = session.clouds()
        assert cloud.label is not None
        assert len(cloud.label) == len(cloud.points) > 100_000
        assert cloud.session_T_base is not None
        assert rotation_angle(cloud.session_T_base[:3, :3]) == 0.0

    def test_a_drive_without_poses(self, shared: Callable[[str], Path]) -> None:
        session = open_session([shared("logs/kitti_drive_camera_lidar.mcap")])
        pictures: list[int] = []
        clouds = list(session.clouds(on_image=lambda image: pictures.append(image.header.stamp_ns)))
        assert len(clouds) == len(pictures) == 24
        assert all(c.session_T_base is None for c in clouds)
        assert session.base_frame == "velodyne"
        assert "camera_left" in session.base_T_sensors()
        assert len(session.problems) == 1
        session.close()

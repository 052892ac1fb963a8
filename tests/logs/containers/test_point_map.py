"""A map of points as a log: what a session makes of it."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from semloc_logs.errors import LogError
from semloc_logs.frames import LidarFrame
from semloc_logs.logs.containers.open import open_log
from semloc_logs.logs.poses.trajectory_file import TrajectoryFile
from semloc_logs.logs.session.session import SessionOptions, open_session


def write_map(path: Path) -> np.ndarray:
    """A floor of 30 m x 10 m and a wall at its side, as PCD text."""
    x, y = np.meshgrid(np.arange(0, 30, 0.2), np.arange(0, 10, 0.2), indexing="ij")
    floor = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    x, z = np.meshgrid(np.arange(0, 30, 0.2), np.arange(0.2, 4, 0.2), indexing="ij")
    wall = np.stack([x.ravel(), np.full(x.size, 10.0), z.ravel()], 1)
    points = np.concatenate([floor, wall])
    lines = "\n".join(f"{x:.3f} {y:.3f} {z:.3f}" for x, y, z in points.tolist())
    path.write_text(
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA ascii\n{lines}\n"
    )
    return points


def nearest(points: np.ndarray, cloud: np.ndarray) -> float:
    """The largest distance of a cloud's points from the map."""
    return float(
        max(np.linalg.norm(points - point, axis=1).min() for point in cloud[:: len(cloud) // 50])
    )


def test_clouds_of_a_tour_lie_on_the_map(tmp_path: Path) -> None:
    path = tmp_path / "hall.pcd"
    points = write_map(path)
    with closing(open_session([path])) as session:
        clouds = list(session.clouds())
        assert len(clouds) >= 4
        assert session.problems == []
        for cloud in clouds:
            assert cloud.session_T_base is not None
            pose = cloud.session_T_base
            assert nearest(points, cloud.points @ pose[:3, :3].T + pose[:3, 3]) < 0.01


@pytest.mark.parametrize("times", [False, True])
def test_a_trajectory_gives_the_places_that_it_is_seen_from(tmp_path: Path, times: bool) -> None:
    path = tmp_path / "hall.pcd"
    write_map(path)
    trajectory = tmp_path / "poses.txt"
    x = np.arange(2.0, 20.0, 0.5)
    rows = [
        f"{100 + k} {v} 5 1.5 0 0 0 1" if times else f"1 0 0 {v} 0 1 0 5 0 0 1 1.5"
        for k, v in enumerate(x.tolist())
    ]
    trajectory.write_text("\n".join(rows) + "\n")
    options = SessionOptions(poses=TrajectoryFile(trajectory))
    with closing(open_session([path], options)) as session:
        clouds = list(session.clouds())
    places = [cloud.session_T_base[:3, 3].tolist() for cloud in clouds]  # type: ignore[index]
    # with times one every metre, else one for each pose
    assert places == [[v, 5.0, 1.5] for v in (x[::2] if times else x).tolist()]


def test_topics_and_sections_have_all_messages_once(tmp_path: Path) -> None:
    path = tmp_path / "hall.pcd"
    write_map(path)
    with closing(open_log(path)) as log:
        counts = {s.topic: s.count for s in log.streams}
        of_sections = [m for section in log.sections() for m in section.messages(None)]
        assert [(m.topic, m.log_time_ns) for m in of_sections] == [
            (m.topic, m.log_time_ns) for m in log.messages()
        ]
        stamps = [m.log_time_ns for m in of_sections]
        assert stamps == sorted(stamps)
        topics = [m.topic for m in of_sections]
        assert {topic: topics.count(topic) for topic in counts} == counts
        frames = list(log.frames(["/stations/points"]))
        assert len(frames) == counts["/stations/points"]
        assert all(isinstance(frame, LidarFrame) for frame in frames)


def test_a_map_without_ground_is_refused_with_its_name(tmp_path: Path) -> None:
    path = tmp_path / "dot.pcd"
    path.write_text(
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        "WIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n0 0 0\n"
    )
    with pytest.raises(LogError, match=r"dot\.pcd cannot be used as a map"):
        open_log(path)

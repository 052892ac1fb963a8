"""Data sets as logs: small folders of exactly their layout, written byte by byte."""

from __future__ import annotations

import json
import struct
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from semloc_logs.errors import LogError, SettingsError
from semloc_logs.evaluation.truth import read_tum
from semloc_logs.experiments.datasets.conversion import import_dataset
from semloc_logs.frames import ImageFrame, PosedCloud
from semloc_logs.logs.session.session import Session, open_session
from semloc_logs.numerics.transforms import apply, inverse

# a wall 10 m ahead, 2 m to the left, 1 m up, and ground below
POINTS = [(10.0, 2.0, 1.0), (10.0, -2.0, 1.0), (5.0, 0.0, -1.7), (6.0, 3.0, -1.7)]
# KITTI's cameras look along the LIDAR's x axis: x right, y down, z ahead
TR = "0 -1 0 0 0 0 -1 0 1 0 0 -0.3"
FOCAL = 100.0


def picture(path: Path, colour: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((30, 40, 3), colour, np.uint8))


def write_kitti(root: Path, *, semantic: bool = False) -> None:
    """Three frames, 1 m apart along the camera's axis."""
    sequence = root / "sequences" / "04"
    (sequence / "velodyne").mkdir(parents=True)
    projections = [f"{FOCAL} 0 20 {x} 0 {FOCAL} 15 0 0 0 1 0" for x in (0.0, -54.0, 6.0, -48.0)]
    lines = [f"P{k}: {text}" for k, text in enumerate(projections)]
    (sequence / "calib.txt").write_text("\n".join([*lines, f"Tr: {TR}"]) + "\n")
    (sequence / "times.txt").write_text("0.000000e+00\n1.000000e-01\n2.000000e-01\n")
    poses = "".join(f"1 0 0 0 0 1 0 0 0 0 1 {k}\n" for k in range(3))
    for number in range(3):
        data = b"".join(struct.pack("<4f", *point, 0.5) for point in POINTS)
        (sequence / "velodyne" / f"{number:06d}.bin").write_bytes(data)
        picture(sequence / "image_2" / f"{number:06d}.png", 10 * number)
        picture(sequence / "image_3" / f"{number:06d}.png", 10 * number)
        if semantic:
            (sequence / "labels").mkdir(exist_ok=True)
            ids = struct.pack("<4I", 50, 50, 40, 40 | (7 << 16))
            (sequence / "labels" / f"{number:06d}.label").write_bytes(ids)
    if semantic:
        (sequence / "poses.txt").write_text(poses)
    else:
        (root / "poses").mkdir()
        (root / "poses" / "04.txt").write_text(poses)


def clouds_of(log: Path) -> tuple[Session, list[PosedCloud], list[ImageFrame]]:
    images: list[ImageFrame] = []
    with closing(open_session([log])) as session:
        clouds = list(session.clouds(images.append))
        return session, clouds, images


def test_kitti_odometry(tmp_path: Path) -> None:
    write_kitti(tmp_path / "dataset")
    truth, (log,) = import_dataset("kitti", tmp_path / "dataset", tmp_path / "out")
    assert log.name == "kitti_04.mcap"
    assert json.loads(truth.read_text()) == {"kitti_04.mcap": {"trajectory": "kitti_04.tum"}}

    session, clouds, images = clouds_of(log)
    assert session.problems == []
    lidar = [c for c in clouds if c.header.topic == "/lidar/points"]
    assert [len(c.points) for c in lidar] == [4, 4, 4]
    assert np.allclose(lidar[0].points, POINTS)
    # the camera went along its z axis: the LIDAR along its x axis, 1 m a tenth of a second
    first = lidar[0].session_T_base
    second = lidar[1].session_T_base
    assert first is not None
    assert second is not None
    assert np.allclose(first, np.eye(4), atol=1e-9)
    assert np.allclose(second[:3, 3], (1.0, 0.0, 0.0), atol=1e-9)
    assert lidar[1].header.stamp_ns - lidar[0].header.stamp_ns == 100_000_000

    poses, known = read_tum(log.with_suffix(".tum")).at(
        np.array([c.header.stamp_ns for c in lidar])
    )
    assert known.all()
    assert np.allclose(poses[2][:3, 3], (2.0, 0.0, 0.0), atol=1e-8)
    assert len(images) == 6


def test_kittis_points_fall_into_its_pictures_where_its_projection_puts_them(
    tmp_path: Path,
) -> None:
    write_kitti(tmp_path / "dataset")
    _, (log,) = import_dataset("kitti", tmp_path / "dataset", tmp_path / "out")
    session, _, _ = clouds_of(log)
    tr = np.vstack([np.array(TR.split(), float).reshape(3, 4), [0, 0, 0, 1]])
    for name, offset in (("left", 6.0), ("right", -48.0)):
        P = np.array([[FOCAL, 0, 20, offset], [0, FOCAL, 15, 0], [0, 0, 1, 0]])
        expected = P @ tr @ np.append(POINTS[0], 1.0)
        camera_T_base = inverse(session.base_T_sensors()[f"camera_{name}_optical"])
        K = session.cameras[f"/camera/{name}/image_rect/compressed"].K
        projected = K @ apply(camera_T_base, np.array([POINTS[0]]))[0]
        assert projected[:2] / projected[2] == pytest.approx(expected[:2] / expected[2])
    right = session.cameras["/camera/right/image_rect/compressed"]
    # 54 / 100 m to the right of the left one
    assert right.P[0, 3] == pytest.approx(-54.0)


def test_semantickitti_has_its_labels_and_names_their_space(tmp_path: Path) -> None:
    write_kitti(tmp_path / "dataset", semantic=True)
    _, (log,) = import_dataset("semantickitti", tmp_path / "dataset", tmp_path / "out")
    session, clouds, _ = clouds_of(log)
    cloud = next(c for c in clouds if c.header.topic == "/lidar/points")
    assert cloud.label is not None
    assert (cloud.label & 0xFFFF).tolist() == [50, 50, 40, 40]
    assert cloud.label[3] >> 16 == 7
    assert session.label_names["/lidar/points"].space == "semantickitti"


def test_nclt(tmp_path: Path) -> None:
    session_folder = tmp_path / "2012-01-08"
    (session_folder / "velodyne_sync").mkdir(parents=True)
    first = 1_326_030_975_726_043
    utimes = [first + 200_000 * k for k in range(3)]
    for utime in utimes:
        hits = [
            # x ahead, y right, z down
            struct.pack("<3H2B", *(round((v + 100.0) / 0.005) for v in (x, -y, -z)), 90, 3)
            for x, y, z in POINTS
        ]
        (session_folder / "velodyne_sync" / f"{utime}.bin").write_bytes(b"".join(hits))
    # the body drives east: heading 90 degrees in a world north, east, down
    rows = [
        f"{utimes[0] - 100_000 + 100_000 * k},0.0,{0.5 * k},2.0,0.0,0.0,{np.pi / 2}\n"
        for k in range(7)
    ]
    (tmp_path / "groundtruth_2012-01-08.csv").write_text(
        f"{utimes[0] - 200_000}" + ",NaN" * 6 + "\n" + "".join(rows)
    )
    odometry = [f"{utimes[0] - 100_000 + 100_000 * k},{0.5 * k},0,0,0,0,0\n" for k in range(7)]
    (session_folder / "odometry_mu_100hz.csv").write_text("".join(odometry))

    _, (log,) = import_dataset("nclt", session_folder, tmp_path / "out")
    assert log.name == "nclt_2012-01-08.mcap"
    session, clouds, _ = clouds_of(log)
    assert session.problems == []
    assert np.allclose(clouds[0].points, POINTS, atol=0.0026)
    assert clouds[0].header.stamp_ns == utimes[0] * 1000
    assert clouds[0].session_T_base is not None
    assert np.allclose(clouds[0].session_T_base[:3, 3], (0.5, 0, 0), atol=1e-6)

    (pose,), known = read_tum(log.with_suffix(".tum")).at(np.array([utimes[1] * 1000]))
    assert known.all()
    # east is to the right of north: y of a world with z up is west
    assert np.allclose(pose[:3, 3], (0.0, -1.5, -2.0), atol=1e-6)
    assert np.allclose(pose[:3, 0], (0.0, -1.0, 0.0), atol=1e-6)
    assert np.allclose(pose[:3, 2], (0.0, 0.0, 1.0), atol=1e-6)


def test_boreas(tmp_path: Path) -> None:
    sequence = tmp_path / "boreas-2021-08-05-13-34"
    (sequence / "lidar").mkdir(parents=True)
    (sequence / "applanix").mkdir()
    (sequence / "calib").mkdir()
    utimes = [1_628_184_840_000_000 + 100_000 * k for k in range(3)]
    rows = ["GPSTime,easting,northing,altitude,vx,vy,vz,roll,pitch,heading,wz,wy,wx"]
    for k, utime in enumerate(utimes):
        # the middle of a sweep; points begin 50 ms before
        times = (-0.05, -0.02, 0.0, 0.049)
        data = [struct.pack("<6f", *p, 1.0, 3.0, t) for p, t in zip(POINTS, times, strict=True)]
        (sequence / "lidar" / f"{utime}.bin").write_bytes(b"".join(data))
        rows.append(f"{utime},{k},2.0,3.0,10,0,0,0.0,0.0,{-np.pi / 2},0,0,0")
        picture(sequence / "camera" / f"{utime}.png", 7)
    (sequence / "applanix" / "lidar_poses.csv").write_text("\n".join(rows) + "\n")
    (sequence / "calib" / "P_camera.txt").write_text(
        f"{FOCAL} 0 20 0\n0 {FOCAL} 15 0\n0 0 1 0\n0 0 0 1\n"
    )
    (sequence / "calib" / "T_camera_lidar.txt").write_text(
        "0 -1 0 0\n0 0 -1 -0.3\n1 0 0 0\n0 0 0 1\n"
    )

    _, (log,) = import_dataset("boreas", tmp_path, tmp_path / "out")
    assert log.name == "boreas_2021_08_05_13_34.mcap"
    session, clouds, images = clouds_of(log)
    assert len(images) == 3
    stamps = [c.header.stamp_ns for c in clouds]
    # of 32 bits in the data set
    assert abs(stamps[1] - (utimes[1] * 1000 - 50_000_000)) <= 2
    (pose,), _ = read_tum(log.with_suffix(".tum")).at(np.array([utimes[2] * 1000]))
    assert np.allclose(pose[:3, 3], (2.0, 2.0, 3.0))
    # a yaw of -90 degrees turns the sensor's x axis to the north, as Rz(-yaw) does
    assert np.allclose(pose[:3, 0], (0.0, 1.0, 0.0), atol=1e-9)
    assert np.allclose(session.base_T_sensors()["camera_front_optical"][:3, 3], (0, 0, -0.3))


def test_a_second_import_adds_to_the_truth_file(tmp_path: Path) -> None:
    write_kitti(tmp_path / "one")
    write_kitti(tmp_path / "two", semantic=True)
    import_dataset("kitti", tmp_path / "one", tmp_path / "out")
    truth, _ = import_dataset("semantickitti", tmp_path / "two", tmp_path / "out")
    assert sorted(json.loads(truth.read_text())) == ["kitti_04.mcap", "semantickitti_04.mcap"]


def test_faults_are_named(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="Did you mean 'kitti'"):
        import_dataset("kiti", tmp_path, tmp_path / "out")
    with pytest.raises(LogError, match=r"has no sequences/NN/ with velodyne/ and poses/NN\.txt"):
        import_dataset("kitti", tmp_path, tmp_path / "out")
    with pytest.raises(LogError, match="is not a folder"):
        import_dataset("nclt", tmp_path / "absent", tmp_path / "out")
    write_kitti(tmp_path / "dataset")
    broken = tmp_path / "dataset/sequences/04/velodyne/000001.bin"
    broken.write_bytes(broken.read_bytes()[:-3])
    with pytest.raises(LogError, match="has 61 bytes, not a multiple of 16"):
        import_dataset("kitti", tmp_path / "dataset", tmp_path / "out")
    assert not list((tmp_path / "out").glob("*.mcap"))

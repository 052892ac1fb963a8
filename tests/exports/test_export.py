"""Exports of hand-made sessions, checked number by number."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semloc_logs.errors import WorkspaceError
from semloc_logs.exports import Selection, export
from semloc_logs.logs.annotation.annotate import encoder_for
from semloc_logs.logs.annotation.channels import Encoding, LogFacts
from semloc_logs.logs.annotation.scene import Cloud
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.tables import contracts
from semloc_logs.tables.table import write_json, write_table
from semloc_logs.voxels.store import pose_columns
from semloc_logs.workspace import Workspace

METADATA = {"schema_version": 1}


def _session(work: Workspace, name: str, poses: np.ndarray[Any, Any]) -> None:
    """Keyframes at 0, 1, ... s; the map frame lies 100 m along x in the session frame."""
    folder = work.session(name)
    n = len(poses)
    session_T_map = yaw_transform(0.0, (100.0, 0.0, 0.0))
    stamps = 1_500_000_000 + np.arange(n) * 10**9
    columns: dict[str, Any] = {"stamp_ns": stamps, **pose_columns(poses)}
    trajectory = {"stamp_ns": stamps, **pose_columns(session_T_map @ poses)}
    write_table(folder.trajectory, contracts.table("trajectory", trajectory), METADATA)
    frames = {
        **columns,
        "keyframe": np.arange(n),
        "log_time_ns": stamps,
        "topic": ["/points"] * n,
        "posed": [True] * n,
        "distance": np.arange(n, dtype=float),
        "ground_z": np.zeros(n),
        "points": np.zeros(n, int),
        **{f"{name}_{c}": np.zeros(n, np.float32) for name in ("origin", "view") for c in "xyz"},
    }
    write_table(folder.frames, contracts.table("frames", frames), METADATA)
    voxels = {
        "ix": [0, 2],
        "iy": [1, 1],
        "iz": [-1, 0],
        "label": [2, 255],
        "occupancy": [1.0, 2.0],
        "hits": [3, 4],
    }
    write_table(
        folder.voxels / "tile=0_0/part-0.parquet", contracts.table("voxels", voxels), METADATA
    )
    write_json(
        folder.session_json,
        {"posed": True, "session_T_map": session_T_map.tolist(), "voxel_size": 0.5},
    )


@pytest.fixture
def work(tmp_path: Path) -> Workspace:
    work = Workspace(tmp_path / "work")
    _session(work, "a", np.array([yaw_transform(0.0, (x, 0.0, 0.0)) for x in (0.0, 3.0)]))
    _session(
        work, "b", np.array([yaw_transform(np.pi / 2, (x, 0.0, 0.0)) for x in (0.0, 1.0, 2.0)])
    )
    return work


def _close(work: Workspace) -> None:
    """b's keyframe 2 is seen from a's keyframe 1, turned by 90 degrees; it is sure of x in the
    target's axes and unsure of y.
    """
    covariance = np.diag([0.01, 0.04, 0.09, 0.001, 0.002, 0.004])
    columns: dict[str, Any] = {
        "query_session": ["b"],
        "target_session": ["a"],
        "query_stamp_ns": [3_500_000_000],
        "target_stamp_ns": [2_500_000_000],
        **pose_columns(yaw_transform(np.pi / 2, (1.0, 2.0, 0.0))),
        "covariance": [covariance.ravel().tolist()],
        "overlap": [0.5],
        "probability": [0.99],
        "inliers": [1],
        "words": [1],
    }
    write_table(work.closures, contracts.table("closures", columns), METADATA)


def test_tum_has_seconds_and_session_poses(work: Workspace, tmp_path: Path) -> None:
    (path,) = export(work, ["a"], "tum", tmp_path)
    assert path.read_text() == "1.500000000 100 0 0 0 0 0 1\n2.500000000 103 0 0 0 0 0 1\n"


def test_kitti_has_three_by_four_matrices(work: Workspace, tmp_path: Path) -> None:
    (path,) = export(work, ["a"], "kitti", tmp_path)
    assert path.name == "a.txt"
    np.testing.assert_allclose(np.loadtxt(path)[1], [1, 0, 0, 103, 0, 1, 0, 0, 0, 0, 1, 0])


@pytest.mark.parametrize("form", ["tum", "kitti"])
def test_poses_in_utm_keep_their_millimetres(form: str, work: Workspace, tmp_path: Path) -> None:
    _session(work, "utm", np.array([yaw_transform(0.0, (691_234.567, 5_334_567.891, 0.0))]))
    (path,) = export(work, ["utm"], form, tmp_path)
    assert "691334.567 " in path.read_text()
    assert "5334567.891 " in path.read_text()


def test_ply_has_voxel_centres_in_the_session_frame(work: Workspace, tmp_path: Path) -> None:
    paths = export(work, [], "ply", tmp_path)
    assert [p.name for p in paths] == ["a.ply", "b.ply"]
    head, _, body = paths[0].read_bytes().partition(b"end_header\n")
    assert b"element vertex 2\n" in head
    kinds = {"float": "<f4", "uchar": "u1"}
    fields = [
        (line.split()[2], kinds[line.split()[1]])
        for line in head.decode().splitlines()
        if line.startswith("property")
    ]
    rows = np.frombuffer(body, fields)
    np.testing.assert_allclose(
        [rows[c] for c in "xyz"], [[100.25, 101.25], [0.75, 0.75], [-0.25, 0.25]]
    )
    assert rows["label"].tolist() == [2, 255]
    assert rows[["red", "green", "blue"]].tolist() == [(70, 70, 70), (128, 128, 128)]


def test_g2o_has_odometry_and_closures(work: Workspace, tmp_path: Path) -> None:
    _close(work)
    (path,) = export(work, [], "g2o", tmp_path)
    lines = [line.split() for line in path.read_text().splitlines()]
    vertices = [line for line in lines if line[0] == "VERTEX_SE3:QUAT"]
    edges = [line for line in lines if line[0] == "EDGE_SE3:QUAT"]
    assert [int(v[1]) for v in vertices] == [0, 1, 2, 3, 4]
    np.testing.assert_allclose([float(x) for x in vertices[1][2:]], [3, 0, 0, 0, 0, 0, 1])
    assert [(int(e[1]), int(e[2])) for e in edges] == [(0, 1), (2, 3), (3, 4), (1, 4)]
    # odometry over 3 m: 2 cm + 1 % is 5 cm; the first step of b goes along its -y
    information = [float(x) for x in edges[0][10:]]
    assert len(information) == 21
    assert information[0] == pytest.approx(1 / 0.05**2)
    np.testing.assert_allclose([float(x) for x in edges[1][3:6]], [0, -1, 0], atol=1e-9)
    # the closure: x of the target is -y of the query, so the query's y is the sure one
    closure = [float(x) for x in edges[3][3:]]
    np.testing.assert_allclose(closure[:7], [1, 2, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-9)
    full = np.zeros((6, 6))
    full[np.triu_indices(6)] = closure[7:]
    np.testing.assert_allclose(
        np.diag(full), [1 / 0.04, 1 / 0.01, 1 / 0.09, 1 / 0.002, 1 / 0.001, 1 / 0.004]
    )
    np.testing.assert_allclose(full - np.diag(np.diag(full)), 0, atol=1e-9)


def test_g2o_of_some_sessions_leaves_out_the_others(work: Workspace, tmp_path: Path) -> None:
    _close(work)
    (path,) = export(work, ["b"], "g2o", tmp_path)
    assert path.read_text().count("EDGE") == 2
    assert path.read_text().count("VERTEX") == 3


def test_unknown_sessions_are_named(work: Workspace, tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match=r"no session c \(it has a, b\)"):
        export(work, ["c"], "tum", tmp_path)


def test_files_of_the_workspace_are_not_touched(work: Workspace, tmp_path: Path) -> None:
    before = {p: p.read_bytes() for p in work.path.rglob("*") if p.is_file()}
    export(work, [], "tum", tmp_path / "out")
    assert {p: p.read_bytes() for p in work.path.rglob("*") if p.is_file()} == before
    assert json.loads(work.session("a").session_json.read_text())["voxel_size"] == 0.5


@pytest.mark.parametrize("form", ["tum", "kitti", "g2o", "ply", "xyz"])
def test_a_file_is_replaced_only_when_told(work: Workspace, tmp_path: Path, form: str) -> None:
    paths = export(work, [], form, tmp_path / "out")
    paths[-1].write_bytes(b"mine")
    with pytest.raises(WorkspaceError, match=r"exists already: give --overwrite"):
        export(work, [], form, tmp_path / "out")
    assert paths[-1].read_bytes() == b"mine"
    if len(paths) > 1:
        paths[0].unlink()
        with pytest.raises(WorkspaceError, match="exists already"):
            export(work, [], form, tmp_path / "out")
        assert not paths[0].exists(), "nothing is written where one file is in the way"
    assert export(work, [], form, tmp_path / "out", overwrite=True) == paths
    assert paths[-1].read_bytes() != b"mine"


def test_a_layout_shows_the_closures_where_the_drive_is(work: Workspace, tmp_path: Path) -> None:
    path = work.session("a").session_json
    streams = [
        {"role": "lidar", "topic": "/points"},
        {"role": "image", "topic": "/front/image"},
        {"role": "camera_info", "topic": "/rear/camera_info"},
        {"role": "camera_info", "topic": "/front/camera_info"},
        {"role": "imu", "topic": "/imu"},
    ]
    changes: dict[str, Any] = {"streams": streams, "logs": [{"encoding": "ros2"}]}
    for name, frame in (("a", "odom"), ("b", "")):
        path = work.session(name).session_json
        write_json(path, json.loads(path.read_text()) | changes | {"session_frame": frame})
    _close(work)
    (with_target,) = export(work, ["b"], "foxglove-layout", tmp_path)
    scene = json.loads(with_target.read_text())["configById"]["3D!closures"]
    assert scene["topics"]["/semloc/pose/a"]["visible"]
    assert scene["followTf"] == "semloc/b"  # as the markers of a log whose poses have no frame
    (written,) = export(work, ["a"], "foxglove-layout", tmp_path)
    assert written.name == "a.foxglove-layout.json"
    content = json.loads(written.read_text())
    scene = content["configById"]["3D!closures"]
    assert scene["followTf"] == "odom"
    assert scene["cameraState"]["targetOffset"] == [101.5, 0, 0]  # of 100 and 103
    assert {t for t, c in scene["topics"].items() if c["visible"]} == {
        "/semloc/map",
        "/semloc/markers",
        "/semloc/overview",
        "/semloc/pose",
        "/points",
    }
    # viewers choose colours themselves unless the field is named
    assert all("colorField" in scene["topics"][topic] for topic in ("/semloc/map", "/points"))
    assert content["configById"]["Image!camera"]["imageMode"] == {
        "imageTopic": "/front/image",
        "calibrationTopic": "/front/camera_info",
    }

    def named(place: Any) -> set[str]:
        return {place} if isinstance(place, str) else named(place["first"]) | named(place["second"])

    assert named(content["layout"]) == set(content["configById"])


@pytest.mark.parametrize(
    ("encoding", "mode"), [("ros1", "rgb"), ("protobuf", "rgba-fields"), ("json", "rgba-fields")]
)
def test_a_layout_colours_the_map_by_the_fields_that_it_has(
    work: Workspace, tmp_path: Path, encoding: Encoding, mode: str
) -> None:
    path = work.session("a").session_json
    write_json(path, json.loads(path.read_text()) | {"logs": [{"encoding": encoding}]})
    (written,) = export(work, ["a"], "foxglove-layout", tmp_path)
    config = json.loads(written.read_text())["configById"]["3D!closures"]["topics"]["/semloc/map"]
    cloud = Cloud(
        "odom", np.ones((1, 3), np.float32), np.ones((1, 3), np.uint8), np.zeros(1, np.uint8)
    )
    encoder = encoder_for(LogFacts(encoding, "", {}, 0, 0, 0))
    data = encoder.cloud(cloud, 0)
    names = ["rgb"] if mode == "rgb" else ["red", "green", "blue", "alpha"]
    quoted = '"' if encoding == "json" else ""
    assert all(f"{quoted}{name}{quoted}".encode() in data for name in names)
    assert (config["colorMode"], config["colorField"]) == (mode, names[0])


def test_a_layout_without_poses_follows_the_vehicle(work: Workspace, tmp_path: Path) -> None:
    path = work.session("a").session_json
    unposed = {"posed": False, "base_frame": "velodyne", "logs": []}
    write_json(path, json.loads(path.read_text()) | unposed)
    (written,) = export(work, ["a"], "foxglove-layout", tmp_path)
    scene = json.loads(written.read_text())["configById"]["3D!closures"]
    assert scene["followTf"] == scene["layers"]["grid"]["frameId"] == "velodyne"


def test_points_are_not_said_to_be_in_the_common_frame(work: Workspace, tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match="semloc optimize"):
        export(work, ["a"], "ply", tmp_path / "out", Selection(frame="common"))
    assert not (tmp_path / "out").exists()

"""Messages of Foxglove in protobuf and JSON."""

from __future__ import annotations

import base64
import math
import struct
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from semloc_logs.frames import Camera, DepthFrame, LidarFrame, NavSatSample, PoseSample
from semloc_logs.logs.problems import sentences
from tests.logs.messages.encoded import QUARTER_TURN, TURNED, json_frames, protobuf_frames


def test_protobuf_point_cloud_with_its_pose() -> None:
    m = PointCloud(frame_id="lidar", point_stride=14, data=struct.pack("<fffH", 1, 0, 0, 7))
    m.timestamp.seconds, m.timestamp.nanos = 5, 7
    m.pose.position.x, m.pose.position.y, m.pose.position.z = 1, 2, 3
    m.pose.orientation.z, m.pose.orientation.w = QUARTER_TURN[2:]
    for name, offset, kind in (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("label", 12, 3)):
        m.fields.add(name=name, offset=offset, type=kind)
    [frame], _ = protobuf_frames(m)
    assert isinstance(frame, LidarFrame)
    np.testing.assert_allclose(frame.points, [[1, 3, 3]], atol=1e-6)
    assert frame.label is not None
    assert frame.label.tolist() == [7]
    assert (frame.header.stamp_ns, frame.header.frame_id) == (5_000_000_007, "lidar")
    assert frame.origin is not None
    assert frame.origin.tolist() == [1, 2, 3]
    # a position without a rotation
    m.pose.ClearField("orientation")
    [frame], _ = protobuf_frames(m)
    assert frame.points.tolist() == [[2, 2, 3]]
    assert frame.origin.tolist() == [1, 2, 3]
    m.pose.position.x = math.nan
    frames, problems = protobuf_frames(m)
    assert frames == []
    assert "not finite" in sentences(problems)[0]
    m.ClearField("pose")
    [frame], _ = protobuf_frames(m)
    assert frame.points.tolist() == [[1, 0, 0]]
    assert frame.origin is None
    m.fields[1].type = 0
    frames, problems = protobuf_frames(m)
    assert frames == []
    assert "its field y has the unknown type 0" in sentences(problems)[0]


def test_protobuf_transforms_and_images() -> None:
    m = FrameTransforms()
    for child in ("b", "c"):
        t = m.transforms.add(parent_frame_id="a", child_frame_id=child)
        t.translation.x, t.translation.y, t.translation.z = 1, 2, 3
        t.rotation.z, t.rotation.w = QUARTER_TURN[2:]
    frames, _ = protobuf_frames(m, "/tf")
    assert [(f.header.frame_id, f.child_frame_id, f.static) for f in frames] == [
        ("a", "b", False),
        ("a", "c", False),
    ]
    np.testing.assert_allclose(frames[0].frame_T_child, TURNED, atol=1e-12)
    [frame], _ = protobuf_frames(
        RawImage(width=2, height=1, step=4, encoding="16UC1", data=struct.pack("<HH", 1000, 0))
    )
    assert isinstance(frame, DepthFrame)
    np.testing.assert_allclose(frame.depth, [[1, 0]])


def test_json_messages() -> None:
    time = {"sec": 5, "nsec": 7}
    pose = {
        "position": {"x": 1, "y": 2, "z": 3},
        "orientation": dict(zip("xyzw", QUARTER_TURN, strict=True)),
    }
    [frame], _ = json_frames(
        "foxglove.PoseInFrame", {"timestamp": time, "frame_id": "odom", "pose": pose}
    )
    assert isinstance(frame, PoseSample)
    assert (frame.header.stamp_ns, frame.header.frame_id) == (5_000_000_007, "odom")
    np.testing.assert_allclose(frame.frame_T_child, TURNED, atol=1e-12)
    odometry = {"timestamp": time, "frame_id": "odom", "body_frame_id": "base", "pose": pose}
    [frame], _ = json_frames("foxglove.Odometry", odometry)
    assert isinstance(frame, PoseSample)
    assert (frame.header.frame_id, frame.child_frame_id) == ("odom", "base")
    np.testing.assert_allclose(frame.frame_T_child, TURNED, atol=1e-12)
    fields = [{"name": n, "offset": 4 * k, "type": 7} for k, n in enumerate("xyz")]
    data = base64.b64encode(struct.pack("<fff", 1, 2, 3)).decode()
    cloud = {"timestamp": time, "frame_id": "l", "point_stride": 12, "fields": fields, "data": data}
    [frame], _ = json_frames("foxglove.PointCloud", cloud)
    assert frame.points.tolist() == [[1, 2, 3]]
    fix = {"timestamp": time, "frame_id": "g", "latitude": 47.25, "longitude": 8.5, "altitude": 400}
    [frame], _ = json_frames("foxglove.LocationFix", fix)
    assert isinstance(frame, NavSatSample)
    assert frame.latitude_deg == 47.25
    del fix["altitude"]
    [frame], _ = json_frames("foxglove.LocationFix", fix)
    assert isinstance(frame, NavSatSample)
    assert math.isnan(frame.altitude)
    del fix["latitude"]
    frames, problems = json_frames("foxglove.LocationFix", fix)
    assert frames == []
    assert "latitude or longitude is not on Earth" in sentences(problems)[0]
    calibration = {
        "timestamp": time,
        "width": 4,
        "height": 6,
        "distortion_model": "",
        "K": [9, 0, 2, 0, 9, 3, 0, 0, 1],
        "D": [],
    }
    [frame], _ = json_frames("foxglove.CameraCalibration", calibration)
    assert isinstance(frame, Camera)
    assert frame.K[0, 0] == 9


@pytest.mark.parametrize(
    "value",
    [
        b"",
        b"{",
        b"[]",
        b"[" * 100_000,
        {},
        {"timestamp": 5},
        {"timestamp": {"sec": "x", "nsec": []}},
        {"pose": [1], "frame_id": 3},
    ],
)
def test_json_without_sense_is_named(value: Any) -> None:
    frames, problems = json_frames("foxglove.PoseInFrame", value)
    assert frames == []
    assert len(sentences(problems)) == 1

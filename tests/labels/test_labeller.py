"""The source of the classes of a session, over logs in memory and over a real drive."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from semloc_logs.errors import LogError, SettingsError
from semloc_logs.frames import (
    Camera,
    Frame,
    Header,
    ImageFrame,
    LabelNames,
    LidarFrame,
    PoseSample,
    TransformSample,
)
from semloc_logs.labels.label_sources import LABELLERS, labeller_of
from semloc_logs.labels.labeller import KeyframeView, Labeller
from semloc_logs.logs.log import Message, Reading, Section, Stream
from semloc_logs.logs.problems import Problem, sentences
from semloc_logs.logs.session.session import Session
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.settings import Labels
from semloc_logs.settings.sections import LabelSource

MS = 1_000_000
ROAD, BUILDING, POLE, CAR = 0, 2, 5, 13
TYPES = {
    LidarFrame: "sensor_msgs/msg/PointCloud2",
    ImageFrame: "sensor_msgs/msg/Image",
    Camera: "sensor_msgs/msg/CameraInfo",
    TransformSample: "tf2_msgs/msg/TFMessage",
    LabelNames: "vision_msgs/msg/LabelInfo",
    PoseSample: "nav_msgs/msg/Odometry",
}
ORIGIN = np.zeros(3)
OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
POINTS = np.array([[10.0, 2, 0], [10.0, -2, 0], [-10.0, 0, 0]], np.float32)  # left, right, behind


class FakeLog:
    """Frames in memory as a log."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._frames = sorted(frames, key=lambda f: f.header.log_time_ns)
        self.path = Path("drive.mcap")
        self.format = "mcap"
        self.encoding = "ros2"
        self.start_ns, self.end_ns, self.problems = 0, 10**10, list[Problem]()
        topics = [f.header.topic for f in frames]
        kinds = {f.header.topic: TYPES[type(f)] for f in frames}
        if "/lidar/label_space" in kinds:
            kinds["/lidar/label_space"] = "std_msgs/msg/String"
        self.streams = [
            Stream(t, kind, "cdr", topics.count(t)) for t, kind in sorted(kinds.items())
        ]

    def sections(self) -> list[Section]:
        return []

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        return iter(())

    def frames(
        self, topics: Collection[str] | None = None, reading: Reading | None = None
    ) -> Iterator[Frame]:
        return iter([f for f in self._frames if topics is None or f.header.topic in topics])

    def close(self) -> None:
        pass


def header(topic: str, ms: float, frame_id: str = "") -> Header:
    return Header(topic, round(ms * MS), round(ms * MS), frame_id)


def sweep(
    ms: float, label: Sequence[int] | None = None, points: NDArray[np.float32] = POINTS
) -> LidarFrame:
    return LidarFrame(
        header("/lidar/points", ms, "base_link"),
        points,
        None if label is None else np.array(label, np.uint32),
    )


def camera(topic: str = "/cam/camera_info", frame_id: str = "optical") -> Camera:
    K = np.array([[50.0, 0, 49.5], [0, 50, 49.5], [0, 0, 1]])
    return Camera(
        header(topic, 0, frame_id),
        100,
        100,
        K,
        np.zeros(0),
        np.eye(3),
        np.zeros((3, 4)),
        "plumb_bob",
    )


def static(child: str = "optical", pose: NDArray[np.float64] = OPTICAL) -> TransformSample:
    return TransformSample(header("/tf_static", 0, "base_link"), child, pose, True)


def halves(
    ms: float, left: Any, right: Any, topic: str = "/cam/labels", frame_id: str = "optical"
) -> ImageFrame:
    """A picture of two labels, ids or colours."""
    image = np.zeros((100, 100, *np.shape(left)), np.uint8)
    image[:, :50], image[:, 50:] = left, right
    return ImageFrame(header(topic, ms, frame_id), image, "mono8" if image.ndim == 2 else "rgb8")


def classes(frames: Sequence[Frame], **settings: Any) -> tuple[list[list[int]], Labeller]:
    """Classes of the points of every cloud, and their labeller."""
    session = Session([FakeLog(frames)])
    labeller = labeller_of(Labels(**settings), session)
    taken = [
        (labeller.take(c, np.arange(len(c.points))), c.points)
        for c in session.clouds(labeller.on_image, labeller.images)
    ]
    labeller.conclude(lambda i: KeyframeView(taken[i][1], ORIGIN, taken[i][0], False), 1.0)
    json.dumps(labeller.to_json())
    return [
        labeller.labels(i, points, ORIGIN, ids, 1.0).tolist()
        for i, (ids, points) in enumerate(taken)
    ], labeller


def test_the_log_names_the_meaning_of_its_ids() -> None:
    names = {0: "unlabeled", 1: "Tree", 2: "street", 3: "quux"}
    labels, labeller = classes(
        [LabelNames(header("/lidar/label_info", 0), names=names), sweep(10, [1, 2, 3])]
    )
    assert labels == [[8, ROAD, 255]]
    assert labeller.to_json()["spaces"]["/lidar/points"] == {
        "space": "/lidar/label_info",
        "said_by": "log",
        "colours": False,
    }
    assert sentences(labeller.problems) == [
        "Classes of /lidar/points that mean nothing here are unlabelled: quux."
    ]


def test_a_space_that_the_log_names_instead_of_a_guess() -> None:
    ids = [7, 8, 11]  # looks like the full ids, and is named train ids
    named = LabelNames(header("/lidar/label_space", 0), space="cityscapes")
    labels, labeller = classes([named, sweep(10, ids)])
    assert labels == [[7, 8, 11]]
    assert labeller.to_json()["spaces"]["/lidar/points"]["said_by"] == "log"
    labels, _ = classes([named, sweep(10, ids)], space="cityscapes_ids")
    assert labels == [[ROAD, 1, BUILDING]]
    labels, labeller = classes(
        [LabelNames(header("/lidar/label_space", 0), space="/etc/passwd.yaml"), sweep(10, ids)]
    )
    assert labeller.to_json()["spaces"]["/lidar/points"] == {
        "space": "cityscapes",
        "said_by": "guess",
        "colours": False,
    }


def test_a_guess_looks_at_all_keyframes_and_is_recorded() -> None:
    labels, labeller = classes([sweep(10, [0, 10, 10]), sweep(200, [40, 40, 50])])
    assert labels == [[255, CAR, CAR], [ROAD, ROAD, BUILDING]]
    assert labeller.source == "log"
    assert labeller.to_json()["spaces"]["/lidar/points"] == {
        "space": "semantickitti",
        "said_by": "guess",
        "colours": False,
    }
    assert "semantickitti by their looks" in sentences(labeller.problems)[0]


def test_labels_that_are_all_zero_are_none() -> None:
    _, labeller = classes([sweep(10, [0, 0, 0])])
    assert labeller.source == "geometry"
    with pytest.raises(LogError, match="has no labels"):
        classes([sweep(10, [0, 0, 0])], source="log")
    with pytest.raises(LogError, match="has no labels"):
        classes([sweep(10)], source="log")


def test_ids_that_the_label_space_of_the_log_does_not_have_are_not_classes() -> None:
    names = LabelNames(header("/lidar/label_info", 0), names={1: "tree", 2: "street"})
    _, labeller = classes([names, *(sweep(10 * k, [1001, 1002, 2]) for k in range(1, 5))])
    assert labeller.source == "geometry"
    [problem] = labeller.problems
    assert problem.assumed
    assert "67% of their points have ids that the label space of the log" in problem.text
    _, labeller = classes([names, *(sweep(10 * k, [1, 2, 1003]) for k in range(1, 5))])
    assert labeller.source == "log"  # a class that the log does not name


def test_ids_that_no_label_space_has_are_not_classes() -> None:
    numbers = [sweep(10 * k, [101 + k, 230 - k, 77]) for k in range(1, 5)]
    labels, labeller = classes(numbers)
    assert labeller.source == "geometry"
    assert labeller.to_json()["spaces"] == {}
    [problem] = labeller.problems
    assert problem.assumed
    assert problem.topic == "/lidar/points"
    assert problem.text.startswith(
        "The labels of /lidar/points are not used: 100% of their points have ids that "
        "semantickitti, the most similar label space, does not have;"
    )
    # the user knows better
    for given in ({"source": "log"}, {"space": "semantickitti"}):
        labels, labeller = classes(numbers, **given)
        assert labeller.source == "log"
        assert labels == [[255, 255, 255]] * 4
        assert not any(p.assumed for p in labeller.problems)


def test_label_images_are_painted_onto_the_lidar() -> None:
    frames: list[Frame] = [
        static(),
        camera(),
        halves(0, 5, 2),
        sweep(0),
        halves(100, 13, 13),
        sweep(100),
    ]
    labels, labeller = classes(frames)
    assert labels == [[POLE, BUILDING, 255], [CAR, CAR, 255]]
    content = labeller.to_json()
    assert content["points"] == {"seen": 6, "in_a_picture": 4, "painted": 4}
    assert content["spaces"]["/cam/labels"]["space"] == "cityscapes"
    filled, _ = classes(frames, unseen="geometry")
    assert [row[:2] for row in filled] == [row[:2] for row in labels]


def test_colours_and_those_that_the_palette_does_not_have() -> None:
    road = (128, 64, 128)
    odd = (1, 2, 3)
    labels, labeller = classes(
        [static(), camera(), halves(0, road, odd), sweep(0), halves(100, road, road), sweep(100)]
    )
    assert labels == [[ROAD, 255, 255], [ROAD, ROAD, 255]]
    assert labeller.to_json()["spaces"]["/cam/labels"] == {
        "space": "cityscapes",
        "said_by": "guess",
        "colours": True,
    }
    assert (
        sentences(labeller.problems)[1]
        == "1 points have colours of /cam/labels that cityscapes does not have and "
        "are unlabelled: (1, 2, 3)."
    )


def test_without_poses_the_picture_has_to_be_of_the_same_time() -> None:
    labels, _ = classes(
        [static(), camera(), halves(0, 5, 2), sweep(40), sweep(70), halves(200, 13, 13), sweep(190)]
    )
    assert labels == [[POLE, BUILDING, 255], [255, 255, 255], [CAR, CAR, 255]]


def test_with_poses_the_motion_between_picture_and_cloud_is_taken_out() -> None:
    """The vehicle turns by 90 degrees a second.

    200 ms later the things on the left lie straight ahead, 18 degrees further right.
    """
    poses = [
        PoseSample(header("/odom", ms, "odom"), "base_link", yaw_transform(np.radians(0.09 * ms)))
        for ms in range(0, 420, 10)
    ]
    points = np.array([[10.0, 0.7, 0], [10.0, -0.7, 0]], np.float32)
    frames: list[Frame] = [
        static(),
        camera(),
        *poses,
        halves(0, 5, 2),
        halves(400, 5, 2),
        sweep(150, points=points),
    ]
    labels, _ = classes(frames)
    assert labels == [[POLE, POLE]]  # at 13.5 degrees to the left in the first picture
    still = [
        PoseSample(header("/odom", ms, "odom"), "base_link", np.eye(4)) for ms in range(0, 420, 10)
    ]
    stood: list[Frame] = [
        static(),
        camera(),
        *still,
        halves(0, 5, 2),
        halves(400, 5, 2),
        sweep(150, points=points),
    ]
    labels, _ = classes(stood)
    assert labels == [[POLE, BUILDING]]


def test_two_cameras() -> None:
    back = yaw_transform(np.pi) @ OPTICAL
    frames: list[Frame] = [
        static(),
        static("rear", back),
        camera(),
        camera("/rear/camera_info", "rear"),
        sweep(0),
    ]
    frames += [halves(0, 5, 2), halves(0, 13, 13, "/rear/labels", "rear")]
    labels, labeller = classes(frames)
    assert labels == [[POLE, BUILDING, CAR]]
    assert [c["points"] for c in labeller.to_json()["cameras"].values()] == [2, 1]


def test_painted_points_have_the_number_of_their_camera() -> None:
    frames: list[Frame] = [
        static(),
        static("rear", yaw_transform(np.pi) @ OPTICAL),
        camera(),
        camera("/rear/camera_info", "rear"),
        sweep(0),
        halves(0, 5, 2),
        halves(0, 13, 13, "/rear/labels", "rear"),
    ]
    session = Session([FakeLog(frames)])
    labeller = labeller_of(Labels(), session)
    assert labeller.images == ("/cam/labels", "/rear/labels")
    [cloud] = session.clouds(labeller.on_image, labeller.images)
    painted = labeller.take(cloud, np.array([0, 2]))
    assert painted is not None
    assert painted["label"].tolist() == [5, 13]
    assert painted["camera"].tolist() == [0, 1]
    assert painted["is_doubtful"].tolist() == [False, False]


def test_cameras_that_cannot_be_placed_are_named() -> None:
    labels, labeller = classes([camera(), halves(0, 5, 2), sweep(0)])
    assert labeller.source == "geometry"
    assert "No transform connects the camera frame 'optical'" in sentences(labeller.problems)[0]
    assert len(labels) == 1


# -- the model of the user


def by_brightness(folder: Path, rows: int, columns: int) -> dict[str, Any]:
    """A model that labels bright pixels building and dark pixels car."""
    weights = np.stack([np.full((3, 1, 1), 1 / 3, np.float32), np.zeros((3, 1, 1), np.float32)])
    stored = [
        numpy_helper.from_array(weights, "w"),
        numpy_helper.from_array(np.array([0, 0.3], np.float32), "b"),
    ]
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, rows, columns])
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 2, rows, columns])
    graph = helper.make_graph(
        [helper.make_node("Conv", ["x", "w", "b"], ["y"])], "brightness", [x], [y], stored
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 8
    onnx.save(model, str(folder / "model.onnx"))
    (folder / "spec.yaml").write_text(
        f"input: {{size: [{rows}, {columns}]}}\nclasses: [building, car]\n"
    )
    return {"source": "onnx", "model": folder / "model.onnx", "spec": folder / "spec.yaml"}


def test_the_model_labels_the_points_in_the_picture(tmp_path: Path) -> None:
    settings = by_brightness(tmp_path, 100, 100)
    picture = halves(0, (200, 200, 200), (10, 10, 10), "/cam/image")
    labels, labeller = classes([static(), camera(), picture, sweep(0, [40, 40, 40])], **settings)
    assert labels == [[BUILDING, CAR, 255]]  # whatever labels the points have
    assert labeller.source == "onnx"
    assert labeller.to_json()["model"]["unknown_classes"] == []


def test_missing_parts_of_a_model_are_named(tmp_path: Path) -> None:
    settings = by_brightness(tmp_path, 100, 100)
    picture = halves(0, (200, 200, 200), (10, 10, 10), "/cam/image")
    with pytest.raises(LogError, match="no camera pictures with a CameraInfo"):
        classes([sweep(0)], **settings)
    with pytest.raises(LogError, match="No transform connects"):
        classes([camera(), picture, sweep(0)], **settings)
    with pytest.raises(LogError, match="no camera picture shows points of the same time"):
        classes([static(), camera(), picture, sweep(500)], **settings)
    with pytest.raises(SettingsError, match="marskitti"):
        classes([sweep(0)], space="marskitti")


def test_a_real_drive_without_poses(shared: Callable[[str], Path], tmp_path: Path) -> None:
    from semloc_logs.logs.session.session import SessionOptions, open_session

    settings = by_brightness(tmp_path, 94, 311)
    session = open_session(
        [shared("logs/kitti_drive_camera_lidar.mcap")],
        SessionOptions(min_range=0.9, max_range=80.0),
    )
    try:
        labeller = labeller_of(Labels(**settings), session)
        clouds = session.clouds(labeller.on_image, labeller.images)
        cloud = next(clouds)
        ids = labeller.take(cloud, np.arange(len(cloud.points)))
    finally:
        session.close()
    labeller.conclude(lambda _: KeyframeView(cloud.points, ORIGIN, ids, False), 1.0)
    labels = labeller.labels(0, cloud.points, ORIGIN, ids, 1.0)
    behind = cloud.points[:, 0] < 0
    assert (labels[behind] == 255).all()
    assert set(np.unique(labels)) == {BUILDING, CAR, 255}
    content = labeller.to_json()["points"]
    assert 14_000 < content["in_a_picture"] < 18_000
    assert 0.6 < content["painted"] / content["in_a_picture"] < 1.0


def test_every_source_of_the_settings_has_a_labeller() -> None:
    assert set(LABELLERS) == set(get_args(LabelSource))


def test_a_space_that_is_missing_costs_no_pass_over_the_log() -> None:
    session = Session([FakeLog([sweep(10, [1])])])
    for source in LABELLERS:
        with pytest.raises(SettingsError, match="nowhere"):
            labeller_of(Labels(source=source, space="nowhere.yaml"), session)

"""Annotated logs of three encodings, as other people's readers see them, against the closures'
table and the truth.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from semloc_logs.errors import WorkspaceError
from semloc_logs.numerics.transforms import transform
from semloc_logs.stages import annotate as annotate_stage
from semloc_logs.stages.annotate import Annotation, AnnotationMode
from semloc_logs.stages.optimise import optimise
from semloc_logs.workspace import Workspace

# after its stamp a sweep is in the log: it takes 0.1 s, and 4 ms to be written
RECEIVED_NS = 104_000_000
NAMES = ("monday", "tuesday", "wednesday")  # ROS 2, ROS 1, protobuf


@dataclass(frozen=True, slots=True)
class Read:
    """A message as another reader decodes it."""

    topic: str
    log_time_ns: int
    message: Any


def read_ros2(path: Path) -> Iterator[Read]:
    with AnyReader([path]) as reader:
        for connection, time, data in reader.messages():
            yield Read(connection.topic, time, reader.deserialize(data, connection.msgtype))


def read_ros1(path: Path) -> Iterator[Read]:
    """MCAP of ROS 1 messages, decoded by the definitions in the file."""
    with path.open("rb") as file:
        stores: dict[str, Any] = {}
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
            kind = schema.name.replace("/", "/msg/")
            if schema.name not in stores:
                stores[schema.name] = get_typestore(Stores.ROS1_NOETIC)
                stores[schema.name].register(get_types_from_msg(schema.data.decode(), kind))
            yield Read(
                channel.topic,
                message.log_time,
                stores[schema.name].deserialize_ros1(message.data, kind),
            )


def read_protobuf(path: Path) -> Iterator[Read]:
    with path.open("rb") as file:
        for _, channel, message, decoded in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            yield Read(channel.topic, message.log_time, decoded)


READERS = {"monday": read_ros2, "tuesday": read_ros1, "wednesday": read_protobuf}


@pytest.fixture(
    scope="module",
    params=[(name, mode) for name in NAMES for mode in ("copy", "sidecar")],
    ids="-".join,
)
def annotated(
    request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
    labelled: Workspace,
    drives: Any,
    tools: SimpleNamespace,
) -> tuple[str, dict[str, list[Read]]]:
    """A drive's name, and the messages of its annotated log by topic."""
    name, mode = request.param
    output = tmp_path_factory.mktemp("annotated") / "out.mcap"
    annotation = Annotation(AnnotationMode(mode), output)
    report = annotate_stage.annotate(drives[name].log, labelled, tools.quick_settings(), annotation)
    assert report.path == output
    by_topic: dict[str, list[Read]] = {}
    for read in READERS[name](output):
        by_topic.setdefault(read.topic, []).append(read)
    own = {"/semloc/loop_closures", "/semloc/markers", "/semloc/tf_static", "/semloc/map"}
    own.add("/semloc/overview")
    if name != "wednesday":  # whose log has transforms of the vehicle
        own.add("/semloc/tf")
    if name != "monday":  # the first drive is never localised in another
        own |= {"/semloc/pose", "/semloc/pose/monday"}
    if name == "wednesday":
        own.add("/semloc/pose/tuesday")
    assert own == {topic for topic in by_topic if topic.startswith("/semloc")}
    assert ("/lidar/points" in by_topic) == (mode == "copy")
    assert report.messages == sum(len(by_topic[topic]) for topic in own)
    return name, by_topic


@pytest.fixture(scope="module")
def rows(labelled: Workspace) -> list[dict[str, Any]]:
    """The closures, read without our reader: each drive is localised in those before it."""
    closures: list[dict[str, Any]] = pq.read_table(labelled.closures).to_pylist()
    pairs = {(row["query_session"], row["target_session"]) for row in closures}
    assert pairs == {("tuesday", "monday"), ("wednesday", "monday"), ("wednesday", "tuesday")}
    return closures


def ends(row: Any) -> tuple[str, int, str, int]:
    """What names a closure, of a row or a message."""
    get = row.__getitem__ if isinstance(row, dict) else lambda key: getattr(row, key)
    return (
        str(get("query_session")),
        int(get("query_stamp_ns")),
        str(get("target_session")),
        int(get("target_stamp_ns")),
    )


def stamp_ns(stamp: Any) -> int:
    """Of a ROS time or a protobuf timestamp."""
    return int(
        stamp.sec * 10**9 + stamp.nanosec
        if hasattr(stamp, "sec")
        else stamp.seconds * 10**9 + stamp.nanos
    )


def header(message: Any) -> tuple[int, str]:
    """Stamp and frame of a ROS message or of a protobuf one."""
    if hasattr(message, "header"):
        return stamp_ns(message.header.stamp), str(message.header.frame_id)
    return stamp_ns(message.timestamp), str(getattr(message, "frame_id", ""))


def pose_of(pose: Any) -> Any:
    """(4, 4) of a ROS pose or a Foxglove one."""
    p = pose.position
    q = pose.orientation
    return transform(np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]))


def test_the_reader_of_mcap_for_ros_2_decodes_all_topics(
    labelled: Workspace, drives: Any, tools: SimpleNamespace, tmp_path: Path
) -> None:
    decoders = pytest.importorskip("mcap_ros2.decoder")
    output = tmp_path / "out.mcap"
    annotation = Annotation(AnnotationMode.COPY, output)
    report = annotate_stage.annotate(
        drives["monday"].log, labelled, tools.quick_settings(), annotation
    )
    with output.open("rb") as file:
        reader = make_reader(file, decoder_factories=[decoders.DecoderFactory()])
        own = [
            (channel, message)
            for _, channel, _, message in reader.iter_decoded_messages()
            if channel.topic.startswith("/semloc/")
        ]
    assert len(own) == report.messages
    ((channel, cloud),) = [pair for pair in own if pair[0].topic == "/semloc/map"]
    assert "durability: 1" in channel.metadata["offered_qos_profiles"]
    assert cloud.width * cloud.point_step == len(cloud.data)


def test_every_closure_of_the_log_is_there_as_query_and_as_target(
    annotated: Any, rows: list[dict[str, Any]]
) -> None:
    name, topics = annotated
    expected = {
        ends(row): row for row in rows if name in (row["query_session"], row["target_session"])
    }
    as_query = {"monday": {False}, "tuesday": {True, False}, "wednesday": {True}}
    assert {end[0] == name for end in expected} == as_query[name]
    messages = topics["/semloc/loop_closures"]
    assert sorted(ends(read.message) for read in messages) == sorted(expected)
    for read in messages:
        row = expected[ends(read.message)]
        for key in (
            "t_x",
            "t_y",
            "t_z",
            "q_x",
            "q_y",
            "q_z",
            "q_w",
            "probability",
            "overlap",
            "inliers",
            "words",
        ):
            assert getattr(read.message, key) == pytest.approx(row[key])
        np.testing.assert_allclose(read.message.covariance, row["covariance"])


def test_closures_are_at_the_time_of_their_end_in_this_log(annotated: Any) -> None:
    name, topics = annotated
    for read in topics["/semloc/loop_closures"]:
        is_query = read.message.query_session == name
        own = read.message.query_stamp_ns if is_query else read.message.target_stamp_ns
        assert header(read.message)[0] == own
        assert read.log_time_ns == own + RECEIVED_NS


def test_poses_are_the_true_ones_in_the_frame_of_the_target(
    annotated: Any, rows: list[dict[str, Any]], drives: Any
) -> None:
    """``session_T_world`` of the target and ``world_T_base`` of the query are known from the
    simulation.
    """
    name, topics = annotated
    wanted = sorted(
        (row["query_stamp_ns"], f"semloc/{row['target_session']}")
        for row in rows
        if row["query_session"] == name
    )
    messages = topics.get("/semloc/pose", [])
    assert sorted(header(read.message) for read in messages) == wanted
    for read in messages:
        stamp, frame_id = header(read.message)
        assert read.log_time_ns == stamp + RECEIVED_NS
        target = drives[frame_id.removeprefix("semloc/")]
        pose = read.message.pose.pose if hasattr(read.message.pose, "pose") else read.message.pose
        truth = target.session_T_world @ drives[name].world_T_base(stamp)
        np.testing.assert_allclose(pose_of(pose)[:3, 3], truth[:3, 3], atol=0.06)
        np.testing.assert_allclose(pose_of(pose)[:3, :3], truth[:3, :3], atol=0.01)


def test_markers_are_at_this_drives_end_of_every_closure(annotated: Any, drives: Any) -> None:
    name, topics = annotated
    drive = drives[name]
    times = sorted(read.log_time_ns for read in topics["/semloc/markers"])
    assert times == sorted(read.log_time_ns for read in topics["/semloc/loop_closures"])
    for read in topics["/semloc/markers"]:
        if name == "wednesday":
            (entity,) = read.message.entities
            stamp, frame_id = header(entity)
            sphere = entity.spheres[0]
            text = entity.texts[0].text
            assert len(entity.lines) == 1
        else:
            sphere, line, words = read.message.markers
            assert line.type == 5  # LINE_LIST, to the other end
            stamp, frame_id = header(sphere)
            assert (sphere.type, words.type) == (2, 9)  # SPHERE, TEXT_VIEW_FACING
            text = words.text
        assert (read.log_time_ns, frame_id) == (stamp + RECEIVED_NS, "odom")
        assert text.split()[0] in set(NAMES) - {name}
        truth = drive.session_T_world @ drive.world_T_base(stamp)
        np.testing.assert_allclose(pose_of(sphere.pose)[:3, 3], truth[:3, 3], atol=0.01)


def test_frames_of_other_sessions_are_placed(annotated: Any, drives: Any) -> None:
    """The session frames of the drives are known from the simulation."""
    name, topics = annotated
    (read,) = topics["/semloc/tf_static"]
    placed = {}
    for edge in read.message.transforms:
        in_ros = hasattr(edge, "header")
        parent, child = (
            (edge.header.frame_id, edge.child_frame_id)
            if in_ros
            else (edge.parent_frame_id, edge.child_frame_id)
        )
        assert parent == "odom"
        inner = edge.transform if in_ros else edge
        t, q = inner.translation, inner.rotation
        placed[child] = transform(np.array([t.x, t.y, t.z]), np.array([q.x, q.y, q.z, q.w]))
    assert set(placed) == {f"semloc/{other}" for other in NAMES}
    np.testing.assert_allclose(placed[f"semloc/{name}"], np.eye(4), atol=1e-12)
    world = drives[name].world_T_base(int(drives[name].trajectory.stamps_ns[0]))
    for other in NAMES:
        truth = drives[name].session_T_world @ np.linalg.inv(drives[other].session_T_world)
        place = (drives[other].session_T_world @ world)[:3, 3]  # on the road, not far off
        measured = placed[f"semloc/{other}"][:3, :3] @ place + placed[f"semloc/{other}"][:3, 3]
        np.testing.assert_allclose(measured, truth[:3, :3] @ place + truth[:3, 3], atol=0.15)


def test_the_vehicle_moves_in_logs_without_transforms(annotated: Any, drives: Any) -> None:
    name, topics = annotated
    for read in topics.get("/semloc/tf", []):
        (edge,) = read.message.transforms
        assert (edge.header.frame_id, edge.child_frame_id) == ("odom", "base_link")
        stamp, _ = header(edge)
        assert read.log_time_ns == stamp + RECEIVED_NS
        truth = drives[name].session_T_world @ drives[name].world_T_base(stamp)
        t = edge.transform.translation
        np.testing.assert_allclose([t.x, t.y, t.z], truth[:3, 3], atol=0.01)


def test_the_overview_has_the_true_way_of_every_drive(
    annotated: Any, labelled: Workspace, drives: Any
) -> None:
    name, topics = annotated
    (read,) = topics["/semloc/overview"]
    assert read.log_time_ns == min(r.log_time_ns for reads in topics.values() for r in reads)
    if name == "wednesday":
        *entities, closures = read.message.entities
        ways = {entity.frame_id: entity.lines[0].points for entity in entities}
        names = {entity.frame_id: entity.texts[0].text for entity in entities}
        spheres = len(closures.spheres)
    else:
        markers = read.message.markers
        ways = {m.header.frame_id: m.points for m in markers if m.ns == "semloc/drives"}
        names = {m.header.frame_id: m.text for m in markers if m.ns == "semloc/sessions"}
        (places,) = [m for m in markers if m.ns == "semloc/places"]
        spheres = len(places.points)
    assert spheres == len(topics["/semloc/loop_closures"])
    frames = {other: "odom" if other == name else f"semloc/{other}" for other in NAMES}
    assert names == {frame: other for other, frame in frames.items()}
    for other, frame in frames.items():
        drive = drives[other]
        truth = np.array(
            [
                (drive.session_T_world @ drive.world_T_base(int(t)))[:3, 3]
                for t in drive.trajectory.stamps_ns
            ]
        )
        way = np.array([[p.x, p.y, p.z] for p in ways[frame]])
        assert len(way) == pq.read_table(labelled.session(other).frames).num_rows > 1
        away = np.linalg.norm(way[:, None] - truth[None], axis=2).min(1)
        assert away.max() < 0.5  # between two poses
        assert np.linalg.norm(way[-1] - way[0]) > 5.0


def test_frames_are_connected_where_the_log_names_no_frame_and_has_one_above_the_vehicle(
    labelled: Workspace, drives: Any, tools: SimpleNamespace, tmp_path: Path
) -> None:
    """The frame of the poses has no name; base_footprint is 0.3 m below base_link, its child."""
    work = Workspace(tmp_path / "work")
    shutil.copytree(labelled.path, work.path)
    path = work.session("monday").session_json
    content = json.loads(path.read_text())
    assert content["vehicle_root"] == {"frame": "base_link", "base_T_root": np.eye(4).tolist()}
    base_T_root = transform(np.array([0.0, 0.0, -0.3]), np.array([0.0, 0.0, 0.0, 1.0]))
    root = {"frame": "base_footprint", "base_T_root": base_T_root.tolist()}
    path.write_text(json.dumps(content | {"session_frame": "", "vehicle_root": root}))
    annotation = Annotation(AnnotationMode.SIDECAR, tmp_path / "out.mcap")
    annotate_stage.annotate(drives["monday"].log, work, tools.quick_settings(), annotation)
    reads = list(read_ros2(tmp_path / "out.mcap"))
    marks = [m for r in reads if r.topic == "/semloc/markers" for m in r.message.markers]
    assert {header(mark)[1] for mark in marks} == {"semloc/monday"}
    (fixed,) = [r.message.transforms for r in reads if r.topic == "/semloc/tf_static"]
    assert {edge.child_frame_id for edge in fixed} == {"semloc/tuesday", "semloc/wednesday"}
    assert {edge.header.frame_id for edge in fixed} == {"semloc/monday"}
    moving = [r.message.transforms[0] for r in reads if r.topic == "/semloc/tf"]
    assert moving
    for edge in moving:
        assert (edge.header.frame_id, edge.child_frame_id) == ("semloc/monday", "base_footprint")
        stamp = stamp_ns(edge.header.stamp)
        truth = drives["monday"].session_T_world @ drives["monday"].world_T_base(stamp)
        t = edge.transform.translation
        np.testing.assert_allclose([t.x, t.y, t.z], (truth @ base_T_root)[:3, 3], atol=0.01)


def test_the_map_of_the_other_sessions_lies_along_the_road(annotated: Any, drives: Any) -> None:
    name, topics = annotated
    (read,) = topics["/semloc/map"]
    message = read.message
    if name == "wednesday":
        rows = np.frombuffer(message.data, np.uint8).reshape(-1, message.point_stride)
        assert message.frame_id == "odom"
    else:
        rows = np.asarray(message.data).reshape(message.width, message.point_step)
        assert message.header.frame_id == "odom"
    points = np.ascontiguousarray(rows[:, :12]).view("<f4")
    assert 500 < len(points) <= 100_000
    own = drives[name].trajectory
    places = np.array(
        [
            (drives[name].session_T_world @ drives[name].world_T_base(int(t)))[:3, 3]
            for t in own.stamps_ns[::10]
        ]
    )
    away = np.linalg.norm(points[:, None, :2] - places[None, :, :2], axis=2).min(0)
    assert np.median(away) < 5.0  # the road or a wall beside it


def test_poses_in_the_common_frame(
    labelled: Workspace, drives: Any, tools: SimpleNamespace, tmp_path: Path
) -> None:
    pytest.importorskip("gtsam")
    optimise(labelled, tools.quick_settings())
    annotation = Annotation(AnnotationMode.SIDECAR, tmp_path / "out.mcap", common=True)
    annotate_stage.annotate(drives["monday"].log, labelled, tools.quick_settings(), annotation)
    reads = list(read_ros2(tmp_path / "out.mcap"))
    poses = {r.log_time_ns: r.message for r in reads if r.topic == "/semloc/pose"}
    assert len(poses) == pq.read_table(labelled.session("monday").frames).num_rows > 1
    frames = {
        r.log_time_ns: r.message.transforms[0]
        for r in reads
        if r.topic == "/semloc/tf" and r.message.transforms[0].child_frame_id == "semloc/common"
    }
    assert set(frames) == set(poses)
    children = [r.message.transforms[0].child_frame_id for r in reads if r.topic == "/semloc/tf"]
    assert children.count("base_link") == len(poses)  # the vehicle moves all the same
    for time, message in poses.items():
        stamp, frame_id = header(message)
        assert frame_id == "semloc/common"
        edge = frames[time]
        assert edge.header.frame_id == "odom"
        t = edge.transform.translation
        q = edge.transform.rotation
        odom_T_common = transform(np.array([t.x, t.y, t.z]), np.array([q.x, q.y, q.z, q.w]))
        truth = drives["monday"].session_T_world @ drives["monday"].world_T_base(stamp)
        common_T_base = odom_T_common @ pose_of(message.pose.pose)
        np.testing.assert_allclose(common_T_base[:3, 3], truth[:3, 3], atol=0.01)


def test_common_poses_need_an_optimised_workspace(
    labelled: Workspace, drives: Any, tools: SimpleNamespace, tmp_path: Path
) -> None:
    work = Workspace(tmp_path / "work")
    shutil.copytree(labelled.path, work.path, ignore=shutil.ignore_patterns("optimized"))
    annotation = Annotation(AnnotationMode.SIDECAR, tmp_path / "out.mcap", common=True)
    with pytest.raises(WorkspaceError, match="run 'semloc optimize"):
        annotate_stage.annotate(drives["monday"].log, work, tools.quick_settings(), annotation)


def test_annotating_under_another_name_takes_the_closures_of_that_session(
    labelled: Workspace,
    drives: Any,
    tools: SimpleNamespace,
    tmp_path: Path,
    rows: list[dict[str, Any]],
) -> None:
    log = Path(tmp_path / "renamed.mcap")
    log.write_bytes(drives["monday"].log.read_bytes())
    annotation = Annotation(AnnotationMode.COPY, tmp_path / "o.mcap")
    settings = tools.quick_settings()
    report = annotate_stage.annotate(log, labelled, settings, annotation, session="monday")
    assert report.closures == sum(
        "monday" in (row["query_session"], row["target_session"]) for row in rows
    )


def test_another_log_of_the_same_name_is_refused(
    labelled: Workspace, drives: Any, tools: SimpleNamespace, tmp_path: Path
) -> None:
    """Its closures would belong to another drive."""
    log = tmp_path / "monday.mcap"
    log.write_bytes(drives["wednesday"].log.read_bytes())
    annotation = Annotation(AnnotationMode("copy"), tmp_path / "out.mcap")
    with pytest.raises(WorkspaceError, match=r"is not the log that session 'monday' was made from"):
        annotate_stage.annotate(log, labelled, tools.quick_settings(), annotation)
    assert not (tmp_path / "out.mcap").exists()

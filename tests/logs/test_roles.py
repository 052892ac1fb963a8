"""Roles by type and name, overrides, ambiguity."""

from __future__ import annotations

import pytest

from semloc_logs.errors import RoleError
from semloc_logs.logs.log import Stream
from semloc_logs.logs.problems import sentences
from semloc_logs.logs.role_types import no_sensor
from semloc_logs.logs.roles import Roles, find_roles, guess_roles

CLOUD, IMAGE, JPEG, INFO = (
    "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/CameraInfo",
)
ODOM, POSE, POSE_COV = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
)
TF, IMU, FIX = "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"


def log(topics: dict[str, str]) -> list[Stream]:
    return [Stream(topic, kind, "cdr", 10) for topic, kind in sorted(topics.items())]


def roles(topics: dict[str, str], **overrides: str) -> Roles:
    return find_roles(log(topics), overrides)


def test_sensors_of_another_robot_are_left_out_once_the_poses_are_chosen() -> None:
    topics = {f"/robot{k}/points": CLOUD for k in (1, 2)}
    topics |= {f"/robot{k}/odom": ODOM for k in (1, 2)}
    topics |= {f"/robot{k}/imu": IMU for k in (1, 2)}
    chosen = roles(topics, pose="/robot2/odom")
    assert (chosen.lidar, chosen.imu) == (("/robot2/points",), "/robot2/imu")
    assert any("/robot1/points: left out" in note for note in sentences(chosen.notes))
    both = roles(topics, pose="/robot2/odom", lidar="/robot1/points,/robot2/points")
    assert len(both.lidar) == 2


def test_sensors_with_namespaces_of_their_own_are_of_one_car() -> None:
    topics = {"/front/points": CLOUD, "/rear/points": CLOUD, "/front/odom": ODOM}
    assert roles(topics).lidar == ("/front/points", "/rear/points")
    camera = {"/car/points": CLOUD, "/car/odom": ODOM, "/zed/depth/image": IMAGE, "/zed/pose": POSE}
    assert roles(camera).depth == ("/zed/depth/image",)


def test_a_car_with_everything() -> None:
    chosen = roles(
        {
            "/lidar_top/points": CLOUD,
            "/lidar_rear/points": CLOUD,
            "/map": CLOUD,
            "/odometry": ODOM,
            "/tf": TF,
            "/tf_static": TF,
            "/imu/data": IMU,
            "/imu/data_raw": IMU,
            "/fix": FIX,
            "/cam_front/image_raw/compressed": JPEG,
            "/cam_front/camera_info": INFO,
            "/cam_back/image_raw/compressed": JPEG,
            "/cam_back/camera_info": INFO,
            "/rosout": "rosgraph_msgs/msg/Log",
        }
    )
    assert chosen.lidar == ("/lidar_rear/points", "/lidar_top/points")
    assert (chosen.pose, chosen.imu, chosen.gnss) == ("/odometry", "/imu/data", "/fix")
    assert (chosen.tf, chosen.tf_static) == (("/tf",), ("/tf_static",))
    assert chosen.info_of["/cam_back/image_raw/compressed"] == "/cam_back/camera_info"
    assert chosen.role_of("/rosout") is None
    assert chosen.role_of("/map") is None
    assert any("--topic lidar=/map" in note for note in sentences(chosen.notes))


def test_depth_camera_with_both_infos_and_a_posestamped() -> None:
    chosen = roles(
        {
            "/camera/pose": POSE,
            "/camera/color/image/compressed": JPEG,
            "/camera/depth/image/compressedDepth": JPEG,
            "/camera/color/camera_info": INFO,
            "/camera/depth/camera_info": INFO,
            "/camera/depth/points": CLOUD,
        }
    )
    assert chosen.depth == ("/camera/depth/image/compressedDepth",)
    assert chosen.image == ("/camera/color/image/compressed",)
    assert chosen.info_of[chosen.depth[0]] == "/camera/depth/camera_info"
    assert chosen.info_of[chosen.image[0]] == "/camera/color/camera_info"
    assert chosen.pose == "/camera/pose"
    assert chosen.lidar == ()  # the depth image once more


def test_the_same_picture_through_two_transports_counts_once() -> None:
    chosen = roles(
        {
            "/d/depth": IMAGE,
            "/d/depth/compressedDepth": JPEG,
            "/d/rgb/image_raw": IMAGE,
            "/d/rgb/image_raw/compressed": JPEG,
        }
    )
    assert chosen.depth == ("/d/depth",)
    assert chosen.image == ("/d/rgb/image_raw",)


@pytest.mark.parametrize(
    ("labelled", "expected"),
    [(False, "/camera/depth/image_rect_raw"), (True, "/camera/aligned_depth_to_color/image_raw")],
)
def test_one_depth_stream_for_each_camera(labelled: bool, expected: str) -> None:
    topics = {
        "/camera/depth/image_rect_raw": IMAGE,
        "/camera/aligned_depth_to_color/image_raw": IMAGE,
    }
    if labelled:
        topics["/camera/color/labels"] = IMAGE
    chosen = roles(topics)
    assert chosen.depth == (expected,)
    assert chosen.label_image == (("/camera/color/labels",) if labelled else ())


def test_label_images_but_not_their_coloured_version() -> None:
    chosen = roles(
        {
            "/unet/raw_segmentation_mask": IMAGE,
            "/unet/colored_segmentation_mask": IMAGE,
            "/depth/image": IMAGE,
        }
    )
    assert chosen.label_image == ("/unet/raw_segmentation_mask",)
    assert chosen.label_of == {"/depth/image": "/unet/raw_segmentation_mask"}


def test_stereo_pairs() -> None:
    chosen = roles(
        {
            "/cam0/image_raw": IMAGE,
            "/cam1/image_raw": IMAGE,
            "/cam0/camera_info": INFO,
            "/cam1/camera_info": INFO,
        }
    )
    assert (chosen.stereo_left, chosen.stereo_right) == ("/cam0/image_raw", "/cam1/image_raw")
    assert chosen.info_of["/cam1/image_raw"] == "/cam1/camera_info"
    assert chosen.role_of("/cam0/image_raw") == "stereo_left"
    assert roles({"/left/image": IMAGE, "/other/image": IMAGE}).stereo_left is None


def test_a_stereo_pair_beside_ranges_stays_two_images_unless_it_is_named() -> None:
    pair = {"/left/image_raw": IMAGE, "/right/image_raw": IMAGE}
    for ranges in ({"/points": CLOUD}, {"/depth/image": IMAGE}):
        chosen = roles(pair | ranges)
        assert (chosen.stereo_left, chosen.stereo_right) == (None, None)
        assert chosen.image == ("/left/image_raw", "/right/image_raw")
        assert chosen.ranging == tuple(ranges)
        for named in ({"stereo_left": "/left/image_raw"}, {"stereo_right": "/right/image_raw"}):
            named_pair = roles(pair | ranges, **named)
            assert (named_pair.stereo_left, named_pair.stereo_right) == (
                "/left/image_raw",
                "/right/image_raw",
            )
            assert named_pair.ranging == (*ranges, "/left/image_raw")
    assert roles(pair, stereo_left="none").ranging == ()


def test_a_pair_takes_two_topics() -> None:
    for named in ({"stereo_left": "/a"}, {"stereo_left": "/a", "stereo_right": "/a"}):
        with pytest.raises(RoleError, match="A stereo pair takes two topics"):
            roles({"/a": IMAGE, "/b": IMAGE}, **named)
    chosen = roles({"/a": IMAGE, "/b": IMAGE}, stereo_left="/b", stereo_right="/a")
    assert chosen.ranging == ("/b",)


@pytest.mark.parametrize(
    ("topics", "expected"),
    [
        (
            (
                "/s/left/image_rect",
                "/s/right/image_rect",
                "/s/left/image_raw",
                "/s/right/image_raw",
            ),
            "/s/left/image_raw",
        ),
        (
            ("/c/infra1/image_rect_raw", "/c/infra2/image_rect_raw", "/c/color/image_raw"),
            "/c/infra1/image_rect_raw",
        ),
        (("/k/image_02/compressed", "/k/image_03/compressed"), "/k/image_02/compressed"),
        (
            ("/left/image_color", "/right/image_color", "/left/image_mono", "/right/image_mono"),
            "/left/image_mono",
        ),
        (("/front/image", "/rear/image"), None),
    ],
)
def test_which_pair(topics: tuple[str, ...], expected: str | None) -> None:
    assert roles(dict.fromkeys(topics, IMAGE)).stereo_left == expected


def test_the_cameras_of_a_pair_never_share_a_calibration() -> None:
    pair = {"/cam0/image_raw": IMAGE, "/cam1/image_raw": IMAGE}
    assert roles(pair | {"/cam0/camera_info": INFO}).info_of == {
        "/cam0/image_raw": "/cam0/camera_info"
    }
    assert roles(pair | {"/cam1/camera_info": INFO}).info_of == {
        "/cam1/image_raw": "/cam1/camera_info"
    }


@pytest.mark.parametrize(
    ("topics", "expected"),
    [
        ({"/a": POSE, "/b": ODOM}, "/b"),
        ({"/amcl_pose": POSE_COV, "/pose": POSE}, "/amcl_pose"),
        ({"/wheel/odom": ODOM, "/odom": ODOM}, "/odom"),
        ({"/odometry/filtered": ODOM, "/odom": ODOM}, "/odometry/filtered"),
        ({"/ground_truth/odometry": ODOM}, "/ground_truth/odometry"),
        ({"/move_base/goal": POSE, "/pose": POSE}, "/pose"),
        ({"/semloc/pose": POSE_COV, "/camera/pose": POSE}, "/camera/pose"),
        ({"/semloc/pose": POSE_COV}, None),
        ({"/vrpn/pose": POSE, "/camera/pose": POSE, "/camera/depth/image": IMAGE}, "/camera/pose"),
        ({"/ego": "foxglove.PoseInFrame", "/tf": "foxglove.FrameTransform"}, "/ego"),
    ],
)
def test_which_pose(topics: dict[str, str], expected: str | None) -> None:
    assert roles(topics).pose == expected


def test_two_equal_poses_are_for_the_user_to_choose() -> None:
    topics = {"/a/odom": ODOM, "/b/odom": ODOM}
    with pytest.raises(RoleError, match="--topic pose=/a/odom or --topic pose=/b/odom"):
        roles(topics)
    guessed = guess_roles(log(topics))
    assert guessed.pose is None
    assert len(guessed.problems) == 1
    assert roles(topics, pose="/b/odom").pose == "/b/odom"
    assert roles(topics, pose="b/odom").pose == "/b/odom"
    assert roles(topics, pose="none").pose is None


def test_fixes_named_as_the_pose() -> None:
    topics = {"/odom": ODOM, "/fix": FIX, "/fix2": FIX}
    assert (roles(topics).pose, roles(topics).gnss) == ("/odom", "/fix")
    named = roles(topics, pose="/fix2")
    assert (named.pose, named.gnss) == ("/fix2", "/fix2")


def test_overrides_that_cannot_be() -> None:
    topics = {"/points": CLOUD, "/odom": ODOM}
    with pytest.raises(RoleError, match=r"role 'laser' is unknown.*lidar, depth"):
        roles(topics, laser="/points")
    with pytest.raises(
        RoleError, match=r"no topic '/pionts'.*/odom \(nav_msgs/msg/Odometry\), /points"
    ):
        roles(topics, lidar="/pionts")
    with pytest.raises(RoleError, match="Odometry cannot be the lidar"):
        roles(topics, lidar="/odom")
    with pytest.raises(RoleError, match="takes one topic"):
        roles(topics | {"/odom2": ODOM}, pose="/odom,/odom2")


def test_an_override_takes_the_topic_from_its_guessed_role() -> None:
    topics = {
        "/front/depth": IMAGE,
        "/front/camera_info": INFO,
        "/x": IMAGE,
        "/a": CLOUD,
        "/b": CLOUD,
    }
    chosen = roles(topics, label_image="/x", lidar="/b,/a")
    assert chosen.label_image == ("/x",)
    assert chosen.image == ()
    assert chosen.lidar == ("/b", "/a")
    assert chosen.label_of == {"/front/depth": "/x"}


def test_streams_without_messages_play_no_role() -> None:
    assert (
        find_roles([Stream("/odom", ODOM, "cdr", 0), Stream("/pose", POSE, "cdr", 4)]).pose
        == "/pose"
    )


def test_foxglove_types() -> None:
    chosen = roles(
        {
            "/lidar": "foxglove.PointCloud",
            "/cam": "foxglove.CompressedImage",
            "/cam_calibration": "foxglove.CameraCalibration",
            "/tf": "foxglove.FrameTransforms",
            "/gps": "foxglove.LocationFix",
        }
    )
    assert chosen.to_json() == {
        "lidar": ["/lidar"],
        "image": ["/cam"],
        "camera_info": ["/cam_calibration"],
        "tf": ["/tf"],
        "gnss": ["/gps"],
    }
    assert chosen.info_of == {"/cam": "/cam_calibration"}


def test_a_log_without_range_sensor_is_told_what_it_has() -> None:
    scan, other = "sensor_msgs/msg/LaserScan", {"/odom": ODOM}
    assert no_sensor(log({**other, "/scan": scan})) == (
        "/scan (sensor_msgs/msg/LaserScan) is a 2-D scan, and a 2-D scan cannot be mapped: "
        "record clouds or depth images."
    )
    with pytest.raises(RoleError, match="/scan is a sensor_msgs/msg/LaserScan, and a 2-D scan"):
        roles({**other, "/scan": scan}, lidar="/scan")
    # flags are named where a topic of their type is there, and these are accepted
    assert no_sensor(log(other)).endswith("record clouds or depth images.")
    mapped = no_sensor(log({**other, "/map_cloud": CLOUD}))
    assert "--topic lidar=/map_cloud" in mapped
    assert roles({**other, "/map_cloud": CLOUD}, lidar="/map_cloud").lidar == ("/map_cloud",)
    pictures = no_sensor(log({**other, "/front/image": IMAGE}))
    assert "--topic depth=TOPIC" in pictures
    assert "lidar=" not in pictures
    assert roles({**other, "/front/image": IMAGE}, depth="/front/image").depth == ("/front/image",)

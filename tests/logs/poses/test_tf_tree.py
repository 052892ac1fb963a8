"""TF trees: chains, time, loops, islands."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.frames import Header, TransformSample
from semloc_logs.logs.poses.tf_tree import TransformTree
from semloc_logs.numerics import transforms
from semloc_logs.numerics.transforms import yaw_transform

S = 1_000_000_000


def edge(
    parent: str, child: str, pose: F64, stamp_ns: int = 0, *, static: bool = True
) -> TransformSample:
    return TransformSample(Header("/tf", stamp_ns, stamp_ns, parent), child, pose, static)


def drive(parent: str, child: str, seconds: float) -> TransformSample:
    return edge(
        parent,
        child,
        yaw_transform(0.0, (10.0 * seconds, 0.0, 0.0)),
        round(seconds * S),
        static=False,
    )


def test_chain_and_its_inverse() -> None:
    tree = TransformTree()
    tree.add(edge("base_link", "mast", yaw_transform(np.pi / 2, (1.0, 0.0, 2.0))))
    tree.add(edge("/mast", "/lidar", yaw_transform(0.0, (3.0, 0.0, 0.0))))
    base_T_lidar = tree.lookup("base_link", "lidar", 0)
    assert base_T_lidar is not None
    # 3 m ahead on a mast that is turned to the left is 3 m to the left of it
    np.testing.assert_allclose(
        transforms.apply(base_T_lidar, np.zeros((1, 3)))[0], [1.0, 3.0, 2.0], atol=1e-12
    )
    back = tree.lookup("/lidar", "base_link", 5)
    assert back is not None
    np.testing.assert_allclose(back @ base_T_lidar, np.eye(4), atol=1e-12)


def test_same_frame_is_identity_and_strangers_are_unknown() -> None:
    tree = TransformTree()
    tree.add(edge("a", "b", np.eye(4)))
    tree.add(edge("c", "d", np.eye(4)))
    same = tree.lookup("/x", "x", 0)
    assert same is not None
    np.testing.assert_array_equal(same, np.eye(4))
    assert tree.lookup("a", "d", 0) is None
    assert tree.lookup("a", "nowhere", 0) is None
    assert not tree.connected("b", "c")
    # an earlier look-up is not remembered as unconnected
    tree.add(edge("b", "c", np.eye(4)))
    assert tree.connected("a", "d")
    assert tree.frames == ["a", "b", "c", "d"]


def test_moving_edges_are_interpolated_in_their_time_only() -> None:
    tree = TransformTree()
    tree.add(drive("odom", "base_link", 1.0))
    tree.add(drive("odom", "base_link", 1.5))
    tree.add(edge("base_link", "lidar", yaw_transform(0.0, (0.0, 0.0, 2.0))))
    odom_T_lidar = tree.lookup("odom", "lidar", 1_200_000_000)
    assert odom_T_lidar is not None
    np.testing.assert_allclose(odom_T_lidar[:3, 3], [12.0, 0.0, 2.0])
    assert tree.lookup("odom", "lidar", 2 * S) is None


def test_loops_end() -> None:
    tree = TransformTree()
    for parent, child in (("a", "b"), ("b", "c"), ("c", "a"), ("c", "c")):
        tree.add(edge(parent, child, yaw_transform(0.0, (1.0, 0.0, 0.0)), static=False))
    assert tree.lookup("a", "z", 0) is None
    a_T_c = tree.lookup("a", "c", 0)
    assert a_T_c is not None
    assert a_T_c[0, 3] == pytest.approx(-1.0)  # the shorter way round
    assert tree.pose_edge("c") is not None
    assert tree.ignored == 1


def test_the_root_of_a_vehicle_is_above_static_edges_only() -> None:
    tree = TransformTree()
    assert tree.root_above("base_link") is not None  # itself, as nothing is above it
    tree.add(edge("footprint", "base_link", yaw_transform(np.pi / 2, (1.0, 0.0, 0.5))))
    tree.add(edge("ground", "footprint", yaw_transform(0.0, (0.0, 0.0, 0.25))))
    tree.add(drive("base_link", "wheel", 0.0))
    root = tree.root_above("/base_link")
    assert root is not None
    assert root[0] == "ground"
    # the ground is 1 m behind along x of the footprint, which is left of the vehicle
    np.testing.assert_allclose(root[1][:3, 3], [0.0, 1.0, -0.75], atol=1e-12)
    tree.add(drive("odom", "ground", 0.0))
    assert tree.root_above("base_link") is None
    loop = TransformTree()
    for parent, child in (("b", "a"), ("c", "b"), ("b", "c")):
        loop.add(edge(parent, child, np.eye(4)))
    assert loop.root_above("a") is None


def test_nonsense_is_ignored_and_counted() -> None:
    tree = TransformTree()
    tree.add(edge("a", "", np.eye(4)))
    tree.add(edge("a", "b", np.full((4, 4), np.inf)))
    assert tree.ignored == 2
    assert tree.frames == []


def test_the_pose_edge_is_below_odom_else_the_topmost() -> None:
    tree = TransformTree()
    tree.add(edge("base_link", "lidar", np.eye(4)))
    assert tree.pose_edge("lidar") is None
    tree.add(drive("odom", "base_link", 0.0))
    tree.add(drive("map", "odom", 0.0))
    tree.add(drive("base_link", "wheel", 0.0))
    assert tree.pose_edge("lidar") == ("odom", "base_link")
    other = TransformTree()
    other.add(drive("world", "body", 0.0))
    other.add(drive("body", "head", 0.0))
    other.add(edge("head", "camera", np.eye(4)))
    assert other.pose_edge("camera") == ("world", "body")
    assert other.pose_edge("unheard_of") is None


def test_dynamic_overrules_static_for_the_same_edge() -> None:
    tree = TransformTree()
    tree.add(edge("a", "b", yaw_transform(0.0, (7.0, 0.0, 0.0))))
    tree.add(drive("a", "b", 1.0))
    tree.add(edge("a", "b", yaw_transform(0.0, (7.0, 0.0, 0.0))))
    a_T_b = tree.lookup("a", "b", S)
    assert a_T_b is not None
    assert a_T_b[0, 3] == 10.0
    assert tree.edges == [("a", "b", False)]


def test_the_largest_change_of_a_static_transform_is_kept() -> None:
    tree = TransformTree()
    tree.add(TransformSample(Header("", 0, 0, "base"), "lidar", np.eye(4), static=True))  # lent
    tree.add(edge("base", "lidar", yaw_transform(0.0, (1.0, 0.0, 0.0))))
    tree.add(edge("base", "lidar", yaw_transform(0.0, (1.0, 0.0, 1e-5))))
    assert tree.changes == {}
    tree.add(edge("base", "lidar", yaw_transform(0.0, (1.5, 0.0, 0.0))))
    tree.add(edge("base", "lidar", yaw_transform(0.3, (1.5, 0.0, 0.0))))
    change = tree.changes["base", "lidar"]
    assert change.distance == pytest.approx(0.5)
    assert change.angle == pytest.approx(0.0)
    assert list(tree.changes) == [("base", "lidar")]

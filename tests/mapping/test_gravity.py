"""Up as it is found in a street, a street canyon and a box, whatever the axes of the frames are."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64
from semloc_logs.errors import SettingsError
from semloc_logs.frames import Header, PosedCloud
from semloc_logs.logs.session.session import Session
from semloc_logs.mapping.gravity import Expected, Gravity, UpSource, find_gravity, given_gravity
from semloc_logs.mapping.keyframes import Collected
from semloc_logs.mapping.levelling import Level, level
from semloc_logs.mapping.up_direction import FlatPlaces, flat_places
from semloc_logs.mapping.up_evidence import UpEvidence
from semloc_logs.numerics.transforms import apply, inverse, transform
from semloc_logs.settings import load

X, Y, Z = np.eye(3)
AXES = Rotation.create_group("O").as_matrix()  # the 24 rotations of a cube
TURNS = [*AXES, *Rotation.random(12, random_state=0).as_matrix()]
FUSION = load(assignments={"fusion.voxel_size": "0.3"}).resolved().fusion
HEIGHT = 1.8  # m of the sensor above the ground
SPACING = 0.15  # m between points


def degrees_between(a: F64, b: F64) -> float:
    return math.degrees(math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b)))


def plane(corner: F64, first: F64, second: F64) -> F64:
    """Points (n, 3) of a rectangle with two edges, 15 cm apart."""
    counts = [int(np.linalg.norm(edge) / SPACING) for edge in (first, second)]
    a, b = np.meshgrid(*(np.linspace(0, 1, count) for count in counts), indexing="ij")
    return np.asarray(corner + a.reshape(-1, 1) * first + b.reshape(-1, 1) * second)


def street() -> F64:
    """A street with fronts 7 and 9 m to the sides, seen from 1.8 m above it: z is up."""
    rng = np.random.default_rng(0)
    ground = plane(np.array([-12.0, -7.0, -HEIGHT]), 24 * X, 16 * Y)
    right = plane(np.array([-12.0, -7.0, -HEIGHT]), 24 * X, 6 * Z)
    left = plane(np.array([-12.0, 9.0, -HEIGHT]), 24 * X, 5 * Z)
    # crowns of trees, and points behind windows
    trees = rng.uniform((-12, -6, 1), (12, -4, 4), (800, 3))
    rooms = rng.uniform((-12, 9, -1.5), (12, 13, 3), (400, 3))
    return np.concatenate([ground, right, left, trees, rooms])


def box() -> F64:
    """A closed box with a square section, seen from its middle: nothing tells up from down."""
    walls = []
    for axis in np.eye(3):
        one, two = np.roll(axis, 1), np.roll(axis, 2)
        walls += [plane(4 * s * axis - 4 * one - 4 * two, 8 * one, 8 * two) for s in (-1.0, 1.0)]
    return np.concatenate(walls)


def straight(count: int = 6) -> F64:
    """Poses (n, 4, 4), 2 m apart along x."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = 2.0 * np.arange(count)
    return poses


def find(points: F64, convention: F64, poses: F64 | None = None, imu: F64 | None = None) -> Gravity:
    """Up of a session in whose frame all ``points`` (n, 3) are, relative to the sensor."""
    places = flat_places(points.astype(np.float32), np.zeros(3), 0.2)
    evidence = UpEvidence([places] * 3, np.zeros((0, 4, 4)) if poses is None else poses, 1.0)
    expected = Expected("drive.mcap", "odom", convention, imu, "/imu")
    return find_gravity(expected, places.normals, places.weights, evidence)


@pytest.mark.parametrize("turn", TURNS)
def test_up_is_found_in_any_axes(turn: F64) -> None:
    """The same street, with the convention pointing anywhere."""
    poses = straight()
    poses[:, :3, 3] = poses[:, :3, 3] @ turn.T
    poses[:, :3, :3] = turn
    gravity = find(street() @ turn.T, Z, poses)
    assert degrees_between(gravity.up, turn @ Z) < 1
    assert not gravity.is_assumed
    assert gravity.source is UpSource.MAP
    assert gravity.margin is not None
    assert gravity.margin > 0.1
    # a direction against the convention is a note, an expected one needs none
    off = degrees_between(turn @ Z, Z)
    assert bool(gravity.problems) == (off > 40)
    assert gravity.off_convention == pytest.approx(off, abs=1)


@pytest.mark.parametrize("convention", [X, -X, Y, -Y, Z, -Z])
def test_the_convention_decides_where_the_evidence_is_equal(convention: F64) -> None:
    gravity = find(box(), convention)
    assert degrees_between(gravity.up, convention) < 1
    assert gravity.source is UpSource.CONVENTION
    assert gravity.margin is not None
    assert abs(gravity.margin) < 0.05
    (problem,) = gravity.problems
    assert problem.assumed
    assert "by convention, and" in problem.text
    assert "fits about as well" in problem.text


def test_a_box_is_level_in_the_plane_of_motion() -> None:
    """Whoever moves along two axes moves on the floor."""
    poses = straight(9)
    poses[5:, 0, 3] = poses[4, 0, 3]
    poses[5:, 1, 3] = 2.0 * np.arange(1, 5)
    gravity = find(box(), X, poses)
    assert degrees_between(gravity.up, Z) < 1 or degrees_between(gravity.up, -Z) < 1


def test_an_imu_that_agrees_says_nothing() -> None:
    tilted = Rotation.from_rotvec(np.radians(5) * X).as_matrix() @ Z
    gravity = find(street(), -Z, imu=tilted)
    assert degrees_between(gravity.up, Z) < 1
    assert gravity.source is UpSource.IMU
    assert gravity.off_imu == pytest.approx(5, abs=1)
    assert not gravity.problems


def test_an_imu_whose_mounting_is_turned_is_named_and_the_map_is_level() -> None:
    tilted = Rotation.from_rotvec(np.radians(20) * X).as_matrix() @ Z
    gravity = find(street(), Z, imu=tilted)
    assert degrees_between(gravity.up, Z) < 1
    [problem] = gravity.problems
    assert not problem.is_reported
    assert "up of /imu is 20 degrees off the ground and the walls of the map" in problem.text


@pytest.mark.parametrize("imu", [-Z, X, Y])
def test_an_imu_that_contradicts_the_map_is_not_believed(imu: F64) -> None:
    """Of another axis convention, or with the sign of free fall."""
    gravity = find(street(), Z, imu=imu)
    assert degrees_between(gravity.up, Z) < 1
    assert gravity.source is UpSource.MAP
    assert gravity.is_assumed
    (problem,) = gravity.problems
    assert problem.topic == "/imu"
    assert problem.text.startswith("drive.mcap: /imu contradicts the map: its up is ")
    assert "logs.up" in problem.text


def test_an_imu_is_believed_where_the_map_does_not_tell() -> None:
    gravity = find(box(), Z, imu=-Y)
    assert degrees_between(gravity.up, -Y) < 1
    assert (gravity.source, gravity.problems) == (UpSource.IMU, ())


def test_without_surfaces_the_convention_is_assumed_and_an_imu_is_not() -> None:
    points = np.random.default_rng(0).normal(size=(500, 3)) * 10
    gravity = find(points, Z)
    assert np.array_equal(gravity.up, Z)
    assert (gravity.source, gravity.margin, gravity.is_assumed) == (UpSource.CONVENTION, None, True)
    assert "+z of frame 'odom' is taken as up by convention" in gravity.problems[0].text
    with_imu = find(points, Z, imu=Y)
    assert np.array_equal(with_imu.up, Y)
    assert (with_imu.source, with_imu.problems) == (UpSource.IMU, ())


@pytest.mark.parametrize(
    ("share", "how"), [(1.0, "and -z fits about as well"), (0.6, "but -z"), (0.0, "but -z")]
)
def test_a_ceiling_that_shows_as_much_as_the_floor_is_doubtful(share: float, how: str) -> None:
    """The ``share`` of the floor is seen; the convention stays, which a problem names."""
    slab = [plane(np.array([-9.0, -9.0, z]), 18 * X, 18 * Y) for z in (2.0, -2.0)]
    walls = [
        plane(np.array([-9.0, -9.0, -2.0]), 18 * X, 4 * Z),
        plane(np.array([-9.0, -9.0, -2.0]), 18 * Y, 4 * Z),
        plane(np.array([9.0, -9.0, -2.0]), 18 * Y, 4 * Z),
    ]
    floor = slab[1][slab[1][:, 0] < -9 + 18 * share]
    gravity = find(np.concatenate([slab[0], floor, *walls]), Z)
    assert degrees_between(gravity.up, Z) < 1
    assert gravity.is_assumed
    assert f"+z of frame 'odom' is taken as up by convention, {how}" in gravity.problems[0].text


@pytest.mark.parametrize(("height", "is_flipped"), [(1.2, True), (2.8, False)])
def test_the_floor_is_nearer_than_the_ceiling(height: float, is_flipped: bool) -> None:
    """A hall of 4 m whose floor shows more than its ceiling, with the convention upside down.

    It is doubtful either way: only the sensor below the middle of the hall tells.
    """
    floor = plane(np.array([-9.0, -9.0, -height]), 18 * X, 18 * Y)
    ceiling = plane(np.array([-9.0, -9.0, 4 - height]), 6 * X, 18 * Y)
    walls = [
        plane(np.array([-9.0, -9.0, -height]), 18 * X, 4 * Z),
        plane(np.array([-9.0, -9.0, -height]), 18 * Y, 4 * Z),
    ]
    gravity = find(np.concatenate([floor, ceiling, *walls]), -Z)
    assert degrees_between(gravity.up, Z if is_flipped else -Z) < 1
    assert gravity.is_assumed


@pytest.mark.parametrize("imu", [None, Z])
def test_a_wall_that_fills_the_view_is_not_the_ground(imu: F64 | None) -> None:
    """A camera before a wall sees a strip of floor; walls beside it are perpendicular to up."""
    wall = plane(np.array([2.0, -3.0, -1.0]), 6 * Y, 3 * Z)
    floor = plane(np.array([1.0, -3.0, -1.0]), 1.0 * X, 6 * Y)
    sides = [plane(np.array([0.5, y, -1.0]), 1.5 * X, 3 * Z) for y in (-3.0, 3.0)]
    points = np.concatenate([wall, wall + 0.003, floor, *sides])
    poses = straight()
    poses[:, :2, 3] = poses[:, 1::-1, 3]  # along the wall
    gravity = find(points, Z, poses, imu)
    assert degrees_between(gravity.up, Z) < 1
    assert gravity.is_assumed
    assert "fits better" in gravity.problems[0].text


def test_a_direction_that_is_given_overrules_all_and_is_refined() -> None:
    places = flat_places(street().astype(np.float32), np.zeros(3), 0.2)
    given = Rotation.from_rotvec(np.radians(8) * Y).as_matrix() @ (3 * Z)
    gravity = given_gravity(given, places.normals, places.weights)
    assert degrees_between(gravity.up, Z) < 1
    down = given_gravity(-Z, places.normals, places.weights)
    assert degrees_between(down.up, -Z) < 1
    assert (down.source, down.problems) == (UpSource.SETTING, ())


@pytest.mark.parametrize(
    ("text", "vector"),
    [
        ("auto", None),
        ("+z", (0, 0, 1)),
        ("-x", (-1, 0, 0)),
        ("0,0.5,-2", (0, 0.5, -2)),
        ("[1, 0, 0]", (1, 0, 0)),
    ],
)
def test_the_setting_is_an_axis_or_a_vector(text: str, vector: tuple[float, ...] | None) -> None:
    assert load(assignments={"logs.up": text}).logs.up_vector == vector


@pytest.mark.parametrize("text", ["z", "up", "1,2", "0,0,0", "nan,0,1", "1,2,3,4", "5"])
def test_other_text_is_refused(text: str) -> None:
    with pytest.raises(SettingsError, match=r"'logs\.up'"):
        load(assignments={"logs.up": text})


def test_flat_places_face_the_sensor() -> None:
    places = flat_places(street().astype(np.float32), np.array([0.0, 0.0, 0.5]), 0.2)
    assert (np.einsum("nk,nk->n", places.normals, places.centres) <= 0).all()
    ground = np.abs(places.centres[:, 2] + HEIGHT + 0.5) < 0.01
    assert np.median(places.normals[ground], axis=0) @ Z > 0.99
    turned = places.turned(AXES[5])
    assert np.allclose(turned.normals, places.normals @ AXES[5].T)
    empty = flat_places(np.zeros((0, 3), np.float32), np.zeros(3), 0.2)
    assert isinstance(empty, FlatPlaces)
    assert len(empty.points) == len(empty.normals) == 0


# -- whole sessions


def collected(folder: Path, session_T_street: F64, base_T_sensor: F64, posed: bool) -> Collected:
    """Three keyframes of the street, 3 m apart; ``base_T_sensor`` (4, 4), the sensor is level in
    the street.
    """
    out = Collected(folder, 0.1)
    for k in range(3):
        street_T_sensor = transform(np.array([3.0 * k, 0, HEIGHT]), np.array([0.0, 0, 0, 1]))
        session_T_base = session_T_street @ street_T_sensor @ inverse(base_T_sensor)
        points = apply(base_T_sensor, street()).astype(np.float32)
        cloud = PosedCloud(
            Header("/points", k, k, "lidar"),
            points,
            base_T_sensor[:3, 3].astype(np.float32),
            session_T_base if posed else None,
        )
        out.add(cloud, np.arange(len(points)))
    return out


def levelled(
    clouds: Collected, session_frame: str = "odom", base_frame: str = "base_link", **settings: str
) -> Level:
    session: Any = SimpleNamespace(
        name="drive.mcap",
        session_frame=session_frame,
        base_frame=base_frame,
        cameras={},
        roles=SimpleNamespace(imu=None),
        imu_up_in_session=lambda: None,
        imu_up_in_base=lambda: None,
    )
    keys = {f"{'logs' if k == 'up' else 'fusion'}.{k}": v for k, v in settings.items()}
    return level(cast(Session, session), clouds, load(assignments=keys).resolved())


TILTED = Rotation.from_euler("yx", [[-60, 0], [90, 0], [0, 90]], degrees=True).as_matrix()


def rotated(rotation: F64, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> F64:
    out = np.eye(4)
    out[:3, :3] = rotation
    out[:3, 3] = x, y, z
    return out


@pytest.mark.parametrize("posed", [True, False])
@pytest.mark.parametrize(
    ("frames", "mounting"),
    [
        (np.eye(3), np.eye(3)),
        (np.diag([1.0, -1, -1]), np.diag([1.0, -1, -1])),  # north-east-down, forward-right-down
        (np.eye(3), np.diag([-1.0, 1, -1])),  # upside down, with level odometry
        # odometry starts at the identity of a sensor with 60 or 90 degrees of pitch, 90 of roll
        *((m, m) for m in TILTED),
    ],
)
def test_the_map_is_level_however_the_frames_are(
    frames: F64, mounting: F64, posed: bool, tmp_path: Path
) -> None:
    """The ground of every keyframe is 1.8 m below the sensor, in the map of a session with poses
    and in the levelled keyframes of one without.
    """
    base_T_sensor = rotated(mounting, 0.3, 0.2, 0.1)
    clouds = collected(tmp_path, rotated(frames, 5e5, 6e6, 100), base_T_sensor, posed)
    levelling = levelled(clouds)
    assert not levelling.gravity.is_assumed
    for map_T_base in levelling.map_T_base:
        points = apply(map_T_base @ base_T_sensor, street())
        sensor = apply(map_T_base, base_T_sensor[:3, 3][None])[0]
        ground = points[: len(points) // 2]
        ground = ground[np.abs(street()[: len(ground), 2] + HEIGHT) < 1e-6]
        assert np.abs(sensor[2] - ground[:, 2] - HEIGHT).max() < 0.1


def test_the_same_frames_give_the_same_map_wherever_the_convention_points(tmp_path: Path) -> None:
    """A level drive is not touched by the search over the sphere."""
    clouds = collected(tmp_path, np.eye(4), np.eye(4), posed=True)
    levelling = levelled(clouds)
    assert degrees_between(levelling.session_T_map[:3, 2], Z) < 0.1
    assert levelling.gravity.problems == ()
    assert set(levelling.gravity.to_json()) == {
        "source",
        "up",
        "margin",
        "assumed",
        "off_convention_deg",
        "off_imu_deg",
    }


@pytest.mark.parametrize(
    ("frame", "up"),
    [("odom", Z), ("ned", -Z), ("map_ned", -Z), ("uav1/odom_ned", -Z), ("planned", Z), ("", Z)],
)
def test_names_of_frames_tell_the_convention(frame: str, up: F64, tmp_path: Path) -> None:
    """REP 103: z is up, but in frames with the suffix _ned it is down."""
    clouds = Collected(tmp_path, 0.1)
    points = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)
    header = Header("/points", 1, 1, "lidar")
    clouds.add(PosedCloud(header, points, np.zeros(3, np.float32), np.eye(4)), np.arange(300))
    levelling = levelled(clouds, session_frame=frame)
    assert np.array_equal(levelling.gravity.up, up)
    assert np.allclose(levelling.session_T_map[:3, 2], up)
    assert np.allclose(levelled(clouds, frame, up="-y").gravity.up, -Y)

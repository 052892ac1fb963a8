"""Two sessions that mount one sensor differently, by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from semloc_logs.closures.exclusions import Exclusions
from semloc_logs.closures.other_mountings import Mounted, contradiction, contradictions
from semloc_logs.closures.session_pairs import Pair
from semloc_logs.numerics.transforms import exp_se3
from semloc_logs.settings import load


def session(
    x: float = 0.3,
    z: float = 1.9,
    roll: float = 0.0,
    *,
    height: float = 0.0,
    hidden: tuple[str, ...] = (),
    base: str = "base_link",
) -> Mounted:
    """A LIDAR at x, z with a roll (degrees), in a base frame ``height`` above the ground."""
    pose = exp_se3(np.zeros(3), np.array([np.radians(roll), 0.0, 0.0]))
    pose[:3, 3] = x, 0.0, z
    return Mounted(base, {"lidar": pose}, {"lidar": frozenset(hidden)}, height, 0.3)


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (session(z=0.0, height=1.9), "at z = 1.90 m in one and at 0.00 m in the other"),
        (session(z=0.0, height=1.4), "at z = 1.90 m in one and at 0.00 m in the other"),
        (session(roll=18.0, hidden=("rotation_x_rad",)), "turned by 18.0 degrees about x"),
        (session(x=1.8, hidden=("lever_x_m",)), "shifted by 1.50 m along x between both"),
        (session(roll=5.0, hidden=("rotation_x_rad",)), "turned by 5.0 degrees about x"),
    ],
)
def test_mountings_of_which_one_is_wrong_are_named(other: Mounted, words: str) -> None:
    text = contradiction(session(), other)
    assert text.startswith("'lidar' is mounted in 'base_link' ")
    assert words in text
    assert contradiction(other, session()) != ""


@pytest.mark.parametrize(
    "other",
    [
        session(),
        session(z=0.0, height=0.0),  # a low vehicle: its sensor is lower, too
        session(z=0.0, height=np.nan),
        session(z=0.0, height=0.9),  # neither as high nor as low
        session(roll=22.0, hidden=("rotation_x_rad",)),  # a base frame of other axes
        session(x=1.8),  # another vehicle, whose drive showed that its mounting fits
        session(x=0.9, hidden=("lever_x_m",)),  # 0.6 m: 2 voxels
        session(z=-1.9, roll=180.0, hidden=("rotation_x_rad",)),  # a base frame with z down
        session(roll=4.0, hidden=("rotation_x_rad",)),
        session(x=1.8, hidden=("lever_y_m", "rotation_x_rad")),
        session(x=1.8, hidden=("lever_x_m",), base="body"),
    ],
)
def test_other_vehicles_and_small_differences_are_not_named(other: Mounted) -> None:
    assert contradiction(session(), other) == ""


def mounted_at(x: float, camera_x: float = 0.0, hidden: tuple[str, ...] = ("lever_x_m",)) -> Any:
    """A session with a LIDAR and a camera beside it; only the LIDAR measures ranges."""
    poses = {"lidar": np.eye(4), "camera": np.eye(4)}
    poses["lidar"][0, 3] = x
    poses["camera"][0, 3] = camera_x
    stream = {"pairs": 24, "hidden": list(hidden), "frames": ["lidar"]}
    return SimpleNamespace(
        posed=True,
        is_map=False,
        misfits=[],
        map_T_base=np.eye(4)[None],
        ground_z=np.array([-1.9]),
        json={
            "base_frame": "base_link",
            "voxel_size": 0.3,
            "base_T_sensors": {frame: pose.tolist() for frame, pose in poses.items()},
            "fit": {"streams": [stream]},
        },
    )


def test_the_height_is_of_the_keyframes_that_saw_ground() -> None:
    drive = mounted_at(0.0)
    drive.map_T_base = np.array([exp_se3(np.array([7.0, 8.0, z]), np.zeros(3)) for z in (0.2, 9.0)])
    drive.ground_z = np.array([-1.7, np.nan])
    assert Mounted.of(drive).height == pytest.approx(1.9)
    drive.ground_z[0] = np.nan
    assert np.isnan(Mounted.of(drive).height)


def test_a_camera_that_only_paints_labels_is_not_compared() -> None:
    assert contradictions({"a": mounted_at(0.0), "b": mounted_at(0.0, camera_x=1.5)}) == {}
    assert list(contradictions({"a": mounted_at(0.0), "b": mounted_at(1.5)})) == [{"a", "b"}]


def test_what_one_stream_hides_is_not_hidden_of_another_sensor() -> None:
    shown = mounted_at(1.5, hidden=())
    shown.json["fit"]["streams"].append({"pairs": 0, "hidden": [], "frames": ["depth"]})
    assert contradictions({"a": mounted_at(0.0, hidden=()), "b": shown}) == {}


def test_many_pairs_with_one_contradiction_are_one_sentence() -> None:
    maps = {name: mounted_at(0.0) for name in "abc"} | {name: mounted_at(1.5) for name in "de"}
    exclusions = Exclusions.of(maps, load().resolved())
    [sentence] = exclusions.sentences()
    assert sentence.startswith(
        "6 pairs of sessions, such as a and d, get no closures with each other: 'lidar' is mounted"
        " in 'base_link' shifted by 1.50 m along x between both"
    )
    excluded = [(q, t) for q in "abcde" for t in "abcde" if exclusions.has(Pair(q, t))]
    crossing = [(one, other) for one in "abc" for other in "de"]
    assert sorted(excluded) == sorted(crossing + [(other, one) for one, other in crossing])
    del maps["b"], maps["c"], maps["e"]
    [sentence] = Exclusions.of(maps, load().resolved()).sentences()
    assert sentence.startswith("Sessions a and d get no closures with each other: ")


def test_a_session_that_does_not_fit_is_excluded_and_not_compared() -> None:
    maps = {"a": mounted_at(0.0), "b": mounted_at(1.5)}
    maps["b"].misfits = ["the poses jump"]
    exclusions = Exclusions.of(maps, load().resolved())
    assert exclusions.sentences() == [
        "Session b gets no closures: its poses do not fit (the poses jump);"
        " --set closures.misfits=true searches it all the same."
    ]
    assert exclusions.has(Pair("b", "b"))
    assert not exclusions.has(Pair("a", "a"))
    overruled = load(assignments={"closures.misfits": "true"}).resolved()
    assert Exclusions.of(maps, overruled).sentences() == []

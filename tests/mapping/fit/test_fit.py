"""Faults between poses and range data that are put in are found, with their size."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64
from semloc_logs.logs.poses.mountings import matrix
from semloc_logs.mapping.fit import fit_check
from semloc_logs.mapping.fit.fault_texts import corrected
from semloc_logs.mapping.fit.findings import SessionFit, Severity, StreamFit
from semloc_logs.mapping.fit.fit_check import check_stream, explained_share
from semloc_logs.mapping.fit.keyframe_pairs import SensorMounting
from semloc_logs.mapping.fit.model import MEDIAN_OF_6, Estimate, Fault
from semloc_logs.mapping.fit.plane_cells import PlaneCells, register
from semloc_logs.mapping.keyframes import Collected
from semloc_logs.numerics.transforms import exp_se3, inverse, rotation_angle, yaw_transform
from semloc_logs.settings import load
from semloc_logs.stages.log_check import check_log

TOPIC = "/points"  # of the drives
Check = Callable[..., StreamFit]


@pytest.fixture
def check(tmp_path: Path, streets: SimpleNamespace) -> Check:
    """Checks a drive with the faults that are put in."""

    def checked(*args: Any, **faults: Any) -> StreamFit:
        clouds, track = streets.drive(Path(tempfile.mkdtemp(dir=tmp_path)), *args, **faults)
        return check_stream(TOPIC, clouds, track.at_many)

    return checked


def _only(fit: StreamFit) -> str:
    [finding] = fit.findings
    assert finding.severity is Severity.WRONG
    return finding.text


def test_a_cloud_is_registered_with_one_that_was_moved(streets: SimpleNamespace) -> None:
    world = streets.street()
    target = world[np.linalg.norm(world - [20, 0, 0], axis=1) < 15] - [20, 0, 0]
    moved = exp_se3(np.array([0.5, -0.3, 0.1]), np.radians([1.0, -2.0, 4.0]))
    coarse = PlaneCells.of(target, 1.2)
    fine = PlaneCells.of(target, 0.6)
    source = (target @ inverse(moved)[:3, :3].T + inverse(moved)[:3, 3])[::5]
    fit = register(fine, source, register(coarse, source, np.eye(4)).target_T_source)
    off = inverse(moved) @ fit.target_T_source
    assert np.linalg.norm(off[:3, 3]) < 0.02
    assert rotation_angle(off[:3, :3]) < 0.002
    assert fit.share > 0.6
    assert np.linalg.eigvalsh(fit.information).min() > 0


def test_points_off_every_plane_register_with_nothing() -> None:
    ball = np.random.default_rng(0).normal(0, 0.3, (500, 3))
    fit = register(PlaneCells.of(ball, 0.6), ball + 100.0, np.eye(4))
    assert fit.share == 0.0
    assert fit.rms == np.inf
    np.testing.assert_array_equal(fit.target_T_source, np.eye(4))


def test_poses_that_fit_are_not_accused(check: Check) -> None:
    fit = check()
    assert fit.findings == []
    assert fit.hidden == []
    assert fit.pairs > 20
    assert fit.translation_m < 0.03
    for name in ("clock_s", "lever_x_m", "lever_y_m", "rotation_z_rad", "scale_log"):
        estimate, sigma = fit.parameters[name]
        assert abs(estimate) < 5 * sigma


@pytest.mark.parametrize("late", [-0.4, 0.15, 1.2])
def test_the_offset_of_a_clock_is_found(check: Check, late: float) -> None:
    fit = check(clock=late)
    assert "clock" in _only(fit)
    side = "behind" if late < 0 else "ahead of"
    assert f"s {side} the clock of the poses" in _only(fit)
    assert f"--set logs.time_offset.{TOPIC}={-late:+.1f}" in _only(fit)
    estimate, sigma = fit.parameters["clock_s"]
    assert estimate == pytest.approx(-late, abs=max(0.02, 4 * sigma))


@pytest.mark.parametrize("is_camera", [False, True])
@pytest.mark.parametrize("late", [-0.8, -0.4, -0.1, 0.1, 0.4, 0.8])
def test_an_offset_of_either_sign_is_found_for_a_lidar_and_a_camera(
    check: Check, late: float, is_camera: bool
) -> None:
    fit = check(clock=late, is_camera=is_camera)
    assert f"{abs(late):.1f}" in _only(fit)
    assert "clock of the poses" in _only(fit)
    estimate, sigma = fit.parameters["clock_s"]
    assert estimate == pytest.approx(-late, abs=max(0.03, 4 * sigma))


def test_a_camera_whose_poses_fit_is_not_accused(check: Check) -> None:
    assert check(is_camera=True).findings == []


@pytest.mark.parametrize("late", [-0.4, 0.1, 0.4])
def test_the_offset_of_a_real_depth_camera_is_found(
    shared: Callable[[str], Path], late: float
) -> None:
    log = shared("logs/room_a.mcap")
    topic = "/camera/depth/image"
    offset = {f"logs.time_offset.{topic}": str(late), "fusion.voxel_size": "0.05"}
    [stream] = check_log(log, load(assignments=offset), {}).streams
    side = "ahead of" if late > 0 else "behind"
    assert re.match(rf"its stamps are {abs(late)}[0-9] \u00b1 0.0[0-9] s {side}", _only(stream))
    # the offset that made the fault is to be left out
    assert re.search(rf"--set logs.time_offset.{topic}=[+-]0\.0[0-2]$", _only(stream))


@pytest.mark.parametrize("axis", [1, 2])
def test_a_turned_mounting_is_found(check: Check, axis: int) -> None:
    turn = np.zeros(3)
    turn[axis] = np.radians(4.0)
    fit = check(base_T_assumed=exp_se3(np.zeros(3), turn))
    assert f"degrees about {'xyz'[axis]} of the base frame" in _only(fit)
    estimate, _ = fit.parameters[f"rotation_{'xyz'[axis]}_rad"]
    assert np.degrees(estimate) == pytest.approx(4.0, abs=0.5)


@pytest.mark.parametrize(
    ("shift", "degrees"),
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 4.0)),
        ((1.2, -0.8, 0.0), (0.0, 0.0, 0.0)),
        ((0.0, 1.0, 0.0), (0.0, 0.0, -6.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 90.0)),
    ],
    ids=["turned", "shifted", "both", "other axes"],
)
def test_the_mounting_that_is_to_be_given_is_right(
    tmp_path: Path,
    streets: SimpleNamespace,
    shift: tuple[float, ...],
    degrees: tuple[float, ...],
) -> None:
    """With the pose of the sensor as the sentence gives it, the clouds fit the poses."""
    true = exp_se3(np.array([0.5, 0.2, 1.8]), np.radians([0.0, 5.0, 20.0]))
    assumed = true.copy()
    assumed[:3, 3] -= shift
    assumed[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix().T @ true[:3, :3]
    wrong = true @ inverse(assumed)
    folders = [tmp_path / "given", tmp_path / "corrected"]
    for folder in folders:
        folder.mkdir()
    clouds, track = streets.drive(folders[0], base_T_assumed=wrong)
    clouds = replace(clouds, mounted=SensorMounting("lidar", assumed))
    text = _only(check_stream(TOPIC, clouds, track.at_many))
    values = re.search(r"--set logs\.mountings\.lidar=\[(.*)\]$", text)
    assert values is not None, text
    given = matrix(tuple(float(v) for v in values[1].split(",")))

    # clouds in the base frame as it follows from the given pose
    rest = true @ inverse(given)
    clouds, track = streets.drive(folders[1], base_T_assumed=rest)
    assert check_stream(TOPIC, clouds, track.at_many).findings == []


def test_coordinates_that_are_not_shifted_stay_where_the_mounting_is_turned() -> None:
    mounting = yaw_transform(0.0, (2.0, 0.0, 1.0))
    quarter = np.array([0.0, 0.0, np.pi / 2])
    turned = corrected(mounting, np.zeros(3), quarter)
    assert turned == pytest.approx(yaw_transform(np.pi / 2, (2.0, 0.0, 1.0)), abs=1e-12)
    # turned about the base frame it is at (0, 2, 1), from where it moves by 3 m along x
    both = corrected(mounting, np.array([3.0, 0.0, 0.0]), quarter)
    assert both == pytest.approx(yaw_transform(np.pi / 2, (3.0, 0.0, 1.0)), abs=1e-12)


def test_a_shifted_mounting_is_found_where_the_vehicle_turns(check: Check) -> None:
    mounting = exp_se3(np.array([1.2, 0.0, 0.0]), np.zeros(3))
    fit = check(base_T_assumed=mounting)
    assert "m along x of the base frame" in _only(fit)
    assert fit.parameters["lever_x_m"][0] == pytest.approx(1.2, abs=0.2)


def test_the_height_of_a_mounting_with_the_wrong_sign_is_found_over_humps(
    check: Check, streets: SimpleNamespace
) -> None:
    """The sensor is 1.9 m above the base, the log has it 1.9 m below: 3.8 m."""
    shift = yaw_transform(0.0, (0.0, 0.0, 3.8))
    text = _only(check(streets.hilly, base_T_assumed=shift, origin=(0.3, 0.0, -1.9)))
    assert "its mounting has to move by +3." in text
    assert "m along z of the base frame, as where its z of -1.90 m has the wrong sign" in text
    assert "wrong sign" not in _only(
        check(streets.hilly, base_T_assumed=shift, origin=(0.3, 0.0, 1.9))
    )


@pytest.mark.parametrize("part", ["rotations", "positions"])
@pytest.mark.parametrize("late", [0.6, 1.0])
def test_rotations_and_positions_of_different_times_are_named(
    check: Check, part: str, late: float
) -> None:
    steps = round(late / 0.05)  # the drive has poses 0.05 s apart
    columns = slice(3) if part == "rotations" else 3

    def lagging(poses: F64) -> F64:
        out = poses.copy()
        out[steps:, :3, columns] = poses[:-steps, :3, columns]
        out[:steps, :3, columns] = poses[0, :3, columns]
        return out

    text = _only(check(as_written=lagging))
    assert f"their {part} are taken {late:.2f} s later: the {part} are behind" in text


@pytest.mark.parametrize(
    ("gain", "sigma", "share"),
    [
        (14.0, 0.001, 14 / 13),  # much beside the noise that is expected
        (8.0, 0.05, 40 / 13),  # 0.5 * 4 ** 2 = 8: as the standard deviation has it, at a fifth
        (2.0, 0.1, 10 / 13),  # 2 sigma
        (8.0, 0.002, 8 / 13),  # a dip 100 standard deviations off: as if the cost fell by 5000
    ],
)
def test_a_small_gain_counts_where_the_cost_falls_as_expected(
    gain: float, sigma: float, share: float
) -> None:
    """Of 24 pairs with a tenth of the expected scatter: (3 + 24 x 0.1) / (3 + 24) = 0.2."""
    covariance = np.zeros((8, 8))
    covariance[0, 0] = sigma**2
    squares = np.full(24, 0.1 * MEDIAN_OF_6)
    before = Estimate(np.zeros(8), np.zeros(0, np.int64), np.zeros((8, 8)), 20.0, squares)
    offset = np.array([0.2, *[0.0] * 7])
    after = Estimate(offset, Fault.CLOCK.columns, covariance, 20.0 - gain, squares)
    assert explained_share(Fault.CLOCK, before, after) == pytest.approx(share)


def test_what_few_pairs_almost_explain_more_pairs_decide(
    check: Check, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit_check, "FEWEST_PAIRS", 8)
    monkeypatch.setattr(fit_check, "MORE_PAIRS", 1)
    few = check(is_camera=True, clock=0.04)
    assert (few.pairs, few.is_doubtful, few.findings) == (8, True, [])
    monkeypatch.setattr(fit_check, "MORE_PAIRS", 3)
    more = check(is_camera=True, clock=0.04)
    assert more.pairs == 24
    [finding] = more.findings
    assert "its stamps are 0.04" in finding.text
    # without a doubt there are no more
    assert check(is_camera=True).pairs == 8


def test_an_offset_as_long_as_a_sweep_may_be_from_its_other_end(
    tmp_path: Path, streets: SimpleNamespace
) -> None:
    clouds, track = streets.drive(tmp_path, clock=-0.1)
    for span, is_told in ((0.1, True), (0.0, False), (0.4, False)):
        text = _only(check_stream(TOPIC, replace(clouds, span=span), track.at_many))
        assert "its stamps are 0.1" in text
        assert (f"a sweep takes {span:.2f} s" in text) == is_told


@pytest.mark.parametrize("fast", [0.02, -0.02])
def test_a_clock_that_drifts_is_named_with_its_offsets_at_both_ends(
    check: Check, fast: float
) -> None:
    text = _only(check(fast=fast, seconds=30.0))
    first, last = (float(v) for v in re.findall(r"([+-][0-9.]+) s", text))
    # the first and the last third of 1.5 to 28.5 s
    assert first == pytest.approx(-6.0 * fast, abs=0.05)
    assert last == pytest.approx(-24.0 * fast, abs=0.05)
    assert "the clocks drift apart" in text


def test_a_steady_clock_does_not_drift(check: Check) -> None:
    assert "drift apart" not in _only(check(clock=0.4, seconds=30.0))
    assert check(seconds=30.0).findings == []


def test_an_offset_is_added_to_the_one_that_is_given_and_as_sure_as_the_sweep_is_short(
    tmp_path: Path, streets: SimpleNamespace
) -> None:
    """0.4 s late in all; the settings have put a part right."""
    clouds, track = streets.drive(tmp_path, clock=0.4)
    for given, wanted in ((0.0, "-0.40"), (-0.25, "-0.65"), (0.1, "-0.30")):
        text = _only(check_stream(TOPIC, replace(clouds, time_offset=given), track.at_many))
        assert f"logs.time_offset.{TOPIC}={wanted}" in text
    for span, sigma in ((0.0, "0.01"), (0.1, "0.05")):
        text = _only(check_stream(TOPIC, replace(clouds, span=span), track.at_many))
        assert f"its stamps are 0.40 \u00b1 {sigma} s ahead" in text


def test_a_straight_and_steady_drive_hides_clock_and_lever_arm_and_says_so(
    check: Check, streets: SimpleNamespace
) -> None:
    mounting = exp_se3(np.array([1.2, 0.0, 0.0]), np.zeros(3))
    fit = check(streets.straight, seconds=12.0, clock=0.4, base_T_assumed=mounting)
    assert fit.findings == []
    assert {"clock_s", "lever_x_m"} <= set(fit.hidden)
    assert "would not show an offset of its clock" in fit.untold()


def test_the_smallest_fault_that_a_drive_shows_is_told(check: Check) -> None:
    """A winding drive shows shifts of the mounting, but no smaller ones than five deviations."""
    fit = check()
    fit.hidden = ["lever_x_m", "clock_s"]
    fit.parameters["lever_x_m"] = (0.0, 0.2)
    fit.parameters["clock_s"] = (0.0, 3.0)
    assert "would not show a shift of its mounting along x of less than 1.0 m or an" in fit.untold()
    assert "or an offset of its clock: it is" in fit.untold()


def test_axes_of_an_optical_frame_are_found(check: Check) -> None:
    optical = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)
    assert "optical frame" in _only(check(base_T_assumed=optical))


def test_a_sensor_mounted_backwards_is_named_alone_and_not_as_optical(check: Check) -> None:
    backwards = yaw_transform(np.pi, (0.0, 0.0, 0.0))
    text = _only(check(base_T_assumed=backwards))
    assert "its mounting has to be turned by +180.0" in text
    assert "180.0" in text
    assert "optical" not in text


@pytest.mark.parametrize("scale", [0.5, 1.15, 3.281])
def test_another_unit_is_found(check: Check, scale: float) -> None:
    fit = check(scale=scale)
    assert "times as far as the poses" in _only(fit)
    assert np.exp(fit.parameters["scale_log"][0]) == pytest.approx(scale, rel=0.05)


@pytest.mark.parametrize(("axis", "signs"), [("y", (1, -1, 1)), ("x", (-1, 1, 1))])
def test_a_mirrored_axis_is_found_where_the_vehicle_turns(
    check: Check, axis: str, signs: tuple[float, float, float]
) -> None:
    assert f"mirrored along {axis} of the base frame" in _only(check(signs=signs))


def test_poses_that_are_inverted_are_not_taken_for_clouds_in_the_fixed_frame(check: Check) -> None:
    text = _only(check(as_written=inverse))
    assert "the poses fit when they are inverted" in text


def _gently(seconds: F64) -> F64:
    """Poses of a nearly straight drive at 4 m/s: within half a metre of a line, by 3 degrees."""
    way = 4.0 * seconds
    yaw = np.arctan(0.05 * np.cos(way / 10.0))
    return np.array(
        [yaw_transform(a, (x, 0.5 * np.sin(x / 10.0), 1.5)) for a, x in zip(yaw, way, strict=True)]
    )


def _with_quaternions(change: Callable[[F64], F64]) -> Callable[[F64], F64]:
    def written(poses: F64) -> F64:
        out = poses.copy()
        quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        out[:, :3, :3] = Rotation.from_quat(change(quaternions)).as_matrix()
        return out

    return written


def _with_heading(poses: F64) -> F64:
    """Yaw clockwise from north (y)."""
    yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    return np.array(
        [yaw_transform(np.pi / 2 - a, tuple(t)) for a, t in zip(yaw, poses[:, :3, 3], strict=True)]
    )


def _with_optical_positions(poses: F64) -> F64:
    """Positions right, down, forward beside rotations of a body."""
    out = poses.copy()
    out[:, :3, 3] = poses[:, :3, 3] @ np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    return out


def _with_other_side(poses: F64) -> F64:
    out = poses.copy()
    out[:, 1, 3] *= -1.0
    return out


@pytest.mark.parametrize("is_gentle", [True, False])
@pytest.mark.parametrize(
    ("as_written", "text"),
    [
        (_with_quaternions(lambda q: q[:, [3, 0, 1, 2]]), "read as w, x, y, z"),
        (_with_quaternions(lambda q: q * [-1, -1, -1, 1]), "rotations are inverted, but not"),
        (_with_heading, "yaw is read as a compass heading"),
        (_with_optical_positions, "z, -x, -y of their positions are read as x, y, z"),
        (_with_other_side, "y of their positions has the other sign"),
    ],
    ids=["w first", "inverted rotations", "heading", "optical positions", "left-handed positions"],
)
def test_poses_of_another_convention_are_named_by_it(
    check: Check, is_gentle: bool, as_written: Callable[[F64], F64], text: str, streets: Any
) -> None:
    poses_of = _gently if is_gentle else streets.winding
    seconds = 12.0 if is_gentle else 18.0
    assert text in _only(check(poses_of, seconds=seconds, as_written=as_written))


@pytest.mark.parametrize("factor", [0.4, 3.28])
@pytest.mark.parametrize("is_gentle", [True, False])
def test_poses_of_another_unit_are_found_from_any_distance(
    check: Check, factor: float, is_gentle: bool, streets: SimpleNamespace
) -> None:
    def scaled(poses: F64) -> F64:
        out = poses.copy()
        out[:, :3, 3] *= factor
        return out

    poses_of = _gently if is_gentle else streets.winding
    fit = check(poses_of, seconds=12.0, as_written=scaled)
    assert "times as far as the poses" in _only(fit)
    assert np.exp(fit.parameters["scale_log"][0]) == pytest.approx(1 / factor, rel=0.05)


def test_clouds_that_hardly_move_beside_the_poses_are_not_only_of_another_unit(
    check: Check, streets: SimpleNamespace
) -> None:
    """Positions in centimetres, which other axes or clouds that stand still look like."""

    def scaled(poses: F64) -> F64:
        out = poses.copy()
        out[:, :3, 3] *= 100.0
        return out

    text = _only(check(_gently, seconds=12.0, as_written=scaled))
    assert "its clouds move less than 0.05 times as far as the poses" in text
    assert "in another unit or along other axes" in text


def test_odometry_that_turns_too_far_all_the_time_is_named_with_its_drift(check: Check) -> None:
    def drifted(poses: F64) -> F64:
        out = poses.copy()
        for i in range(1, len(poses)):
            step = inverse(poses[i - 1]) @ poses[i]
            turn = np.radians(1.0) * float(np.linalg.norm(step[:3, 3]))  # 1 degree a metre
            out[i] = out[i - 1] @ step @ yaw_transform(turn, (0.0, 0.0, 0.0))
        return out

    text = _only(check(as_written=drifted))
    assert "their rotation drifts by 1.0 degrees a metre" in text


def test_odometry_that_rolls_to_and_fro_is_named(check: Check) -> None:
    def rolling(poses: F64) -> F64:
        rolls = np.radians(4.0) * np.sin(0.3 * np.arange(len(poses)))
        turns = [exp_se3(np.zeros(3), np.array([roll, 0.0, 0.0])) for roll in rolls]
        return np.asarray(poses @ np.array(turns))

    text = _only(check(as_written=rolling))
    assert "move otherwise than the poses" in text
    assert "a metre" not in text


def test_clouds_that_stand_still_beside_poses_that_move_are_not_taken_for_the_fixed_frame(
    check: Check, streets: SimpleNamespace
) -> None:
    def standing(seconds: F64) -> F64:
        poses: F64 = streets.winding(np.zeros_like(seconds))
        return poses

    def moving(poses: F64) -> F64:
        written: F64 = streets.winding(0.05 * np.arange(len(poses)))
        return written

    text = _only(check(standing, as_written=moving))
    assert "move otherwise than the poses" in text


def test_a_camera_that_nothing_explains_is_named_with_its_calibration(
    shared: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The focal length is twice the true one, so points lie half as far to the side."""
    loaded = Collected.load

    def squeezed(self: Collected, keyframe: int) -> Any:
        points, labels, sigma = loaded(self, keyframe)
        return points * np.array([0.5, 0.5, 1.0], np.float32), labels, sigma

    log = shared("logs/room_a.mcap")
    settings = load(assignments={"fusion.voxel_size": "0.05"})
    [good] = check_log(log, settings, {}).streams
    assert good.findings == []
    monkeypatch.setattr(Collected, "load", squeezed)
    [stream] = check_log(log, settings, {}).streams
    assert "most of its clouds move otherwise than the poses" in _only(stream)
    assert "calibration (CameraInfo, K" in _only(stream)


def test_a_straight_drive_backwards_is_an_inverted_pose_or_a_turned_mounting(
    check: Check, streets: SimpleNamespace
) -> None:
    about = exp_se3(np.zeros(3), np.array([0.0, 0.0, np.pi]))
    text = _only(check(streets.straight, seconds=12.0, base_T_assumed=about))
    assert "when the mounting is turned by 180 degrees about z" in text
    assert "which the drive does not tell apart" in text
    assert "mounting has to be turned by" in _only(check(base_T_assumed=about))


def test_an_offset_of_the_clock_that_leads_out_of_the_poses_explains_nothing(
    check: Check,
) -> None:
    """A short drive whose clouds stand still has no clock by which they would not."""
    fit = check(
        _gently, seconds=8.0, as_written=lambda poses: np.tile(poses[:1], (len(poses), 1, 1))
    )
    assert not any("clock" in finding.text for finding in fit.findings)


def test_clouds_in_the_fixed_frame_are_found(check: Check) -> None:
    assert "they are in the fixed frame already" in _only(check(is_fixed=True))


def test_odometry_that_slips_for_a_while_is_named_with_the_time(
    tmp_path: Path, streets: SimpleNamespace
) -> None:
    def slips(seconds: np.ndarray) -> np.ndarray:
        poses: np.ndarray = streets.winding(seconds)
        poses[:, 0, 3] -= np.clip(seconds - 8.0, 0.0, 3.0)  # 1 m/s for 3 s
        return poses

    clouds, _ = streets.drive(tmp_path)
    (tmp_path / "other").mkdir()
    _, slipped = streets.drive(tmp_path / "other", slips)
    poses, _ = slipped.at_many(clouds.stamps_ns())
    clouds.collected.poses[:] = list(poses)
    text = _only(check_stream(TOPIC, clouds, slipped.at_many))
    assert "move otherwise than the poses, by up to" in text
    assert "(1970-01-01T00:00:09.500Z to 1970-01-01T00:00:12.833Z)" in text  # from 9 s to 12 s


def test_clouds_of_noise_are_named_with_the_time_and_a_single_one_is_not(check: Check) -> None:
    """Keyframes are a third of a second apart."""
    text = _only(check(noisy=(6.0, 8.0)))
    assert "pairs of its clouds, one after the other, have no surfaces in common" in text
    assert "(1970-01-01T00:00:07.166Z to " in text
    assert check(noisy=(6.0, 6.3)).findings == []


def test_too_few_keyframes_tell_nothing(check: Check) -> None:
    fit = check(seconds=4.0)
    assert fit.findings == []
    assert "cannot be told: only" in fit.untold()


def test_a_wrong_stream_is_reported_and_a_hidden_fault_is_a_note(
    check: Check, streets: SimpleNamespace
) -> None:
    wrong = SessionFit("/odometry", streams=[check(clock=0.4)])
    assert not wrong.fits
    [problem] = wrong.problems
    assert problem.is_reported
    assert problem.text.startswith(f"{TOPIC} and the poses of /odometry do not fit each other:")
    hidden = SessionFit("/odometry", streams=[check(streets.straight, seconds=12.0)])
    assert hidden.fits
    [note] = hidden.problems
    assert not note.is_reported

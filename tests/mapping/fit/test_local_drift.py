"""Drift that is put into the poses of a drive is measured from its clouds."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.mapping.drift import Drift
from semloc_logs.mapping.fit.findings import SessionFit, StreamFit
from semloc_logs.mapping.fit.local_drift import PAIRS, apart, drift_of, local_drift
from semloc_logs.mapping.keyframes import Collected
from semloc_logs.numerics.transforms import exp_se3, inverse, yaw_transform

SPREAD = np.array([0.05, 0.02, 0.01, 0.001, 0.002, 0.004])  # m and rad over 10 m
RATES = SPREAD / 10.0


def drifting(scale: float, turn: float) -> SimpleNamespace:
    """Poses whose steps are ``scale`` times as long and turned by ``turn`` rad a metre."""

    def written(poses: F64) -> F64:
        steps = inverse(poses[:-1]) @ poses[1:]
        out = [poses[0]]
        for step in steps:
            wrong = step.copy()
            wrong[:3, 3] *= scale
            way = float(np.linalg.norm(step[:3, 3]))
            wrong[:3, :3] = (
                step[:3, :3] @ exp_se3(np.zeros(3), np.array([0, 0, turn * way]))[:3, :3]
            )
            out.append(out[-1] @ wrong)
        return np.array(out)

    return SimpleNamespace(written=written)


def measured(folder: Path, streets: SimpleNamespace, scale: float, turn: float) -> Drift:
    clouds, _ = streets.drive(folder, as_written=drifting(scale, turn).written, seconds=25.0)
    drift = local_drift(clouds)
    assert drift is not None
    return drift


def test_poses_without_drift_show_none(tmp_path: Path, streets: SimpleNamespace) -> None:
    drift = measured(tmp_path, streets, 1.0, 0.0)
    assert max(drift.translation) < 1e-3
    assert max(drift.rotation) < 2e-4


def test_a_wrong_scale_is_drift_along_the_way(tmp_path: Path, streets: SimpleNamespace) -> None:
    drift = measured(tmp_path, streets, 1.02, 0.0)
    assert drift.translation[0] == pytest.approx(0.02, rel=0.15)
    assert max(drift.translation[1:]) < 0.007  # the drive winds
    assert max(drift.rotation) < 2e-4


def test_a_wrong_turn_rate_is_drift_of_the_heading(
    tmp_path: Path, streets: SimpleNamespace
) -> None:
    drift = measured(tmp_path, streets, 1.0, 1e-3)
    assert drift.rotation[2] == pytest.approx(1e-3, rel=0.2)
    assert max(drift.rotation[:2]) < 2e-4


def test_too_short_a_drive_shows_no_drift(tmp_path: Path, streets: SimpleNamespace) -> None:
    clouds, _ = streets.drive(tmp_path, seconds=5.0)
    assert local_drift(clouds) is None


def test_clouds_that_do_not_meet_show_no_drift(
    tmp_path: Path, streets: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A registration without a plane stays where it began, which proves nothing."""
    clouds, _ = streets.drive(tmp_path, seconds=25.0)
    ball = np.random.default_rng(0).normal(0, 0.3, (500, 3))
    monkeypatch.setattr(Collected, "load", lambda self, k: (ball + 100.0 * k, None, None))
    assert local_drift(clouds) is None


def stepped(step: int) -> SimpleNamespace:
    """Poses that step aside by 0.5 m at one of them, as where a map was corrected."""

    def written(poses: F64) -> F64:
        out = poses.copy()
        out[step:, 1, 3] += 0.5
        return out

    return SimpleNamespace(written=written)


def test_a_step_of_the_poses_is_not_taken_for_drift(
    tmp_path: Path, streets: SimpleNamespace
) -> None:
    clouds, _ = streets.drive(tmp_path, as_written=stepped(130).written, seconds=40.0)
    drift = local_drift(clouds)
    assert drift is not None
    assert max(drift.translation) < 1e-3


def test_pairs_do_not_lead_across_a_gap(
    tmp_path: Path, streets: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of the keyframes are ten minutes later, 1 m aside: as many pairs on either side."""
    clouds, _ = streets.drive(tmp_path, as_written=stepped(250).written, seconds=25.0)
    half = int(np.searchsorted(clouds.stamps_ns(), 13_500_000_000))
    later = clouds.stamps_ns() + np.where(np.arange(len(clouds.rows)) < half, 0, 600 * 10**9)
    monkeypatch.setattr(type(clouds), "stamps_ns", lambda self: later)
    for target, source in apart(clouds):
        assert (target < half) == (source < half)


def given_and_registered(noise: float, wrong: int = 0) -> tuple[F64, F64, F64]:
    """400 motions of 10 m with errors of :data:`SPREAD`; registrations there and back with
    ``noise`` times as large ones, and ``wrong`` ones that ended elsewhere on the way back.
    """
    rng = np.random.default_rng(3)
    true = np.tile(np.eye(4), (400, 1, 1))
    true[:, 0, 3] = 10.0

    def off(size: F64) -> F64:
        errors = rng.normal(size=(400, 6)) * size
        return np.array([m @ exp_se3(e[:3], e[3:]) for m, e in zip(true, errors, strict=True)])

    back = off(noise * SPREAD)
    back[:wrong, 1, 3] += 3.0
    return off(SPREAD), off(noise * SPREAD), back


@pytest.mark.parametrize(("noise", "wrong"), [(0.0, 0), (0.5, 0), (0.5, 40)])
def test_noise_of_registrations_is_not_taken_for_drift(noise: float, wrong: int) -> None:
    drift = drift_of(*given_and_registered(noise, wrong))
    assert drift is not None
    np.testing.assert_allclose([*drift.translation, *drift.rotation], RATES, rtol=0.15)


def test_drift_that_noise_hides_may_be_as_large_as_the_noise_is_unsure() -> None:
    """Of 400 pairs the variance of noise is known to 7 %, of 16 to 35 %."""
    _, there, back = given_and_registered(0.5)
    for count, share in ((400, 0.07), (16, 0.35)):
        # the same noise both ways: no drift
        middle = 0.5 * (there[:count] + back[:count])
        drift = drift_of(middle, there[:count], back[:count])
        assert drift is not None
        noise = 0.5 * SPREAD[0] / np.sqrt(2)
        assert drift.translation[0] == pytest.approx(np.sqrt(share) * noise / 10.0, rel=0.3)


def test_drift_by_hand() -> None:
    """Eight motions of 10 m that are 5 cm off aside, registered 2 cm more and 2 cm less.

    The variance of the noise is known to (2 / 8)^0.5, a half: that much of it stays.
    """
    given = np.array([yaw_transform(0.0, (10.0, 0.0, 0.0))] * 8)
    there, back = given.copy(), given.copy()
    there[:, 1, 3] = 0.05 + 0.02
    back[:, 1, 3] = 0.05 - 0.02
    drift = drift_of(given, there, back)
    assert drift is not None
    aside = np.sqrt(0.05**2 - 0.02**2 + 0.5 * 0.02**2) / 10.0
    assert drift.translation == pytest.approx((0.0, aside, 0.0))
    assert drift.rotation == (0.0, 0.0, 0.0)


def pairs_of(*positions: float | None) -> list[tuple[int, int]]:
    """Of keyframes along x, of voxels of 25 cm: pairs are 10 m apart."""
    poses = [None if x is None else yaw_transform(0.0, (x, 0.0, 0.0)) for x in positions]
    rows = np.arange(len(poses))
    clouds = SimpleNamespace(
        rows=rows, voxel=0.25, pose=lambda k: poses[k], stamps_ns=lambda: rows * 10**9
    )
    return apart(cast(Any, clouds))


def test_pairs_are_the_first_that_are_far_enough_apart() -> None:
    assert pairs_of(0.0, 5.0, 10.0, 15.0, 20.0) == [(0, 2), (1, 3), (2, 4)]
    assert pairs_of(None, 0.0, None, 10.0) == [(1, 3)]
    assert pairs_of(0.0, 15.0) == [(0, 1)]
    assert pairs_of(0.0, 15.1) == []  # poses jump
    assert pairs_of(None, None) == pairs_of() == []
    many = pairs_of(*np.arange(0.0, 500.0, 5.0))
    assert (len(many), many[0], many[-1]) == (PAIRS, (0, 2), (97, 99))


def test_noisy_registrations_tell_nothing() -> None:
    assert drift_of(*given_and_registered(2.0)) is None


def test_drift_over_a_road_in_json_and_back() -> None:
    drift = Drift.of(RATES)
    np.testing.assert_allclose(np.diag(drift.covariance(10.0)), SPREAD**2)
    assert Drift.from_json(drift.to_json()) == drift


def test_a_session_drifts_as_the_stream_says_that_shows_least() -> None:
    small = Drift.of(RATES)
    streams = [StreamFit("/a", drift=Drift.of(2 * RATES)), StreamFit("/b", drift=small)]
    fit = SessionFit("/odometry", streams=[*streams, StreamFit("/c")])
    assert fit.drift == small
    assert fit.to_json()["drift"] == small.to_json()
    assert SessionFit("/odometry", streams=[StreamFit("/c")]).to_json()["drift"] is None

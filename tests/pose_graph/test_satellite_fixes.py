"""Drives with satellite fixes lie in east, north, up; wrong fixes do not bend them."""

from typing import Any

import numpy as np
import pytest

from semloc_logs.logs.poses.navsat import LocalFrame
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.pose_graph import solver
from semloc_logs.settings import load
from semloc_logs.stages.optimise import optimise
from semloc_logs.tables.table import read_metadata, read_table
from semloc_logs.voxels.store import poses_of

pytest.importorskip("gtsam")
SETTINGS = load().resolved()
ENU_T_COMMON = yaw_transform(2.0, (300.0, -200.0, 5.0))


def _in_enu(drives: Any, name: str, datum: tuple[float, float, float]) -> np.ndarray:
    """Positions (n, 3) of optimized/NAME.parquet, relative to ``datum``."""
    path = drives.work.optimized_trajectory(name)
    own = LocalFrame(*read_metadata(path)["datum_lat_lon_height"])
    places = own.geodetic(poses_of(read_table(path))[:, :3, 3])
    local = LocalFrame(*datum)
    return np.array([local.position(*place) for place in places])


@pytest.mark.parametrize("most_fill", [solver.MOST_FILL, 0])
def test_fixes_take_the_drift_away_and_turn_the_frame(
    drives: Any, square_of: Any, datum: Any, monkeypatch: pytest.MonkeyPatch, most_fill: int
) -> None:
    monkeypatch.setattr(solver, "MOST_FILL", most_fill)
    drives.add("a", square_of(2), 0.006, 1.01)  # 5 degrees and 8 m in two laps
    drives.add("b", square_of(1), -0.01, 1.0)
    drives.locate("a", ENU_T_COMMON, wrong=[100, 105, 110, 300])
    drives.close([("b", k, "a", k, None) for k in range(20, 400, 40)])  # b has no fixes
    assert optimise(drives.work, SETTINGS).frames == 1
    for name in ("a", "b"):
        poses = _in_enu(drives, name, datum)
        truth = (ENU_T_COMMON @ drives.true[name])[:, :3, 3]
        away = np.linalg.norm((poses - truth)[:, :2], axis=1)
        assert np.sqrt((away**2).mean()) < 0.5
        assert away.max() < 1.5


def test_drives_without_a_closure_have_frames_of_their_own(
    drives: Any, square_of: Any, datum: Any
) -> None:
    for name in ("a", "b"):
        drives.add(name, square_of(1), 0.01, 1.0)
    drives.locate("a", ENU_T_COMMON)
    drives.close([])
    assert optimise(drives.work, SETTINGS).frames == 2
    away = _in_enu(drives, "a", datum) - (ENU_T_COMMON @ drives.true["a"])[:, :3, 3]
    assert np.linalg.norm(away, axis=1).max() < 1.5
    assert read_metadata(drives.work.optimized_trajectory("b"))["datum_lat_lon_height"] is None


def test_fixes_of_a_vehicle_that_stands_do_not_tell_the_heading(
    drives: Any, square_of: Any
) -> None:
    drives.add("a", square_of(1), 0.0, 1.0)
    drives.locate("a", ENU_T_COMMON, every=399)  # at the start, and one second before it
    drives.close([])
    optimise(drives.work, SETTINGS)
    metadata = read_metadata(drives.work.optimized_trajectory("a"))
    assert (metadata["frame"], metadata["datum_lat_lon_height"]) == ("a", None)


def test_without_gnss_fixes_are_left_out(drives: Any, square_of: Any) -> None:
    drives.add("a", square_of(1), 0.0, 1.0)
    drives.locate("a", ENU_T_COMMON)
    drives.close([])
    settings = load(assignments={"optimize.gnss": "false"}).resolved()
    optimise(drives.work, settings)
    metadata = read_metadata(drives.work.optimized_trajectory("a"))
    assert metadata["datum_lat_lon_height"] is None

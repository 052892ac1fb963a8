"""semloc optimize, evaluate and export on a workspace of drives around a block."""

import json
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from semloc_logs.arrays import F64
from semloc_logs.cli.main import program
from semloc_logs.evaluation.truth import read_tum
from semloc_logs.numerics.transforms import yaw_transform

pytest.importorskip("gtsam")


def semloc(*args: object) -> Result:
    return CliRunner().invoke(program, [str(a) for a in args], prog_name="semloc")


@pytest.fixture
def work(drives: Any, square_of: Any) -> Any:
    """Drives a and b that drift in opposite ways, c apart from them; one false closure."""
    drives.add("a", square_of(2), 0.004, 1.005)
    drives.add("b", square_of(2), -0.004, 0.995)
    drives.add("c", square_of(1), 0.0, 1.0)
    right = [("b", k, "a", k, None) for k in range(0, 801, 20)]
    drives.close([*right, ("b", 100, "a", 200, yaw_transform(0.0, (30.0, 0.0, 0.0)))])
    return drives


def fence() -> F64:
    """Points (n, 3) of walls of 3 m, 8 m outside a block of 100 m."""
    along, height = (
        a.ravel() for a in np.meshgrid(np.arange(-8.0, 108.0, 0.2), np.arange(0, 3, 0.3))
    )
    sides = []
    for outside in (-8.0, 108.0):
        sides.append(np.column_stack([along, np.full(len(along), outside), height]))
        sides.append(np.column_stack([np.full(len(along), outside), along, height]))
    return np.concatenate(sides)


def test_the_errors_before_and_after_are_printed(work: Any) -> None:
    result = semloc("optimize", "-w", work.work.path, "--truth", work.truth_file, "--json")
    assert result.exit_code == 0, result.output
    work.see(fence())
    content = json.loads(result.stdout)
    assert (content["sessions"], content["closures"], content["rejected"]) == (3, 42, 1)
    assert content["frames"] == 2
    assert content["ate_after_m"] < 0.5 * content["ate_before_m"]

    evaluated = json.loads(
        semloc("evaluate", "-w", work.work.path, "--truth", work.truth_file, "--json").stdout
    )
    assert evaluated["false"] == 1
    for name in ("ate_before_m", "ate_after_m", "rpe_after_m"):
        assert evaluated[name] == content[name]
    sharpness = evaluated["sharpness"]
    assert sharpness["places"] > 10
    assert sharpness["planes_after"] > sharpness["planes_before"]
    assert sharpness["thickness_after_m"] < 0.15
    text = semloc("optimize", "-w", work.work.path, "--truth", work.truth_file).stdout
    assert "3 sessions in 2 frames by 42 closures, 1 of them refused" in text
    assert "ATE" in text


def test_poses_are_exported_in_the_common_frame(work: Any, tmp_path: Any) -> None:
    export = ("export", "-w", work.work.path, "--frame", "common", "-o", tmp_path / "out")
    refused = semloc(*export, "--format", "tum")
    assert refused.exit_code == 1
    assert "semloc optimize" in refused.stderr
    semloc("optimize", "-w", work.work.path)
    assert semloc(*export, "--format", "tum").exit_code == 0
    assert semloc(*export, "--format", "kitti").exit_code == 0
    track = read_tum(tmp_path / "out" / "c.tum")
    np.testing.assert_allclose(track.common_T_base, work.true["c"], atol=1e-6)
    rows = np.loadtxt(tmp_path / "out" / "c.txt").reshape(-1, 3, 4)
    np.testing.assert_allclose(rows, work.true["c"][:, :3], atol=1e-6)


def test_a_workspace_without_closures_is_refused_with_a_sentence(
    drives: Any, square_of: Any
) -> None:
    drives.add("a", square_of(1), 0.0, 1.0)
    result = semloc("optimize", "-w", drives.work.path)
    assert result.exit_code == 1
    assert "run 'semloc close' first" in result.stderr

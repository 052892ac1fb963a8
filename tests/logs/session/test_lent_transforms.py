"""Static transforms that a session lacks and another log of the same command has."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.engines import Serial
from semloc_logs.errors import LogError
from semloc_logs.logs.containers.open import open_log
from semloc_logs.logs.log import Log
from semloc_logs.logs.session.lent_transforms import lent_transforms
from semloc_logs.logs.session.session import SessionOptions, open_session
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.settings import load
from semloc_logs.stages.fuse import fuse
from semloc_logs.stages.inputs import SessionInput
from semloc_logs.tables.table import read_json
from semloc_logs.workspace import Workspace

S = 1_000_000_000
EPOCH = 1_700_000_000 * S
MOUNT = yaw_transform(np.pi / 2, (1.0, 0.0, 2.0))
OTHER = yaw_transform(0.0, (0.0, 0.0, 0.5))
XYZ = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])

Part = Callable[..., Path]


@pytest.fixture
def part(recorder: Callable[..., Any]) -> Part:
    """Writes a short log; ``mount``: base_T_lidar in /tf_static at ``seconds``, or none."""

    def write(
        name: str, mount: F64 | None, *, seconds: float = 0.0, parent: str = "base_link"
    ) -> Path:
        log = recorder("ros2", name)
        if mount is not None:
            log.transform(parent, "lidar", mount, EPOCH + round(seconds * S))
        rng = np.random.default_rng(0)
        points = np.zeros(500, XYZ)
        points["x"], points["y"] = rng.uniform(2, 9, (2, 500))
        for k in range(30):
            log.pose(EPOCH + k * S // 10, yaw_transform(0.0, (0.1 * k, 0.0, 0.0)))
            log.cloud("/points", EPOCH + k * S // 10, "lidar", points)
        written: Path = log.write()
        return written

    return write


def first_cloud(path: Path, *others: Path) -> tuple[F64, list[str]]:
    """The origin of the first cloud in the base frame, and the problems."""
    mountings = lent_transforms([path], others, {}, None)
    session = open_session([path], SessionOptions(mountings=mountings))
    try:
        clouds = list(session.clouds())
        return np.asarray(clouds[0].origin, float), [p.text for p in session.problems]
    finally:
        session.close()


def test_the_mounting_of_another_log_is_used_and_named(part: Part) -> None:
    whole = part("part_0", MOUNT)
    lacking = part("part_1", None)
    origin, problems = first_cloud(lacking, whole)
    np.testing.assert_allclose(origin, [1, 0, 2])
    assert problems == [
        "part_1.mcap has no transform from 'base_link' to 'lidar': the one of part_0.mcap is used."
    ]


def test_a_log_with_its_own_mounting_takes_none(part: Part) -> None:
    origin, problems = first_cloud(part("a", OTHER), part("b", MOUNT))
    np.testing.assert_allclose(origin, [0, 0, 0.5])
    assert problems == []


def test_other_frame_names_are_not_taken(part: Part) -> None:
    origin, problems = first_cloud(part("a", None), part("b", MOUNT, parent="chassis"))
    np.testing.assert_allclose(origin, 0)
    assert [p for p in problems if "No transform connects the sensor frame 'lidar'" in p]


def test_logs_that_do_not_agree_lend_nothing(part: Part) -> None:
    lacking = part("a", None)
    _, problems = first_cloud(lacking, part("b", MOUNT), part("c", OTHER), part("d", MOUNT))
    assert any(
        "give different ones (b.mcap, c.mcap, d.mcap): none of them is used" in p for p in problems
    )
    assert any("No transform connects the sensor frame 'lidar'" in p for p in problems)
    origin, _ = first_cloud(lacking, part("b", MOUNT), part("d", MOUNT))
    np.testing.assert_allclose(origin, [1, 0, 2])


def test_a_mounting_that_is_recorded_late_holds_from_the_start(part: Part) -> None:
    origin, problems = first_cloud(part("late", MOUNT, seconds=2.9))
    np.testing.assert_allclose(origin, [1, 0, 2])
    assert problems == []


def test_a_log_that_cannot_be_read(part: Part, tmp_path: Path) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"not a log")
    origin, _ = first_cloud(part("a", None), broken, part("b", MOUNT))
    np.testing.assert_allclose(origin, [1, 0, 2])
    with pytest.raises(LogError):
        lent_transforms([broken], [], {}, None)


def test_all_logs_are_read_within_the_memory_of_the_settings(
    part: Part, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[tuple[str, int]] = []

    def noted(path: Path, memory: int) -> Log:
        opened.append((path.name, memory))
        return open_log(path, memory)

    monkeypatch.setattr("semloc_logs.logs.session.lent_transforms.open_log", noted)
    sessions = [SessionInput(name, (part(name, m),)) for name, m in (("a", None), ("b", MOUNT))]
    settings = load(None, {"logs.memory": "100000000"}).resolved()
    fuse(sessions, Workspace(tmp_path / "work"), settings, Serial())
    assert ("a.mcap", 100_000_000) in opened
    assert ("b.mcap", 100_000_000) in opened
    assert {memory for _, memory in opened} == {100_000_000}


def test_fuse_depends_on_the_lent_transform_and_reports_assumptions(
    part: Part, tmp_path: Path
) -> None:
    whole = SessionInput("part_0", (part("part_0", MOUNT),))
    lacking = SessionInput("part_1", (part("part_1", None),))
    work = Workspace(tmp_path / "work")
    settings = load().resolved()

    both = fuse([whole, lacking], work, settings, Serial())
    assert (both.done, both.skipped) == (["part_0", "part_1"], [])
    content = read_json(work.session("part_1").session_json)
    np.testing.assert_allclose(content["base_T_sensors"]["lidar"], MOUNT, atol=1e-12)
    assert fuse([lacking, whole], work, settings, Serial()).kept == ["part_1", "part_0"]

    alone = fuse([lacking], work, settings, Serial())
    assert alone.done == ["part_1"]
    [assumption] = alone.skipped
    assert "No transform connects the sensor frame 'lidar' with 'base_link'" in assumption
    assert "--set logs.mountings.lidar=[x,y,z,qx,qy,qz,qw]" in assumption

    given = load(None, {"logs.mountings.lidar": "[0, 0, 0, 0, 0, 0, 1]"}).resolved()
    assert fuse([lacking], work, given, Serial()).skipped == []

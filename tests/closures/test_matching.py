"""From logs to closures: a camera of 90 degrees, and a LIDAR log without poses, ask the map of a
LIDAR drive.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from semloc_logs.engines import make_engine
from semloc_logs.evaluation.truth import Evaluation, Judged, evaluate_closures
from semloc_logs.settings import load
from semloc_logs.simulation.drive_plan import Route, Town
from semloc_logs.simulation.sensors.sensor import Sensor
from semloc_logs.simulation.sessions import simulate_sessions
from semloc_logs.stages.inputs import SessionInput
from semloc_logs.stages.run import run
from semloc_logs.workspace import Workspace

POSES = ("/odometry", "/gnss", "/imu")


def without(topics: tuple[str, ...], log: Path, output: Path) -> None:
    """A copy of an MCAP file that lacks some topics."""
    with log.open("rb") as source, output.open("wb") as target:
        writer = Writer(target)
        channels = dict[int, int]()
        writer.start("ros2")
        for schema, channel, message in make_reader(source).iter_messages():
            if channel.topic in topics or schema is None:
                continue
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, channel.metadata
                )
            writer.add_message(
                channels[channel.id],
                message.log_time,
                message.data,
                message.publish_time,
                message.sequence,
            )
        writer.finish()  # type: ignore[no-untyped-call]


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Evaluation]:
    """The closures of the three logs of one drive, judged."""
    folder = tmp_path_factory.mktemp("closing")
    logs = {name: [folder / f"{name}.mcap"] for name in ("map", "camera", "frames")}
    for name, sensor in (("map", "hdl32"), ("camera", "depth")):
        carried = Sensor(sensor, label_noise=0.05)
        simulate_sessions(folder / sensor, Town(300), Route(1, 60.0), carried)
        shutil.move(folder / sensor / "session_0.mcap", logs[name][0])
    without(POSES, logs["map"][0], logs["frames"][0])
    settings = load(assignments={"query.every": "4"}).resolved()
    work = Workspace(folder / "work")
    sessions = [SessionInput(name, tuple(paths)) for name, paths in logs.items()]
    report = run(sessions, work, settings, make_engine("serial"))
    assert not report.failed
    truth = folder / "truth.json"
    truth.write_text(json.dumps({name: {"trajectory": "hdl32/session_0.tum"} for name in logs}))
    yield evaluate_closures(work, truth, settings)
    shutil.rmtree(folder)


def between(evaluation: Evaluation, one: str, other: str) -> list[Judged]:
    """Either may be the query: a closure found from both ends is kept once."""
    return [
        row for row in evaluation.rows if {row.query_session, row.target_session} == {one, other}
    ]


def test_a_camera_that_sees_a_quarter_finds_itself_in_the_map_of_a_lidar(
    evaluation: Evaluation,
) -> None:
    closures = between(evaluation, "camera", "map")
    assert len(closures) >= 8
    assert np.median([c.error_m for c in closures if c.error_m is not None]) < 0.2


def test_frames_without_poses_find_themselves_one_by_one(evaluation: Evaluation) -> None:
    closures = between(evaluation, "frames", "map")
    assert len(closures) >= 8
    # their sweeps are as skewed as they were driven
    assert np.median([c.error_m for c in closures if c.error_m is not None]) < 0.5


def test_nothing_else_is_said(evaluation: Evaluation) -> None:
    assert evaluation.correct == evaluation.closures
    assert not any(row.target_session == "frames" for row in evaluation.rows), (
        "a log without poses has no map"
    )

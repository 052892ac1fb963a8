"""semloc simulate."""

from __future__ import annotations

import json
from pathlib import Path

import click

from ..console import console
from ..options import Command, console_options, json_option, overwrite_option, path_option


@click.command(cls=Command)
@path_option("-o", "--output", required=True, help="Folder of the logs and of truth.json.")
@click.option(
    "--sessions",
    type=int,
    help="Number of drives through the same town.  [default: 2, along a trajectory 1]",
)
@click.option(
    "--length", type=float, default=500.0, show_default=True, help="Length of a drive (m)."
)
@path_option(
    "--trajectory", help="TUM or KITTI file: lay the streets along this drive, and drive it."
)
@click.option(
    "--from",
    "from_",
    type=float,
    default=0.0,
    show_default=True,
    help="Where to begin along the trajectory (m).",
)
@click.option(
    "--to",
    type=float,
    default=float("inf"),
    help="Where to end along the trajectory (m).  [default: its end]",
)
@click.option(
    "--there-and-back",
    is_flag=True,
    help="Drive the trajectory the other way in every other session.",
)
@click.option(
    "--sensor",
    default="hdl32",
    show_default=True,
    help="Lidar (hdl64, hdl32, vlp32, vlp16, rosette, raster) or camera (stereo, depth).",
)
@click.option(
    "--rate", type=float, default=2.0, show_default=True, help="Sweeps or pictures a second (Hz)."
)
@click.option(
    "--format",
    "format_",
    default="mcap",
    show_default=True,
    help="Form of the logs: mcap, protobuf (in MCAP), bag (ROS 1) or ros2.",
)
@click.option(
    "--label-noise",
    type=float,
    default=0.0,
    show_default=True,
    help="Share of wrong labels, 0 to 1.",
)
@click.option(
    "--drift",
    type=float,
    default=0.007,
    show_default=True,
    help="Drift of the odometry, share of the way.",
)
@click.option(
    "--imu-rate",
    type=float,
    default=20.0,
    show_default=True,
    help="Samples of the IMU a second (Hz).",
)
@click.option(
    "--wet", type=float, default=0.0, show_default=True, help="How wet the road is, 0 to 1."
)
@click.option("--repeating", is_flag=True, help="A town whose blocks are copies of one another.")
@click.option(
    "--season",
    default="summer",
    show_default=True,
    help="Season of each drive, in turn: summer,autumn,winter,snow.",
)
@click.option(
    "--daytime",
    default="noon",
    show_default=True,
    help="Light of each drive's pictures, in turn: noon,evening,overcast.",
)
@click.option(
    "--roadworks",
    type=float,
    default=0.0,
    show_default=True,
    help="Roadworks a kilometre, from the second drive on.",
)
@click.option(
    "--rebuilt",
    type=float,
    default=0.0,
    show_default=True,
    help="Share of houses gone or new, from the second drive on.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Number of the town.")
@overwrite_option
@json_option
@console_options
def command(
    output: Path,
    sessions: int | None,
    length: float,
    trajectory: Path | None,
    from_: float,
    to: float,
    there_and_back: bool,
    repeating: bool,
    sensor: str,
    rate: float,
    format_: str,
    label_noise: float,
    drift: float,
    imu_rate: float,
    wet: float,
    season: str,
    daytime: str,
    roadworks: float,
    rebuilt: float,
    seed: int,
    overwrite: bool,
    as_json: bool,
) -> int:
    """Drive logs through a procedural town, with ground truth for 'semloc evaluate'. Between
    drives, cars and people change.

    Short drives may never meet: drives along a --trajectory share its road. --length is of drives
    without one; --from and --to cut a trajectory.

    \b
    Example:  semloc simulate -o town --sessions 3 --length 800 --seed 7
              semloc simulate -o road --sessions 2 --trajectory 05.txt --to 200 --there-and-back
    """
    from semloc_logs.simulation.drive_plan import Route, Town
    from semloc_logs.simulation.meshes.world import require_ray_caster
    from semloc_logs.simulation.sensors.sensor import Sensor
    from semloc_logs.simulation.sessions import simulate_sessions

    require_ray_caster("semloc simulate")
    town = Town(
        seed,
        repeating,
        [name.strip() for name in season.split(",")],
        [name.strip() for name in daytime.split(",")],
        roadworks,
        rebuilt,
    )
    if sessions is None:
        sessions = 1 if trajectory else 2
    route = Route(sessions, length, trajectory, (from_, to), there_and_back)
    carried = Sensor(sensor, rate, label_noise=label_noise, drift=drift, wet=wet, imu_hz=imu_rate)
    with console.progress():
        truth = simulate_sessions(output, town, route, carried, format=format_, overwrite=overwrite)
    logs = sorted(str(output / name) for name in json.loads(truth.read_text()))
    if as_json:
        console.result_json({"truth": str(truth), "logs": logs})
    else:
        for path in (*logs, str(truth)):
            console.result(path)
    return 0

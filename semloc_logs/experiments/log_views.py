"""From logs to views: sessions are fused once for each sensor, and pictures taken from the logs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from semloc_logs.engines import Engine
from semloc_logs.errors import SemlocError
from semloc_logs.experiments.simulated_drives import Town, drive_folder, write_drive
from semloc_logs.experiments.view_pictures import keep_pictures
from semloc_logs.experiments.views import ViewStore, read_views
from semloc_logs.mapping.session_fusion import reading_options
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import STREET_VOXEL, Resolved
from semloc_logs.stages.fuse import fuse
from semloc_logs.stages.inputs import SessionInput, session_name
from semloc_logs.tables.atomic_files import replacing_file
from semloc_logs.workspace import Workspace

LIDAR, STEREO = "lidar", "stereo"
SENSORS = (LIDAR, STEREO)
_TOPICS: Mapping[str, Mapping[str, str]] = {LIDAR: {}, STEREO: {"lidar": "none"}}
_SPACING_M = 1.0  # between views at voxels of 0.30 m: KITTI's cameras at 10 Hz


@dataclass(frozen=True, eq=False)
class Recorded:
    """Logs by session, and the truth file that knows them."""

    logs: Mapping[str, Path]
    truth: Path


def recorded_logs(logs: Sequence[Path], truth: Path) -> Recorded:
    """The user's logs, a session each."""
    return Recorded({session_name(log): log for log in logs}, truth)


def simulated_logs(town: Town, folder: Path, engine: Engine) -> Recorded:
    """The logs of a simulated town, made where they are missing, and their truth file."""
    drives = list(town.drives)
    for _ in engine.map(partial(_write, town=town, folder=folder), range(len(drives))):
        pass
    logs = {d.name: drive_folder(folder, d.name) / f"{d.name}.mcap" for d in drives}
    truth = folder / "truth.json"
    entries = {name: {"trajectory": f"{name}/{name}.tum"} for name in logs}
    with replacing_file(truth) as temporary:
        temporary.write_text(json.dumps(entries, indent=2) + "\n", encoding="utf-8")
    return Recorded(logs, truth)


def _write(number: int, town: Town, folder: Path) -> str:
    return str(write_drive(town, town.drives[number], folder))


def fused_views(
    recorded: Recorded, sensor: str, folder: Path, settings: Resolved, engine: Engine
) -> ViewStore:
    """The views of all sessions by one sensor; fused in ``folder`` where they are not.

    SemlocError when a log has nothing to fuse, or the truth does not know the sessions.
    """
    settings = _with_spacing(settings)
    work = Workspace(folder / f"work-{sensor}")
    topics = _TOPICS[sensor]
    inputs = [SessionInput(name, (log,), topics) for name, log in recorded.logs.items()]
    report = fuse(inputs, work, settings, engine)
    if report.failed:
        raise SemlocError(report.failed[0])
    maps = {name: SessionMap(work.session(name)) for name in recorded.logs}
    if sensor == LIDAR and not any(m.json["roles"].get("lidar") for m in maps.values()):
        raise SemlocError("the logs have no LIDAR.")
    pictures = folder / "pictures"
    options = reading_options(settings, topics)
    for name, log in recorded.logs.items():
        # the keyframes of the sensors are not the same moments
        keep_pictures([log], maps[name], pictures / sensor / name, options)
    return read_views(work, recorded.truth, pictures=pictures / sensor)


def _with_spacing(settings: Resolved) -> Resolved:
    """Keyframes about as far apart as the frames of KITTI."""
    scale = settings.fusion.voxel_size / STREET_VOXEL
    fusion = settings.fusion.model_copy(update={"keyframe_distance": _SPACING_M * scale})
    return settings.model_copy(update={"fusion": fusion})

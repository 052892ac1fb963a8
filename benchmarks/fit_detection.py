"""The smallest faults between poses and range data that `semloc fuse` finds, log by log.

python benchmarks/fit_detection.py LOG... [--set KEY=VALUE]... [--json]

The keyframes of each log are read once. Faults of growing size are put in: the stamps are shifted,
the mounting is moved or turned, the clouds are scaled, the poses jump. The table has the smallest
size that is found and not accepted (exit code 3), beside the speed and the turn rate of the drive,
and what the check finds in the log as it is: of good logs, nothing. Needs a quiet machine for its
seconds only.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.labels.geometry_labels import NoLabels
from semloc_logs.logs.poses.plausibility import implausible
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.logs.session.session import Session, open_session
from semloc_logs.mapping.fit.findings import StreamFit
from semloc_logs.mapping.fit.fit_check import check_stream
from semloc_logs.mapping.fit.keyframe_pairs import Clouds
from semloc_logs.mapping.keyframes import Collected, collect
from semloc_logs.mapping.session_fusion import reading_options
from semloc_logs.numerics.transforms import apply, exp_se3, inverse, yaw_transform
from semloc_logs.settings import load

SIZES: dict[str, Sequence[float]] = {
    "clock offset (s)": (0.02, 0.05, 0.1, 0.2, 0.4, 0.8),
    "lever arm (m)": (0.1, 0.2, 0.5, 1.0, 2.0),
    "yaw of the mounting (deg)": (0.5, 1.0, 2.0, 4.0, 8.0),
    "scale (%)": (2.0, 5.0, 10.0, 20.0),
    "jump (m)": (0.5, 1.0, 2.0, 4.0),
}


@dataclass(frozen=True, eq=False)
class Drive:
    """The keyframes of one stream of a log, and its poses; ``seconds`` it took to read them."""

    name: str
    topic: str
    clouds: Clouds
    track: PoseTrack
    seconds: float

    def check(self) -> StreamFit:
        """What `semloc fuse` finds."""
        return check_stream(self.topic, self.clouds, self.track.at_many)


def read(log: Path, assignments: dict[str, str], folder: Path) -> Drive:
    """The keyframes of the first stream of a log."""
    settings = load(assignments=assignments).resolved()
    fusion = settings.fusion
    options = reading_options(settings, {})
    begun = time.process_time()
    with closing(open_session([log], options)) as session:
        labeller = NoLabels()
        collected = collect(session, labeller, fusion, folder, log.stem)
        return _first_stream(log, session, collected, fusion.voxel_size, begun)


def _first_stream(
    log: Path, session: Session, collected: Collected, voxel: float, begun: float
) -> Drive:
    topic = session.roles.ranging[0]
    rows = np.array([i for i, h in enumerate(collected.headers) if h.topic == topic], np.int64)
    seconds = time.process_time() - begun
    name = f"{log.parent.name}/{log.stem}"
    return Drive(name, topic, Clouds(collected, rows, voxel), session.track, seconds)


class Moved(Collected):
    """Keyframes whose points are changed when they are loaded."""

    change: Callable[[F64], F64]

    def load(self, keyframe: int) -> Any:
        points, label, sigma = super().load(keyframe)
        return self.change(points).astype(np.float32), label, sigma


def with_points(drive: Drive, change: Callable[[F64], F64]) -> Drive:
    """The same with other points."""
    known = drive.clouds.collected
    moved = Moved(known.scratch, known.cell, known.headers, known.poses, known.origins)
    moved.change = change
    return _replaced(drive, moved, drive.track)


def with_track(drive: Drive, track: PoseTrack, shift_ns: int = 0) -> Drive:
    """The same with other poses, or with stamps that are later by ``shift_ns``."""
    known = drive.clouds.collected
    poses, is_known = track.at_many(
        np.array([h.stamp_ns + shift_ns for h in known.headers], np.int64)
    )
    other = copy(known)
    other.headers = [
        type(h)(h.topic, h.stamp_ns + shift_ns, h.log_time_ns, h.frame_id) for h in known.headers
    ]
    other.poses = [p if k else None for p, k in zip(poses, is_known, strict=True)]
    return _replaced(drive, other, track)


def _replaced(drive: Drive, collected: Collected, track: PoseTrack) -> Drive:
    clouds = Clouds(collected, drive.clouds.rows, drive.clouds.voxel)
    return Drive(drive.name, drive.topic, clouds, track, drive.seconds)


def jumped(track: PoseTrack, metres: float) -> PoseTrack:
    """The track with a jump to the side in its middle."""
    out = PoseTrack()
    half = len(track) // 2
    for i, (stamp_ns, pose) in enumerate(zip(track.stamps_ns, track.poses, strict=True)):
        moved = yaw_transform(0.0, (0.0, metres, 0.0)) @ pose if i >= half else pose
        out.append(int(stamp_ns), moved)
    return out


def is_found(drive: Drive, fault: str, size: float) -> bool:
    """Whether a fault of a size is found and not accepted."""
    if fault.startswith("clock"):
        return with_track(drive, drive.track, round(size * 1e9)).check().is_wrong
    if fault.startswith("lever"):
        mounting = exp_se3(np.array([size, 0.0, 0.0]), np.zeros(3))
        return with_points(drive, lambda p: apply(inverse(mounting), p)).check().is_wrong
    if fault.startswith("yaw"):
        mounting = exp_se3(np.zeros(3), np.radians([0.0, 0.0, size]))
        return with_points(drive, lambda p: apply(inverse(mounting), p)).check().is_wrong
    if fault.startswith("scale"):
        return with_points(drive, lambda p: (1 + size / 100) * p).check().is_wrong
    track = jumped(drive.track, size)
    return implausible(track) is not None or with_track(drive, track).check().is_wrong


def row_of(drive: Drive) -> dict[str, Any]:
    """The row of a log."""
    begun = time.process_time()
    fit = drive.check()
    seconds = time.process_time() - begun
    jump = implausible(drive.track)
    speed, turn_rate = drive.clouds.rates
    way = drive.track.length()
    row: dict[str, Any] = {
        "log": drive.name,
        "way (m)": round(way, 1),
        "speed (m/s)": round(speed, 1),
        "turn rate (deg/s)": round(float(np.degrees(turn_rate)), 1),
        "alarms": [f.text for f in fit.findings] + ([jump.text] if jump else []),
        "check (s/km)": round(1000 * seconds / way, 2) if way else None,
        "reading (s/km)": round(1000 * drive.seconds / way, 2) if way else None,
    }
    for fault, sizes in SIZES.items():
        row[fault] = next((size for size in sizes if is_found(drive, fault, size)), None)
    return row


def options_of(description: str, flag: str) -> tuple[argparse.Namespace, dict[str, str]]:
    """The options of a script on logs, which has one flag, and its settings by key."""
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("logs", nargs="+", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument(flag, action="store_true")
    options = parser.parse_args()
    return options, dict(text.split("=", 1) for text in options.set)


def main() -> None:
    """Print the table."""
    options, assignments = options_of(__doc__, "--json")
    columns = ("log", "way (m)", "speed (m/s)", "turn rate (deg/s)", *SIZES, "check (s/km)")
    if not options.json:
        print("| " + " | ".join((*columns, "alarms")) + " |")
        print("| " + " | ".join(["---"] * (len(columns) + 1)) + " |")
    for log in options.logs:
        with tempfile.TemporaryDirectory() as folder:
            row = row_of(read(log, assignments, Path(folder)))
        if options.json:
            print(json.dumps(row), flush=True)
        else:
            cells = ["none" if row[c] is None else str(row[c]) for c in columns]
            print("| " + " | ".join([*cells, "; ".join(row["alarms"]) or "-"]) + " |", flush=True)


if __name__ == "__main__":
    main()

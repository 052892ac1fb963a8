"""False closures at the defaults: queries in ambiguous towns, and all pairs of recorded logs.

    python benchmarks/false_closures.py towns DIR [--queries 5000] [--drives FOLDER] [--jobs N]
    python benchmarks/false_closures.py logs DIR LOGS [--small NAME]... [--jobs N]

``towns`` simulates, queries and judges, and resumes. Two of three towns are cities whose blocks are
copies of one another. Then come towns of cameras, most of them driven there and back along recorded
drives, where these are in FOLDER. Their tables DIR/TOWN/judged.parquet hold features, so after a
new calibration the same command counts again without new queries. LOGS is a folder of logs, with
*_truth.json for logs whose truth is known (the logs of one file, and of files that share a log, are
of one place; a closure between logs of different places is false). Each pair is searched with the
labels of the log, with labels from geometry and without any.
"""

from __future__ import annotations

import argparse
import fnmatch
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from towns import Place, Town, collect, short_towns

from semloc_logs.closures.acceptance.calibration import shipped
from semloc_logs.closures.closure_tables import read_closures
from semloc_logs.engines import Engine, make_engine
from semloc_logs.engines.processes import single_threaded
from semloc_logs.evaluation.acceptance_report import SURE, answers, report_of
from semloc_logs.evaluation.calibration_fit import decided_by
from semloc_logs.evaluation.judged_alignments import read_judged
from semloc_logs.evaluation.truth import TrueTrack, judge_closure, read_truth
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse
from semloc_logs.settings import load
from semloc_logs.stages.close import close
from semloc_logs.stages.describe import describe
from semloc_logs.stages.fuse import fuse
from semloc_logs.stages.inputs import SessionInput, session_name
from semloc_logs.tables.table import read_metadata
from semloc_logs.workspace import Workspace

FIRST, MOST = 30, 60  # numbers of the towns: calibration has those before
CAMERAS = (  # stereo cameras there and back along recorded drives see the other sides of things
    Town("camera-back-00", 16, ("stereo",), noise=0.12, trajectory="00", start=700.0, length=240.0),
    Town(
        "camera-back-05",
        17,
        ("stereo",),
        "geometry",
        noise=0.12,
        trajectory="05",
        start=500.0,
        length=240.0,
    ),
    Town(
        "camera-back-06",
        66,
        ("stereo",),
        "geometry",
        noise=0.1,
        trajectory="06",
        start=300.0,
        length=240.0,
    ),
    Town("camera-back-07", 67, ("stereo",), noise=0.1, trajectory="07", length=240.0),
    Town("camera-back-09", 69, ("stereo",), noise=0.1, trajectory="09", start=400.0, length=240.0),
    Town("camera-1", 81, ("stereo",), noise=0.1, sessions=4, length=200.0),
    Town(
        "camera-back-05-far",
        82,
        ("stereo",),
        noise=0.1,
        trajectory="05",
        start=1200.0,
        length=240.0,
    ),
    Town("camera-2", 83, ("stereo",), "geometry", noise=0.1, sessions=4, length=200.0),
    Town(
        "camera-back-00-far",
        84,
        ("stereo",),
        "geometry",
        noise=0.1,
        trajectory="00",
        start=1900.0,
        length=240.0,
    ),
    Town("camera-lidar", 85, ("stereo", "hdl32"), noise=0.1, sessions=2, length=200.0),
    Town("camera-depth-lidar", 86, ("depth", "vlp32"), noise=0.1, sessions=2, length=200.0),
)
SOURCES = ("auto", "geometry", "uniform")  # auto: labels of the log, where it has any
SMALL = ("room_*", "euroc_*")


def search_towns(args: argparse.Namespace) -> None:
    """Ask, then count under the calibration of the package."""
    place = Place(args.dir, args.drives)
    paths = collect(place, short_towns(FIRST, MOST), args.jobs, args.queries) + collect(
        place, CAMERAS, args.jobs
    )
    judged, p = decided_by(shipped(), read_judged(paths))
    print(f"{sum(read_metadata(path)['queries'] for path in paths)} queries in {len(paths)} towns")
    print(report_of(judged, p).markdown())
    accepted = (k for k in answers(judged, p) if p[k] >= SURE)
    for k in (k for k in accepted if not judged.right[k]):
        placed = judged.placed
        ends = f"{placed.query_session[k]} query {placed.query[k]} in {placed.target_session[k]}"
        error = f"{judged.error_m[k]:.1f} m, {judged.error_deg[k]:.0f} degrees"
        print(f"  false: town {judged.town[k]}, {ends}, probability {p[k]:.4f}, {error}")


# -- recorded logs


def logs_of(folder: Path) -> list[Path]:
    """Every log of a folder."""
    return sorted(
        p
        for p in folder.iterdir()
        if p.suffix in (".mcap", ".bag", ".db3") or (p / "metadata.yaml").exists()
    )


def search_logs(args: argparse.Namespace) -> None:
    """Every log against every other one, by label source: at 0.30 m voxels all of them, at 0.05 m
    the small ones.
    """
    engine = make_engine("processes", args.jobs)
    every = logs_of(args.logs)
    small = [
        log for log in every if any(fnmatch.fnmatch(log.name, name) for name in args.small or SMALL)
    ]
    wrong = 0
    for source in SOURCES:
        for voxel, logs in ((0.30, every), (0.05, small)):
            if len(logs) > 1:
                work = Workspace(args.dir / f"{source}-{voxel:g}")
                search_pairs(
                    work, logs, {"labels.source": source, "fusion.voxel_size": str(voxel)}, engine
                )
                wrong += count_pairs(work, args.logs, f"{source}, {voxel:g} m")
    engine.close()
    print(f"{wrong} false closures")


def search_pairs(
    work: Workspace, logs: list[Path], assignments: dict[str, str], engine: Engine
) -> None:
    """Fuse, describe and close; a log that cannot be fused is named and left out."""
    settings = load(assignments=assignments).resolved()

    sessions = [SessionInput(session_name(log), (log,)) for log in logs]
    report = fuse(sessions, work, settings, engine)
    for failed in report.failed:
        print(f"  left out: {failed}")
    describe(work, [], settings, engine)
    close(work, settings, engine)


def count_pairs(work: Workspace, logs: Path, title: str) -> int:
    """Print the closures of each pair of sessions with their errors; how many are false."""
    sessions = {f.name: SessionMap(f) for f in work.sessions()}
    place, tracks = places(logs, sessions)
    pairs: dict[tuple[str, str], list[Any]] = {}
    for row in read_closures(work.closures):
        pairs.setdefault((row["query_session"], row["target_session"]), []).append(row)
    wrong = 0
    print(f"{title}: {sum(map(len, pairs.values()))} closures of {len(sessions)} sessions")
    for (query, target), rows in sorted(pairs.items()):
        judged = [judge_closure(row, tracks) for row in rows]
        if place.get(query, query) != place.get(target, target):
            wrong += len(rows)
            print(f"  {query} in {target}: {len(rows)} closures, all false: other places")
            continue
        false = sum(j.correct is False for j in judged)
        errors = [j.error_m for j in judged if j.error_m is not None]
        wrong += false
        figures = (
            f"error median {np.median(errors):.3f} m, worst {max(errors):.3f} m"
            if errors
            else "truth unknown"
        )
        print(f"  {query} in {target}: {len(rows)} closures, {false} false, {figures}")
    return wrong


def places(
    logs: Path, sessions: Mapping[str, SessionMap]
) -> tuple[dict[str, Path], dict[str, TrueTrack]]:
    """The truth file that knows each session, which stands for its place, and the true tracks.

    Files that share a session are of one place, in the frame of the first one.
    """
    place: dict[str, Path] = {}
    tracks: dict[str, TrueTrack] = {}
    for truth in sorted(logs.glob("*_truth.json")):
        if any(
            Path(name).stem in sessions or name in sessions
            for name in json.loads(truth.read_text())
        ):
            found = read_truth(truth, sessions)
            shared = next((name for name in found if name in tracks), None)
            if shared is None:
                place |= dict.fromkeys(found, truth)
                tracks |= found
                continue
            first_T_this = tracks[shared].common_T_base[0] @ inverse(found[shared].common_T_base[0])
            for name in found.keys() - tracks.keys():
                place[name] = place[shared]
                track = found[name]
                tracks[name] = TrueTrack(track.stamps_ns, first_T_this @ track.common_T_base)
    return place, tracks


def main() -> None:
    """The command line."""
    single_threaded()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    first = commands.add_parser("towns")
    first.add_argument("dir", type=Path)
    first.add_argument("--queries", type=int, default=5000)
    first.add_argument(
        "--drives", type=Path, help="folder of kitti_00.txt and others: towns along these as well"
    )
    first.set_defaults(run=search_towns)
    second = commands.add_parser("logs")
    second.add_argument("dir", type=Path)
    second.add_argument("logs", type=Path)
    second.add_argument(
        "--small",
        action="append",
        metavar="NAME",
        help="logs that are searched at 0.05 m voxels, too; default room_* and euroc_*",
    )
    second.set_defaults(run=search_logs)
    for command in (first, second):
        command.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()

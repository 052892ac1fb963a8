"""Make semloc_logs/closures/acceptance/calibration.json again, from towns that no training has
seen.

    python benchmarks/calibrate.py collect DIR [--drives FOLDER] [--only TOWN]... [--jobs N]
    python benchmarks/calibrate.py fit DIR [--install]
    python benchmarks/calibrate.py report DIR...
    python benchmarks/calibrate.py parts DIR...

Collecting simulates, queries and judges, and resumes; fitting takes seconds. Collecting writes
DIR/TOWN/judged.parquet, all alignments of a town with their features and errors; the others read
these alone. Fitting writes DIR/calibration.json, and the report of models that had not seen a town:
DIR/acceptance.md, DIR/acceptance.json and DIR/reliability.png. --install also replaces the
calibration of the package. The report of the package's own calibration goes to the terminal, as
does a table of closures where one part of the acceptance is left out.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from towns import Place, Town, collect

import semloc_logs.closures.acceptance
from semloc_logs.closures.acceptance.calibration import shipped
from semloc_logs.engines.processes import single_threaded
from semloc_logs.evaluation.acceptance_report import reliability, report_of
from semloc_logs.evaluation.calibration_fit import calibration_json, decided_by, fit
from semloc_logs.evaluation.decision_parts import parts_markdown
from semloc_logs.evaluation.judged_alignments import Judged, read_judged
from semloc_logs.pictures.reliability_diagram import draw_reliability

LATER = ("summer", "autumn", "snow")
TOWNS = (
    Town("drawn", 1, noise=0.12, seasons=LATER, length=110.0),
    Town("geometry", 2, ("hdl64",), "geometry", roadworks=4.0, length=110.0),
    Town("sparse", 4, ("vlp16",), noise=0.12, seasons=LATER, drift=0.015, length=110.0),
    Town(
        "stereo-back",
        6,
        ("stereo",),
        noise=0.12,
        trajectory="00",
        start=1200.0,
        sessions=2,
        length=140.0,
    ),
    Town(
        "there-and-back",
        7,
        ("hdl64",),
        noise=0.08,
        trajectory="00",
        start=300.0,
        seasons=("summer", "snow"),
        sessions=2,
        length=140.0,
    ),
    Town("mixed", 8, ("depth", "hdl32"), noise=0.08, sessions=1, length=120.0),
    Town("uniform", 10, ("hdl32",), "uniform", sessions=2),
    Town(
        "back-geometry",
        11,
        ("hdl32",),
        "geometry",
        trajectory="05",
        start=200.0,
        sessions=2,
        length=140.0,
    ),
    Town("stereo-lidar", 12, ("stereo", "vlp32"), noise=0.12, sessions=1, length=120.0),
    Town("rosette", 41, ("rosette", "hdl32"), "geometry", noise=0.1, sessions=1, length=120.0),
    Town("camera-1", 81, ("stereo",), noise=0.1, length=140.0),
    Town("plain-20", 120, noise=0.1, labels="geometry", sessions=4, length=110.0),
    Town("plain-21", 121, ("vlp16", "hdl64"), "geometry", noise=0.1, sessions=2),
    Town("repeating-a", 3, noise=0.05, repeating=True, sessions=2, length=160.0),
    Town(
        "repeating-b", 103, labels="geometry", noise=0.05, repeating=True, sessions=2, length=160.0
    ),
    Town("repeating-c", 104, ("vlp16",), noise=0.1, repeating=True, sessions=2, length=160.0),
    Town(
        "repeating-d",
        105,
        ("hdl64",),
        "geometry",
        noise=0.05,
        repeating=True,
        sessions=4,
        length=160.0,
    ),
    Town("repeating-e", 106, noise=0.1, repeating=True, sessions=2, length=160.0),
    Town(
        "repeating-f", 107, labels="geometry", noise=0.05, repeating=True, sessions=2, length=160.0
    ),
    Town("single-hdl64", 31, ("hdl64",), "geometry", noise=0.1, sessions=2, sweeps=11.0),
    Town("single-hdl64b", 35, ("hdl64",), noise=0.1, sessions=2, sweeps=11.0),
    Town(
        "single-mixed",
        32,
        ("vlp16", "raster"),
        "geometry",
        noise=0.1,
        sessions=2,
        length=100.0,
        sweeps=11.0,
    ),
    Town(
        "single-rosette", 33, ("rosette", "hdl32"), "geometry", noise=0.1, sessions=1, sweeps=11.0
    ),
    Town("single-vlp16", 34, ("vlp16",), noise=0.1, sessions=2, sweeps=11.0),
    Town(
        "single-repeating",
        36,
        ("hdl64",),
        "geometry",
        noise=0.1,
        repeating=True,
        sessions=2,
        sweeps=11.0,
    ),
)


def collect_towns(args: argparse.Namespace) -> None:
    """Simulate, fuse, describe, query and judge the towns that have no table yet."""
    single_threaded()
    collect(
        Place(args.dir, args.drives),
        [town for town in TOWNS if not args.only or town.name in args.only],
        args.jobs,
    )


def fit_models(args: argparse.Namespace) -> None:
    """Fit the models; report and draw their results in towns that they have not seen."""
    judged = judged_towns([args.dir])
    fitted = fit(judged)
    content = json.dumps(calibration_json(judged, fitted), indent=1) + "\n"
    (args.dir / "calibration.json").write_text(content)

    report = report_of(fitted.judged, fitted.probability)
    (args.dir / "acceptance.md").write_text(report.markdown())
    (args.dir / "acceptance.json").write_text(json.dumps(report.to_json(), indent=1) + "\n")
    print(report.markdown())
    ordinary = ~judged.copies & judged.clear
    curves = {
        "alone, outside cities of copies": reliability(
            fitted.alone[ordinary], judged.right[ordinary]
        ),
        "with neighbours": reliability(
            fitted.probability[fitted.judged.clear], fitted.judged.right[fitted.judged.clear]
        ),
    }
    draw_reliability(args.dir / "reliability.png", curves)
    if args.install:
        package = Path(semloc_logs.closures.acceptance.__file__).parent
        (package / "calibration.json").write_text(content)


def report(args: argparse.Namespace) -> None:
    """Print what the calibration of the package does in the towns of some folders."""
    judged = judged_towns(args.dirs)
    print(report_of(*decided_by(shipped(), judged)).markdown())


def parts(args: argparse.Namespace) -> None:
    """Print what each part of the acceptance does."""
    print(parts_markdown(judged_towns(args.dirs)))


def judged_towns(folders: Sequence[Path]) -> Judged:
    """The judged alignments of all towns of some folders."""
    return read_judged(sorted(p for folder in folders for p in folder.glob("*/judged.parquet")))


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    first = commands.add_parser("collect")
    first.add_argument("dir", type=Path)
    first.add_argument(
        "--drives",
        type=Path,
        help="folder of kitti_00.txt and kitti_05.txt; without it their towns are left out",
    )
    first.add_argument("--only", action="append", metavar="TOWN")
    first.add_argument("--jobs", type=int, default=1)
    first.set_defaults(run=collect_towns)
    second = commands.add_parser("fit")
    second.add_argument("dir", type=Path)
    second.add_argument("--install", action="store_true")
    second.set_defaults(run=fit_models)
    third = commands.add_parser("report")
    third.add_argument("dirs", type=Path, nargs="+", metavar="DIR")
    third.set_defaults(run=report)
    fourth = commands.add_parser("parts")
    fourth.add_argument("dirs", type=Path, nargs="+", metavar="DIR")
    fourth.set_defaults(run=parts)
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()

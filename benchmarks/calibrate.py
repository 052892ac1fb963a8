"""Make semloc_logs/closures/calibration.json again: python benchmarks/calibrate.py DIR [EVERY]."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from semloc_logs.engines import make_engine
from semloc_logs.engines.engine import single_threaded
from semloc_logs.evaluation.calibration import TOWNS, calibrate, collect, reliability, simulate_towns
from semloc_logs.settings import load
from semloc_logs.stages import describe, fuse
from semloc_logs.workspace import Workspace


def main() -> None:
    """Simulate, fuse, describe, ask every EVERY-th query, fit, print; what is done already is kept."""
    folder, every = Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 4
    single_threaded()
    engine, work = make_engine("processes"), Workspace(folder / "work")
    logs = simulate_towns(folder)
    sources = {str(town.seed): town.label_source for town in TOWNS}
    for source in sorted(set(sources.values())):
        mine = {name: [log] for name, log in logs.items() if sources[name.split("_")[0]] == source}
        fuse(mine, work, load(assignments={"labels.source": source}).resolved(), {}, engine, print)
    settings = load().resolved()
    describe(work, [], settings, engine, print)
    rows = collect(work, logs, settings, engine.map, every)
    content = calibrate(rows)
    (folder / "calibration.json").write_text(json.dumps(content, indent=1) + "\n")
    print(json.dumps(content, indent=1))
    for line in reliability(rows):  # under the calibration in the package, not under the new one
        print(line)
    nees = [r.nees for r in rows if r.right]
    engine.close()
    print("NEES of right alignments (6 degrees of freedom): median", np.median(nees) if nees else None)


if __name__ == "__main__":
    main()

"""What the check of poses against range data costs beside fusing, log by log.

python benchmarks/fit_cost.py LOG... [--set KEY=VALUE]... [--profile]

Prints seconds of processor time a km of way: of `fuse_session` in all, of the check within it, and
their ratio. A first check of each log, which loads compiled code, is not counted. --profile prints
where the check spends its time.
"""

from __future__ import annotations

import cProfile
import pstats
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from fit_detection import options_of, read

from semloc_logs.mapping.session_fusion import FuseTask, fuse_session
from semloc_logs.settings import load
from semloc_logs.workspace import SessionFolder


def main() -> None:
    """Print the table."""
    options, assignments = options_of(__doc__, "--profile")
    print("| log | way (m) | keyframes | fusing (s/km) | check (s/km) | share (%) |")
    print("| --- | --- | --- | --- | --- | --- |")
    for log in options.logs:
        with tempfile.TemporaryDirectory() as folder:
            drive = read(log, assignments, Path(folder))
            drive.check()
            drive = replace(drive, clouds=replace(drive.clouds))  # without what it has kept
            profile = cProfile.Profile(time.process_time)
            begun = time.process_time()
            if options.profile:
                profile.runcall(drive.check)
            else:
                drive.check()
            check = time.process_time() - begun
            task = FuseTask(
                (log,),
                SessionFolder(Path(folder) / "map"),
                load(assignments=assignments).resolved(),
            )
            begun = time.process_time()
            fuse_session(task)
            fusing = time.process_time() - begun
        way = drive.track.length() / 1000
        cells = (
            drive.name,
            f"{1000 * way:.0f}",
            str(len(drive.clouds.rows)),
            f"{fusing / way:.1f}",
            f"{check / way:.1f}",
            f"{100 * check / fusing:.0f}",
        )
        print("| " + " | ".join(cells) + " |", flush=True)
        if options.profile:
            pstats.Stats(profile).sort_stats("tottime").print_stats(25)


if __name__ == "__main__":
    main()

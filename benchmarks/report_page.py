"""The report of a large workspace: seconds to write it, and its size.

    python benchmarks/report_page.py DIR [--sessions 100] [--closures 10000] [--road 3000]

Writes a workspace of tables without logs to DIR (about 150 MB at these numbers), unless it is
there, and its report. The budget is 15 MB. To see how it opens, load DIR/report.html in a browser.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from semloc_logs.settings import Settings
from semloc_logs.simulation.output.workspace_tables import TablesPlan, write_tables
from semloc_logs.stages.report_page import write_report
from semloc_logs.workspace import Workspace


def main() -> None:
    """Write both, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sessions", type=int, default=100)
    parser.add_argument("--closures", type=int, default=10_000)
    parser.add_argument("--road", type=float, default=3000.0, help="of each session (m)")
    given = parser.parse_args()
    work = Workspace(given.folder)
    if not work.closures.exists():
        write_tables(work, TablesPlan(given.sessions, given.closures, given.road, groups=3))
    for slim in (True, False):
        begun = time.process_time()
        path = write_report(work, Settings().resolved(), slim=slim)
        seconds = time.process_time() - begun
        kind = "without pictures" if slim else "whole"
        print(f"{kind}: {path.stat().st_size / 1e6:.1f} MB, {seconds:.1f} s of CPU")


if __name__ == "__main__":
    main()

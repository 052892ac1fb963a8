"""`semloc benchmark memory`: peak memory of fusing drives of several lengths."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from semloc_logs.errors import SemlocError
from semloc_logs.settings import Resolved

Figures = dict[str, dict[str, float | str]]
# of resource.getrusage: kilobytes on Linux, bytes on macOS
PEAKS_PER_MB = 1024 if sys.platform.startswith("linux") else 1024**2
# a process inherits the peak of the process that forks it, so a small one starts semloc
_LAUNCH = """
import resource, subprocess, sys
main = "from semloc_logs.cli.main import main; main()"
code = subprocess.call([sys.executable, "-c", main, *sys.argv[1:]])
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
sys.exit(code)
"""


def memory_curve(lengths: Sequence[int], settings: Resolved) -> Figures:
    """Peak resident memory of `semloc fuse` for a drive of 250 m and its multiples ``lengths``.

    The road goes on (new places), or is driven there and back (the same places again). SemlocError
    when fusing fails.
    """
    from semloc_logs.simulation.output.long_drive import LAP_M, Lap

    figures: Figures = {}
    lap = Lap()
    with tempfile.TemporaryDirectory(prefix="semloc-memory-") as name:
        folder = Path(name)
        log = folder / "drive.mcap"
        config = folder / "settings.yaml"
        config.write_text(settings.dump())
        command = ["fuse", log, "-w", folder / "work", "--config", config, "-q", "--overwrite"]
        for onwards in (True, False):
            for laps in lengths:
                sweeps = lap.write(log, laps, onwards=onwards)
                start = time.perf_counter()
                peak = peak_memory([str(part) for part in command])
                figures[f"{laps}x, {'new places' if onwards else 'the same again'}"] = {
                    "ours": round(peak, 1),
                    "unit": f"MB peak, {laps * LAP_M:.0f} m",
                    "sweeps": float(sweeps),
                    "seconds": round(time.perf_counter() - start, 1),
                }
    return figures


def peak_memory(arguments: Sequence[str]) -> float:
    """Peak resident memory (MB) of `semloc` with ``arguments`` in a process of its own.

    SemlocError when it fails.
    """
    done = subprocess.run(
        [sys.executable, "-c", _LAUNCH, *arguments], capture_output=True, text=True, check=False
    )
    if done.returncode not in (0, 3):
        raise SemlocError(f"semloc {' '.join(arguments)} failed: {done.stderr.strip()}")
    return int(done.stdout.split()[-1]) / PEAKS_PER_MB

"""Mappers to compare with: each runs in a process of a Python environment of its own, one round
after the other.

A peer NAME is the script ``benchmarks/peers/NAME_runner.py`` of the source checkout. It gets a
folder with ``points_K.npy`` ((n, 3) float32, sensor frame), ``poses.npy`` ((m, 4, 4)), voxel size
and range; for every line on its stdin it integrates all scans into a new map and answers with a
line of JSON, the fields of :class:`Round`.
"""

from __future__ import annotations

import json
import os
import subprocess
import threading
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

import semloc_logs
from semloc_logs.benchmarks.scans import Scan
from semloc_logs.errors import SemlocError, SettingsError

_ANSWER_SECONDS = 600.0
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True, slots=True)
class Round:
    """All scans in one new map: wall-clock and processor milliseconds of each, milliseconds of the
    work at the end; voxels of the map.
    """

    ms: list[float]
    cpu_ms: list[float]
    finish_ms: float
    free: int
    occupied: int


def runner(name: str) -> Path:
    """The script of peer ``name``; SettingsError naming those there are."""
    folder = Path(semloc_logs.__file__).resolve().parents[1] / "benchmarks" / "peers"
    known = sorted(p.name.removesuffix("_runner.py") for p in folder.glob("*_runner.py"))
    if name not in known:
        advice = (
            f"give one of {', '.join(known)}"
            if known
            else "the scripts of peers are in benchmarks/peers of the source checkout"
        )
        raise SettingsError(f"Unknown peer '{name}': {advice}.")
    return folder / f"{name}_runner.py"


def environment(threads: int) -> dict[str, str]:
    """Of a peer's process: so many ``threads``, and no modules of ours."""
    out = os.environ | dict.fromkeys(_THREADS, str(threads)) | {"OMP_WAIT_POLICY": "passive"}
    out.pop("PYTHONPATH", None)
    return out


def run_peer(name: str, python: str, arguments: Sequence[str], seconds: float) -> str:
    """The output of the script of peer ``name``, which has ``seconds`` and one thread.

    SettingsError when ``python`` cannot be started, SemlocError when the script fails.
    """
    command = [python, "-I", str(runner(name)), *arguments]
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            check=False,
            env=environment(1),
            timeout=seconds,
        )
    except (OSError, subprocess.TimeoutExpired) as problem:
        raise SettingsError(
            f"Peer {name} cannot be had from {python} ({problem}): give --peer {name}=PYTHON."
        ) from None
    if done.returncode:
        raise _failure(name, done.stderr)
    return done.stdout


def _failure(name: str, errors: str) -> SemlocError:
    """The error of a peer that wrote ``errors`` to its stderr."""
    lines = errors.strip().splitlines()
    reason = lines[-1] if lines else "without a message"
    return SemlocError(f"Peer {name} failed ({reason}): see benchmarks/README.md.")


def write_scans(folder: Path, scans: Sequence[Scan]) -> None:
    """The scans as files that a peer reads."""
    for k, scan in enumerate(scans):
        np.save(folder / f"points_{k}.npy", scan.points)
    np.save(folder / "poses.npy", np.stack([s.map_T_sensor for s in scans]))


class Peer:
    """One peer at work on the scans of ``folder`` with so many ``threads``; a context manager."""

    def __init__(
        self,
        name: str,
        python: str,
        folder: Path,
        voxel_size: float,
        max_range: float,
        threads: int,
    ) -> None:
        self.name = name
        command = [python, "-I", str(runner(name)), str(folder), repr(voxel_size), repr(max_range)]
        self._errors = (folder / f"{name}-{threads}.err").open("w+")
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                text=True,
                env=environment(threads),
            )
        except OSError as problem:
            self._errors.close()
            raise SettingsError(
                f"Peer {name} cannot be started with {python} ({problem.strerror}): "
                f"give --peer {name}=PYTHON."
            ) from None

    def __enter__(self) -> Peer:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()
        self._errors.close()

    def round(self) -> Round:
        """Everything once, into a new map. SemlocError when the peer fails or does not answer
        within ten minutes.
        """
        watch = threading.Timer(_ANSWER_SECONDS, self._process.kill)
        watch.start()
        try:
            ask = self._process.stdin
            answer = self._process.stdout
            if ask is not None and answer is not None:
                ask.write("round\n")
                ask.flush()
                content = json.loads(answer.readline())
                return Round(**{f.name: content[f.name] for f in fields(Round)})
        except (OSError, ValueError, KeyError, TypeError):
            pass
        finally:
            watch.cancel()
        self._errors.seek(0)
        raise _failure(self.name, self._errors.read())


def open_peers(
    stack: ExitStack,
    peers: Mapping[str, str],
    folder: Path,
    voxel_size: float,
    max_range: float,
    cores: int,
) -> dict[str, Peer]:
    """Each of ``peers`` (name -> Python) with one thread as NAME and, where there are more cores,
    with two as NAME_2.
    """
    out = {}
    for name, python in peers.items():
        for threads in (1, 2) if cores > 1 else (1,):
            label = name if threads == 1 else f"{name}_{threads}"
            out[label] = stack.enter_context(
                Peer(name, python, folder, voxel_size, max_range, threads)
            )
    return out

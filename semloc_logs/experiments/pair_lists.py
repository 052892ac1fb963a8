"""Pair lists of the LiDAR-Registration-Benchmark: frames of recorded sequences to be registered.

A pair is a query with a database of one view, so every system can register it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semloc_logs.arrays import F64, I64
from semloc_logs.errors import TruthError
from semloc_logs.experiments.scenarios import PlannedQuery, Scenario, Trial, query_name
from semloc_logs.experiments.views import ViewStore

PAIRS = "pairs"  # the name of the scenario
LATEST_NS = 600_000_000  # between a frame and its view: keyframes are a metre or two apart


@dataclass(frozen=True, eq=False)
class RegistrationPair:
    """Frame ``source`` of ``sequence`` and frame ``target`` of ``target_sequence``;
    ``target_T_source`` (4, 4) is the list's truth.
    """

    sequence: int
    source: int
    target_sequence: int
    target: int
    target_T_source: F64


def read_pairs(path: Path) -> list[RegistrationPair]:
    """The pairs of a list of the LiDAR-Registration-Benchmark: a line of titles, then sequence and
    frame of both sides and 16 numbers of a matrix. TruthError for a file of another form.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()[1:]
    except (OSError, ValueError) as problem:
        raise TruthError(f"Pair list {path} cannot be read ({problem}).") from None
    out = []
    for number, line in enumerate(lines, start=2):
        words = line.split()
        if not words:
            continue
        try:
            ids = [int(word) for word in words[:4]]
            matrix = np.array([float(word) for word in words[4:20]]).reshape(4, 4)
        except ValueError:
            raise TruthError(
                f"Pair list {path}, line {number}: give four whole numbers and a 4x4 matrix."
            ) from None
        out.append(RegistrationPair(ids[0], ids[1], ids[2], ids[3], matrix))
    return out


def pair_scenario(
    store: ViewStore, pairs: Sequence[RegistrationPair], frames_ns: Mapping[str, I64]
) -> Scenario:
    """Each pair as a query in a database of one view.

    A frame is counted in the true stamps ``frames_ns`` of its session, whose name ends with the
    number of the sequence, as ``semloc import`` names it; its view is the keyframe nearest in
    time. Pairs without views are left out; TruthError when none is left.
    """
    trials: list[Trial] = []
    for pair in pairs:
        source = _view(store, frames_ns, pair.sequence, pair.source)
        target = _view(store, frames_ns, pair.target_sequence, pair.target)
        if source is not None and target is not None and source != target:
            number = len(trials)
            name = f"{query_name(store, source)} on {query_name(store, target)}"
            query = PlannedQuery(name, source, number)
            trials.append(Trial(f"{number:05d}", np.array([target]), (query,)))
    if not trials:
        wanted = ", ".join(sorted({f"{pair.sequence:02d}" for pair in pairs})) or "none"
        raise TruthError(
            f"No pair of the list has its frames in the sessions {', '.join(store.names)}: it has"
            f" the sequences {wanted}, and names of sessions end with the number of one."
        )
    return Scenario(PAIRS, tuple(trials))


def _view(store: ViewStore, frames_ns: Mapping[str, I64], sequence: int, frame: int) -> int | None:
    """The number of the view of a frame."""
    for name in store.names:
        digits = re.search(r"(\d+)$", name)
        if digits is None or int(digits[1]) != sequence or name not in frames_ns:
            continue
        if not 0 <= frame < len(frames_ns[name]):
            return None
        views = store.of_session(name)
        away = np.abs(store.stamps_ns[views] - frames_ns[name][frame])
        return int(views[np.argmin(away)]) if len(views) and away.min() <= LATEST_NS else None
    return None

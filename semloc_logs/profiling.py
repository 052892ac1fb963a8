"""Figures of whole logs: where the time of `semloc run` goes, and what the words are worth."""

from __future__ import annotations

import cProfile
import pstats
import resource
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from semloc_logs.closures.queries import SessionMap, query_keyframes
from semloc_logs.engines import make_engine
from semloc_logs.evaluation.retrieval import word_recall
from semloc_logs.evaluation.truth import read_truth
from semloc_logs.geometry import inverse
from semloc_logs.settings import Settings
from semloc_logs.stages import fuse, run, session_name
from semloc_logs.subvolumes.describe import load_encoder, random_encoder
from semloc_logs.subvolumes.network import Encoder
from semloc_logs.tables import read_metadata
from semloc_logs.words.vocabulary import Vocabulary, load_vocabulary
from semloc_logs.workspace import Workspace

Figures = dict[str, dict[str, float | str]]


def profile_pipeline(logs: Sequence[Path], settings: Settings, functions: int = 12) -> tuple[Figures, list[tuple[float, int, str]]]:
    """Run the pipeline on ``logs`` in this process in a fresh workspace.

    Returns the figures (seconds of each stage, seconds a query, peak resident memory in MB) and, for the ``functions`` that took most
    time themselves, seconds, calls and where they are. The profiler adds some percent to code that calls many small functions.
    """
    with tempfile.TemporaryDirectory(prefix="semloc-profile-") as folder:
        work = Workspace(Path(folder))
        profiler = cProfile.Profile()
        report = profiler.runcall(
            run, {session_name(log): [log] for log in logs}, work, settings, {}, make_engine("serial"), lambda _: None
        )
        queries = int(read_metadata(work.closures)["queries"])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform.startswith("linux") else 1024**2)
    figures: Figures = {f"{stage}": {"ours": seconds, "unit": "s"} for stage, seconds in report.seconds.items()}
    figures["query"] = {"ours": report.seconds["close"] / max(queries, 1), "unit": "s a query"}
    figures["memory"] = {"ours": round(peak, 1), "unit": "MB peak"}
    figures["closures"] = {"ours": float(report.closures), "unit": ""}
    stats = pstats.Stats(profiler).stats  # type: ignore[attr-defined]
    rows = sorted(((own, calls, _place(where)) for where, (_, calls, own, _, _) in stats.items()), reverse=True)
    return figures, rows[:functions]


def _place(where: tuple[str, int, str]) -> str:
    path, line, name = where
    return name if line == 0 else f"{'/'.join(Path(path).parts[-2:])}:{line} {name}"


def word_recalls(logs: Sequence[Path], truth: Path, settings: Settings) -> Figures:
    """Recall at 5 of word matches within 1.5 m between two logs whose true alignment is known: trained weights beside random ones.

    Every query of the second log is put to the map of the first one, in the search's heading nearest to the true one; queries farther
    than 10 m from the first log's road do not count. ``random`` is the mean over three seeds, with a vocabulary of their own.
    """
    with tempfile.TemporaryDirectory(prefix="semloc-words-") as folder:
        work = Workspace(Path(folder))
        settings = settings.resolved()
        sessions = {session_name(log): [log] for log in logs}
        fuse(sessions, work, settings, {}, make_engine("serial"), lambda _: None)
        maps = {name: SessionMap(work.session(name)) for name in sessions}
        target, query = maps.values()
        tracks = read_truth(truth, maps)
        common = {name: tracks[name].at(m.stamps_ns)[0] for name, m in maps.items()}
        pairs = []
        for k in query_keyframes(query, settings):
            here = common[query.folder.name][k]
            away = np.linalg.norm(common[target.folder.name][:, :3, 3] - here[:3, 3], axis=1)
            near = int(np.argmin(away))
            if away[near] < 10.0:
                targetmap_T_common = target.map_T_base[near] @ inverse(common[target.folder.name][near])
                pairs.append((k, targetmap_T_common @ here @ inverse(query.map_T_base[k])))
        figures: Figures = {}
        for variant in ("semantic", "geometric"):
            trained = load_encoder(variant, settings.descriptor.weights), load_vocabulary(variant, settings.descriptor.vocabulary)
            random: list[tuple[Encoder, Vocabulary | None]] = [(random_encoder(variant, seed), None) for seed in range(3)]
            rows: dict[str, list[tuple[Encoder, Vocabulary | None]]] = {"ours": [trained], "random weights": random}
            found = {
                who: [word_recall(query, k, target, T, settings, e, words) for e, words in networks for k, T in pairs]
                for who, networks in rows.items()
            }
            for how in ("exact", "coded"):
                row: dict[str, float | str] = {who: float(np.mean([getattr(r, how) for r in rs])) for who, rs in found.items() if rs}
                figures[f"{variant}, {'by descriptor' if how == 'exact' else 'by word and code'}"] = row | {"unit": "recall at 5"}
        return figures

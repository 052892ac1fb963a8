"""Speed and recall of the look-up of words, beside FAISS on codes of as many bits.

Descriptors are drawn without clusters; their principal directions matter less and less, as in
trained networks. A query is one of the database moved by noise, and *found* is the share of queries
whose origin is among the five nearest. Codes of the peers have one threshold for each bit, the
median of all: they have no cells. Processor time, the least of some runs and the median.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32
from semloc_logs.errors import SettingsError
from semloc_logs.settings import Resolved
from semloc_logs.words.index import Allowed, Index
from semloc_logs.words.vocabulary import Vocabulary, codes_of, train_vocabulary

Figures = dict[str, dict[str, float | str]]
QUERIES = 5000
BLOCK = 50_000
NOISE = 0.45  # of a query, in units of the descriptor
RUNNER = Path(__file__).parents[2] / "benchmarks" / "peers" / "faiss_runner.py"


def draw(seed: int, n: int, dimensions: int = 256) -> F32:
    """Unit vectors (n, dimensions) whose k-th direction has a spread of k^-0.5."""
    v = (
        np.random.default_rng(seed).standard_normal((n, dimensions), np.float32)
        * np.arange(1, dimensions + 1, dtype=np.float32) ** -0.5
    )
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True), np.float32)


def search_speed(
    settings: Resolved,
    sizes: Sequence[int] = (100_000, 1_000_000),
    peers: Mapping[str, str] | None = None,
) -> Figures:
    """ms of 5,000 look-ups of the five nearest, and the share found, in databases of ``sizes``
    words with 1, 4, 8 and 16 probes.

    ``peers`` may name faiss=PYTHON. Raises SettingsError for another peer or one that fails.
    """
    if peers and (set(peers) != {"faiss"} or not RUNNER.exists()):
        raise SettingsError(
            "The only peer of search is faiss=PYTHON, run from a checkout (benchmarks/README.md), "
            f"not {', '.join(peers)}."
        )
    # the second level takes no part in a look-up
    vocabulary = train_vocabulary(draw(1, 100_000), children=16)
    threshold = np.median(vocabulary.projected(draw(1, 20_000)), axis=0)
    figures: Figures = {}
    for size in sizes:
        figures |= _one_size(settings, vocabulary, threshold, size, peers or {})
    return figures


def _one_size(
    settings: Resolved, vocabulary: Vocabulary, threshold: F32, size: int, peers: Mapping[str, str]
) -> Figures:
    blocks = range(0, size, BLOCK)
    words = []
    flat = []
    origins = []
    truth = np.sort(np.random.default_rng(5).choice(size, QUERIES, replace=False))
    for start in blocks:
        d = draw(100 + start, min(BLOCK, size - start))
        words.append(vocabulary.words(d))
        flat.append(codes_of(vocabulary.projected(d) - threshold))
        origins.append(d[truth[(truth >= start) & (truth < start + BLOCK)] - start])
    queries = np.concatenate(origins) + NOISE * draw(7, QUERIES)
    queries /= np.linalg.norm(queries, axis=1, keepdims=True)
    index = Index.of_words(
        vocabulary,
        np.concatenate([w[0] for w in words]),
        np.concatenate([w[1] for w in words]),
        np.zeros(size, np.int64),
    )
    allowed = Allowed(np.ones(1, bool))
    peer = (
        _faiss(
            peers["faiss"],
            np.concatenate(flat),
            codes_of(vocabulary.projected(queries) - threshold),
            truth,
        )
        if peers
        else {}
    )
    figures: Figures = {}
    for probes in sorted({1, 4, 8, 16, settings.closures.probes}):
        least, median = timed(partial(index.search, queries, 5, probes, allowed))
        m = index.search(queries, 5, probes, allowed)
        share = float(len(np.unique(m.query[truth[m.query] == m.entry])) / QUERIES)
        figures[f"{size} words, {probes} probes"] = {"ours": least, **_shown(median, share)}
    for name, (least, median, share) in peer.items():
        figures[f"{size} words, {name}"] = {"faiss": least, **_shown(median, share)}
    return figures


def _shown(median: float, share: float) -> dict[str, float | str]:
    return {"unit": f"processor ms, {QUERIES} look-ups", "median_ms": median, "found": share}


def timed(action: Callable[[], Any], repeats: int = 5) -> tuple[float, float]:
    """Least and median processor milliseconds of some runs after one to warm up."""
    action()
    taken = []
    for _ in range(repeats):
        start = time.process_time()
        action()
        taken.append(1e3 * (time.process_time() - start))
    return min(taken), float(np.median(taken))


def _faiss(
    python: str, codes: NDArray[np.uint64], queries: NDArray[np.uint64], truth: NDArray[np.int64]
) -> dict[str, list[float]]:
    """Least ms, median ms and share found of each kind of index; its process has an environment and
    packages of its own.
    """
    with tempfile.TemporaryDirectory(prefix="semloc-") as folder:
        for name, array in (("codes", codes), ("queries", queries), ("truth", truth)):
            np.save(Path(folder) / f"{name}.npy", array)
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        try:
            ran = subprocess.run(
                [python, str(RUNNER), folder],
                env=environment,
                check=True,
                capture_output=True,
                text=True,
            )
            figures: dict[str, list[float]] = json.loads(ran.stdout)
        except (OSError, subprocess.CalledProcessError, ValueError) as problem:
            last = (getattr(problem, "stderr", None) or str(problem)).strip().splitlines()[-1]
            raise SettingsError(
                f"{python}: FAISS did not run ({last}): install faiss-cpu and numpy there."
            ) from None
        return figures

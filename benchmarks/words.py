"""The loss by the vocabulary: `python benchmarks/words.py SHARDS [--variant semantic] [--pairs
300]`, from packed pairs (`semloc train`).

Of the shards the last fifth is searched: its complete, shifted views are the database, with as many
distractors from other shards, and its incomplete views are the queries. *partner*: share of queries
with the same place, seen completely, among the five nearest; *exact*: share of the five nearest by
descriptor that are found. Trained on the first half of the shards. Takes some minutes on one core.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from semloc_logs.arrays import F32, I64
from semloc_logs.subvolumes.cut import code_table
from semloc_logs.subvolumes.describe import load_encoder
from semloc_logs.subvolumes.network import Encoder, descriptors
from semloc_logs.training.descriptor_samples import shard_descriptors
from semloc_logs.training.pairs import read_shard
from semloc_logs.words.index import SHORTLIST, Allowed, Index, Matches
from semloc_logs.words.vocabulary import Vocabulary, train_vocabulary

QUERIES = 5000
NEAREST = 5
BLOCK = 250  # queries that are compared with the whole database at once
BATCH = 16  # views that are described at once
EVERYTHING = Allowed(np.ones(1, bool))


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """Descriptors to search; the true row of each query and its five nearest rows by descriptor."""

    database: F32
    queries: F32
    partner: I64
    exact: I64

    def scores(self, found: I64) -> tuple[float, float]:
        """Shares of partners and of the exact five among the rows ``found`` (n, 5)."""
        partners = (found == self.partner[:, None]).any(1).mean()
        same = [len(np.intersect1d(a, b)) / NEAREST for a, b in zip(found, self.exact, strict=True)]
        return float(partners), float(np.mean(same))


@torch.inference_mode()
def described(views: NDArray[np.uint8], encoder: Encoder) -> F32:
    """Unit descriptors (n, N) of packed views."""
    table = code_table(encoder.variant)
    out = []
    for i in range(0, len(views), BATCH):
        with torch.autocast("cpu", dtype=torch.bfloat16):
            mu = encoder(torch.from_numpy(table[views[i : i + BATCH]]))
        out.append(descriptors(mu).numpy())
    return np.concatenate(out)


def rows_of(matches: Matches, queries: int) -> I64:
    """Entries (n, 5) of each query, -1 where it has fewer."""
    out = np.full((queries, NEAREST), -1)
    first = np.searchsorted(matches.query, np.arange(queries))
    out[matches.query, np.arange(len(matches.query)) - first[matches.query]] = matches.entry
    return out


def held_out_search(shards: list[Path], others: list[Path], encoder: Encoder, pairs: int) -> Search:
    """The search in ``shards``, with descriptors of ``others`` as distractors."""
    views = [read_shard(shard) for shard in shards]
    database = np.concatenate([described(complete[:pairs], encoder) for _, _, complete in views])
    incomplete = np.concatenate([described(part[:pairs], encoder) for part, _, _ in views])
    rng = np.random.default_rng(0)
    partner = rng.choice(len(incomplete), min(QUERIES, len(incomplete)), replace=False)
    queries = incomplete[partner]
    distractors = shard_descriptors(others, encoder, pairs).astype(np.float32)
    database = np.concatenate([database, distractors])
    exact = np.concatenate(
        [
            np.argsort(-(queries[i : i + BLOCK] @ database.T), 1)[:, :NEAREST]
            for i in range(0, len(queries), BLOCK)
        ]
    )
    return Search(database, queries, partner, exact)


def measure(search: Search, vocabulary: Vocabulary) -> None:
    """Print recall and time of the look-up by ``vocabulary``."""
    word, code = vocabulary.words(search.database)
    miss = vocabulary.projected(search.database) - vocabulary.children[word // 256, word % 256]
    print(f"  {(miss**2).sum(1).mean():.3f} squared to the centroid of a word")
    index = Index.of_words(vocabulary, word, code, np.zeros(len(word), np.int64))
    # a shortlist of five: ranked by Hamming distance alone, but for ties
    for shortlist in (NEAREST, SHORTLIST):
        index.shortlist = shortlist
        for probes in (1, 4, 8, 16):
            index.search(search.queries[:100], NEAREST, probes, EVERYTHING)
            start = time.process_time()
            matches = index.search(search.queries, NEAREST, probes, EVERYTHING)
            ms = 1e3 * (time.process_time() - start)
            partners, same = search.scores(rows_of(matches, len(search.queries)))
            print(
                f"  probes {probes:2d}, shortlist {shortlist:2d}: "
                f"partner {partners:.3f}, exact {same:.3f}, {ms:.0f} ms"
            )


def main() -> None:
    """The command line."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("shards", type=Path)
    arguments.add_argument("--variant", default="semantic", choices=("semantic", "geometric"))
    arguments.add_argument(
        "--pairs", type=int, default=300, help="pairs of each shard, nine descriptors each"
    )
    arguments.add_argument("--weights", type=Path)
    options = arguments.parse_args()
    shards = sorted(options.shards.glob("*.parquet"))
    encoder = load_encoder(options.variant, options.weights)
    held = len(shards) - len(shards) // 5
    half = held // 2 + 1

    sample = shard_descriptors(shards[:half], encoder, options.pairs)
    search = held_out_search(shards[held:], shards[half:held], encoder, options.pairs)
    print(
        f"{len(sample)} descriptors to train on, {len(search.database)} searched, "
        f"{len(search.queries)} queries"
    )
    print(f"exact: partner {search.scores(search.exact)[0]:.3f}")
    for children in (16, 256):
        start = time.perf_counter()
        vocabulary = train_vocabulary(sample, children=children)
        print(f"256 x {children}: {time.perf_counter() - start:.0f} s to train")
        measure(search, vocabulary)


if __name__ == "__main__":
    main()

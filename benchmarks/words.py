"""What the vocabulary costs: `python benchmarks/words.py SHARDS [--variant semantic] [--pairs
300]`, from packed pairs (`semloc train`).

Of the shards the last fifth is searched: its complete, shifted views are the database, with as many
distractors from other shards, and its incomplete views ask. *partner*: share of queries with the
same place, seen completely, among the five nearest; *exact*: share of the five nearest by
descriptor that are found. Trained on the first half of the shards. Takes some minutes on one core.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch

from semloc_logs.subvolumes.cut import code_table
from semloc_logs.subvolumes.describe import load_encoder
from semloc_logs.subvolumes.network import descriptors
from semloc_logs.training.descriptor_samples import shard_descriptors
from semloc_logs.training.pairs import read_shard
from semloc_logs.words import index as index_module
from semloc_logs.words.vocabulary import train_vocabulary

QUERIES = 5000


@torch.inference_mode()
def described(views, encoder):
    table = code_table(encoder.variant)
    out = []
    for i in range(0, len(views), 16):
        with torch.autocast("cpu", dtype=torch.bfloat16):
            out.append(descriptors(encoder(torch.from_numpy(table[views[i : i + 16]]))).numpy())
    return np.concatenate(out)


def top(matches, n):
    """Entries (n, 5) of each query, -1 where there are fewer."""
    out = np.full((n, 5), -1)
    first = np.searchsorted(matches.query, np.arange(n))
    out[matches.query, np.arange(len(matches.query)) - first[matches.query]] = matches.entry
    return out


def scores(found, exact, partner):
    """Shares found of partners and of the exact five."""
    return (found == partner[:, None]).any(1).mean(), np.mean(
        [len(np.intersect1d(a, b)) / 5 for a, b in zip(found, exact, strict=True)]
    )


def main():
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("shards", type=Path)
    arguments.add_argument("--variant", default="semantic", choices=("semantic", "geometric"))
    arguments.add_argument(
        "--pairs", type=int, default=300, help="pairs of each shard, nine descriptors each"
    )
    arguments.add_argument("--weights", type=Path)
    a = arguments.parse_args()
    shards = sorted(a.shards.glob("*.parquet"))
    encoder = load_encoder(a.variant, a.weights)
    held = len(shards) - len(shards) // 5
    sample = shard_descriptors(shards[: held // 2 + 1], encoder, a.pairs)
    views = [read_shard(s) for s in shards[held:]]
    database = np.concatenate([described(v[2][: a.pairs], encoder) for v in views])
    asked = np.concatenate([described(v[0][: a.pairs], encoder) for v in views])
    partner = np.random.default_rng(0).choice(len(asked), min(QUERIES, len(asked)), replace=False)
    queries = asked[partner]
    others = shard_descriptors(shards[held // 2 + 1 : held], encoder, a.pairs).astype(np.float32)
    database = np.concatenate([database, others])
    exact = np.concatenate(
        [
            np.argsort(-(queries[i : i + 250] @ database.T), 1)[:, :5]
            for i in range(0, len(queries), 250)
        ]
    )
    print(
        f"{len(sample)} descriptors to train on, {len(database)} searched, {len(queries)} queries"
    )
    print(f"exact: partner {scores(exact, exact, partner)[0]:.3f}")
    shortlist = index_module.SHORTLIST
    for children in (16, 256):
        start = time.perf_counter()
        vocabulary = train_vocabulary(sample, children=children)
        word, code = vocabulary.words(database)
        miss = vocabulary.projected(database) - vocabulary.children[word // 256, word % 256]
        said = (
            f"{time.perf_counter() - start:.0f} s to train, {(miss**2).sum(1).mean():.3f}"
            " squared to the centroid of a word"
        )
        print(f"256 x {children}: {said}")
        index = index_module.Index(vocabulary, word, code, np.zeros(len(word), np.int64))
        for size in (5, shortlist):  # five: ranked by Hamming distance alone, but for ties
            index_module.SHORTLIST = size
            for probes in (1, 4, 8, 16):
                index.search(queries[:100], 5, probes, np.ones(1, bool))
                start = time.process_time()
                found = top(index.search(queries, 5, probes, np.ones(1, bool)), len(queries))
                ms = 1e3 * (time.process_time() - start)
                partners, same = scores(found, exact, partner)
                print(
                    f"  probes {probes:2d}, shortlist {size:2d}: partner {partners:.3f}, exact"
                    f" {same:.3f}, {ms:.0f} ms"
                )


if __name__ == "__main__":
    main()

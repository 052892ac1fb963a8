"""FAISS binary indices for `semloc benchmark search`: FOLDER with codes.npy, queries.npy (uint64)
and truth.npy; JSON out.

Needs faiss-cpu and numpy only. Of each index: least and median processor milliseconds of all
look-ups of the five nearest, and the share of queries whose truth is among them.
"""

import json
import sys
import time
from pathlib import Path

import faiss
import numpy as np


def measure(index, queries, truth, repeats):
    index.search(queries[:100], 5)
    taken = []
    for _ in range(repeats):
        start = time.process_time()
        found = index.search(queries, 5)[1]
        taken.append(1e3 * (time.process_time() - start))
    return [min(taken), float(np.median(taken)), float((found == truth[:, None]).any(1).mean())]


def main():
    faiss.omp_set_num_threads(1)
    codes, queries = (
        np.load(Path(sys.argv[1]) / f"{n}.npy").view(np.uint8).reshape(-1, 8)
        for n in ("codes", "queries")
    )
    truth = np.load(Path(sys.argv[1]) / "truth.npy")
    out = {}
    flat = faiss.IndexBinaryFlat(64)
    flat.add(codes)
    out["BinaryFlat"] = measure(flat, queries, truth, 2)
    cells = 256 if len(codes) < 500_000 else 1024
    inverted = faiss.IndexBinaryIVF(faiss.IndexBinaryFlat(64), 64, cells)
    inverted.own_fields = False
    inverted.train(codes[:: max(1, len(codes) // (64 * cells))])
    inverted.add(codes)
    for probes in (8, 32, 128):
        inverted.nprobe = probes
        out[f"BinaryIVF {cells} nprobe {probes}"] = measure(inverted, queries, truth, 3)
    print(json.dumps(out))


if __name__ == "__main__":
    main()

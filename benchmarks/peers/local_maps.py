"""What the runners of `semloc benchmark localisation` share: a job of local maps in, ranked poses
out. Needs numpy only.

FOLDER/NAME.npy are clouds (n, 3), float32, metres, in level frames with x along the drive. A runner
gets the path of a job, {"folder", "database": [NAME], "queries": [{"cloud": NAME, "candidates":
[[number, yaw]]}]}, and prints one line of JSON, {"build_s", "queries": [{"seconds", "found":
[[number, score, 16 numbers of database_T_query]]}]}, best first.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np


def turned(yaw):
    """(4, 4) about z."""
    out = np.eye(4)
    out[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    return out


def thinned(points, cell):
    """The first point of every cell."""
    _, first = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)]


def run(build, answer):
    """``build(clouds)`` makes a database of clouds, ``answer(database, cloud, candidates)`` gives
    (number, score, pose)s.
    """
    job = json.loads(Path(sys.argv[1]).read_text())

    def load(name):
        return np.load(Path(job["folder"]) / f"{name}.npy").astype(np.float64)

    begin = time.perf_counter()
    database = build(load(name) for name in job["database"])
    out = {"build_s": time.perf_counter() - begin, "queries": []}
    for number, query in enumerate([job["queries"][0], *job["queries"]] if job["queries"] else []):
        cloud = load(query["cloud"])
        begin = time.perf_counter()
        found = answer(database, cloud, query["candidates"])
        seconds = time.perf_counter() - begin
        if number:  # the first one warms up
            ranked = sorted(found, key=lambda f: -f[1])[:5]
            out["queries"].append(
                {
                    "seconds": seconds,
                    "found": [[int(k), float(s), np.ravel(T).tolist()] for k, s, T in ranked],
                }
            )
    print(json.dumps(out))


def run_pairs(prepare, register):
    """Candidates one by one: ``register(database_part, query_part, yaw)`` gives score and pose of
    what ``prepare(cloud)`` made.
    """

    def build(clouds):
        return [prepare(cloud) for cloud in clouds]

    def answer(database, cloud, candidates):
        query = prepare(cloud)
        return [(int(k), *register(database[int(k)], query, yaw)) for k, yaw in candidates]

    run(build, answer)

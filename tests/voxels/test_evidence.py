"""Evidence of submaps against a dictionary of voxels; any split and any order of the submaps gives
the same map.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from functools import reduce
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from semloc_logs.voxels.carve import UNOBSERVED
from semloc_logs.voxels.evidence import CELLS, CLASSES, Evidence, Tiles, evidence, merge, resolve
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE, BlockMap, empty_map
from semloc_logs.voxels.keys import morton, pack

LOW, HIGH = -40, 70
Odds = dict[tuple[int, int, int], int]
Votes = Counter[tuple[int, int, int, int]]
Rows = tuple[Odds, Votes]

# eight blocks, voxels at both ends of each
voxels = st.tuples(*[st.integers(-2, 1).map(lambda i: i * 9)] * 3)
rows = st.tuples(
    st.dictionaries(voxels, st.integers(-40, 70), max_size=12),
    st.dictionaries(
        st.tuples(*[st.integers(-2, 1).map(lambda i: i * 9)] * 3, st.sampled_from([0, 2, 8, 255])),
        st.integers(1, 300),
        max_size=12,
    ),
).map(lambda r: (r[0], Counter(r[1])))


def as_evidence(part: Rows) -> Evidence:
    odds, votes = part
    every = {v[:3] for v in (*odds, *votes)}
    keys = np.unique(pack(np.array([[i // 16 for i in v] for v in every]).reshape(-1, 3)))
    place = {
        v: (
            int(np.searchsorted(keys, pack(np.array(v) // 16))),
            (v[0] % 16 * 16 + v[1] % 16) * 16 + v[2] % 16,
        )
        for v in every
    }
    log_odds = np.zeros((len(keys), CELLS), np.int32)
    for v, value in odds.items():
        log_odds[place[v]] = value
    ballots = sorted(
        ((place[(x, y, z)][0] * CELLS + place[(x, y, z)][1]) * CLASSES + c, n)
        for (x, y, z, c), n in votes.items()
    )
    table = np.array(ballots, np.int64).reshape(-1, 2)
    return Evidence(keys, log_odds, table[:, 0], table[:, 1])


def reference(parts: list[Rows]) -> list[tuple[list[int], int, int, int]]:
    """Voxel, class, log-odds, votes of the occupied voxels, in Morton order, from dictionaries."""
    odds: dict[tuple[int, int, int], int] = defaultdict(int)
    votes: dict[tuple[int, int, int], Counter[int]] = defaultdict(Counter)
    for part in parts:
        for v, value in part[0].items():
            odds[v] += value
        for (x, y, z, c), n in part[1].items():
            votes[(x, y, z)][c] += n
    out = []
    for v, total in odds.items():
        if total > 0:
            ranked = sorted(votes[v], key=lambda c, of=votes[v]: (c == 255, -of[c], c))  # type: ignore[misc]
            out.append((list(v), ranked[0] if ranked else 255, min(total, HIGH), votes[v].total()))
    return sorted(out, key=lambda row: int(morton(np.array(row[0]))))


def resolved(evidence_of_voxels: Evidence) -> list[tuple[list[int], int, int, int]]:
    v = resolve(evidence_of_voxels, LOW, HIGH)
    return list(
        zip(v.ijk.tolist(), v.label.tolist(), v.log_odds.tolist(), v.hits.tolist(), strict=True)
    )


def same(a: Evidence, b: Evidence) -> bool:
    return all(
        np.array_equal(getattr(a, n), getattr(b, n))
        for n in ("keys", "log_odds", "ballots", "votes")
    )


@given(st.lists(rows, min_size=1, max_size=5), st.randoms(use_true_random=False))
@settings(max_examples=150)
def test_merging_is_the_sum_in_any_order_and_grouping(parts: list[Rows], random: object) -> None:
    evidences = [as_evidence(p) for p in parts]
    left = reduce(merge, evidences)
    assert resolved(left) == reference(parts)
    shuffled = evidences.copy()
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    while len(shuffled) > 1:  # neighbours first, then pairs of pairs
        shuffled = [reduce(merge, shuffled[i : i + 2]) for i in range(0, len(shuffled), 2)]
    assert same(left, shuffled[0])


def submap(free: list[int], occupied: dict[int, tuple[int, int, int]]) -> BlockMap:
    """One block at the origin: cells that are free (log-odds -8), and cells with (class, log-odds,
    votes).
    """
    log_odds = np.full((1, CELLS), UNOBSERVED, np.int8)
    state = np.full((1, CELLS), UNOBSERVED_STATE, np.uint8)
    log_odds[0, free], state[0, free] = -8, FREE_STATE
    ballots = {}
    for cell, (label, odds, votes) in occupied.items():
        log_odds[0, cell], state[0, cell] = odds, label
        ballots[cell * 256 + label] = votes
    counted = np.array(sorted(ballots.items()), np.int64).reshape(-1, 2)
    return BlockMap(
        np.array([pack(np.zeros(3, int))]), log_odds, state, counted[:, 0], counted[:, 1]
    )


def test_free_in_one_submap_counts_against_occupied_in_another(tmp_path: Path) -> None:
    a = submap([5], {0: (13, 7, 2), 1: (2, 70, 9), 2: (2, 10, 4), 3: (255, 10, 50)})
    b = submap([0, 1], {2: (8, 10, 5), 3: (8, 10, 1)})
    tiles = Tiles(tmp_path, 256)
    tiles.add(a)
    tiles.add(b)
    assert tiles.names() == {(0, 0)}
    # 7 - 8 is free; 70 - 8; two classes, of which 8 has more votes; a known class beats any number
    # of unlabelled votes
    assert resolved(tiles.take((0, 0))) == [
        ([0, 0, 1], 2, 62, 9),
        ([0, 0, 2], 8, 20, 9),
        ([0, 0, 3], 8, 20, 51),
    ]


def test_tiles_go_to_disk_and_come_back_and_do_not_grow(tmp_path: Path) -> None:
    """A car that circles: submaps here, there, here, there ... need as much room as one round."""
    rng = np.random.default_rng(0)

    def seen(x: int) -> BlockMap:
        keys = pack(np.array([[16 * x + i, 0, 0] for i in range(3)]))
        log_odds = rng.integers(-40, 70, (3, CELLS)).astype(np.int8)
        state = np.where(log_odds > 0, rng.integers(0, 19, (3, CELLS)), FREE_STATE).astype(np.uint8)
        voxel = np.flatnonzero(log_odds > 0)
        return BlockMap(
            keys, log_odds, state, voxel * 256 + state.reshape(-1)[voxel], np.full(len(voxel), 3)
        )

    tiles = Tiles(tmp_path, 256)
    sizes = []
    every = []
    for _ in range(8):
        for x in (0, -1, 4):
            every.append((x, seen(x)))
            tiles.add(every[-1][1])
        assert len(tiles._open) == 1
        sizes.append(sum(p.stat().st_size for p in tmp_path.iterdir()))
    assert tiles.names() == {(0, 0), (-1, 0), (4, 0)}
    # classes are random here, so each round may add votes of a new one until all 19 have some
    assert sizes[-1] < 2.5 * sizes[1]
    for x in (0, -1, 4):
        parts = [
            part for tile_x, blocks in every if tile_x == x for _, part in evidence(blocks, 256)
        ]
        assert same(tiles.take((x, 0)), reduce(merge, parts))
    assert not list(tmp_path.iterdir())


def test_no_evidence() -> None:
    assert list(evidence(empty_map(), 256)) == []
    nothing = as_evidence(({}, Counter()))
    assert resolved(nothing) == []
    some = as_evidence(({(0, 0, 0): 5}, Counter()))
    assert same(merge(nothing, some), some)
    assert resolved(some) == [([0, 0, 0], 255, 5, 0)]

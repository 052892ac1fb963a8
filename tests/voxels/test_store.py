from __future__ import annotations

from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import polars as pl
import pyarrow.parquet as pq
import pytest

from semloc_logs.errors import WorkspaceError
from semloc_logs.settings import Settings
from semloc_logs.tables.table import read_metadata
from semloc_logs.voxels.carve import UNOBSERVED
from semloc_logs.voxels.grid import FREE_STATE, BlockMap, Fuser, empty_map
from semloc_logs.voxels.keys import morton, pack, unpack
from semloc_logs.voxels.store import (
    PART,
    TILE,
    Keyframe,
    keep_keyframes,
    part_path,
    pose_columns,
    poses_of,
    read_blocks,
    read_keyframe,
    write_blocks,
    write_voxels,
)

METADATA: dict[str, Any] = {
    "schema_version": 1,
    "voxel_size": 0.5,
    "session_T_map": np.eye(4).tolist(),
    "label_space": "cityscapes",
    "label_source": "log",
    "version": "1",
}


def small_map(
    seed: int, shift: tuple[float, float, float] = (0.0, 0.0, 0.0), frames: int = 3
) -> BlockMap:
    rng = np.random.default_rng(seed)
    fuser = Fuser(
        Settings.model_validate({"fusion": {"voxel_size": 0.5, "max_range": 60.0}})
        .resolved()
        .fusion
    )
    for _ in range(frames):
        points = rng.uniform(-12, 12, (300, 3)) * [1, 1, 0.2]
        fuser.add(
            points + shift, rng.choice(np.array([0, 2, 8, 255], np.uint8), 300), np.array(shift)
        )
    return fuser.finish()


@pytest.mark.parametrize(
    "blocks",
    [small_map(0), small_map(1, (-300.0, 500.0, 20.0)), empty_map()],
    ids=["here", "there", "empty"],
)
def test_blocks_come_back_exactly(blocks: BlockMap, tmp_path: Path) -> None:
    path = tmp_path / "submap.parquet"
    write_blocks(path, blocks, METADATA)
    read = read_blocks(path)
    for name in ("keys", "log_odds", "state", "ballots", "votes"):
        a = getattr(blocks, name)
        b = getattr(read, name)
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype
    assert not len(read_blocks(path, states_only=True).ballots)
    np.testing.assert_array_equal(read_blocks(path, states_only=True).state, blocks.state)
    assert read.bounds()[0].tolist() == blocks.bounds()[0].tolist()
    assert read_metadata(path) == METADATA


def test_keyframes_come_back_to_the_grid_of_2_mm_each_in_its_row_group(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    sizes = [5, 0, 7, 1]  # a keyframe without points keeps its place
    frames = [
        Keyframe(
            rng.uniform(-80, 80, (n, 3)).astype(np.float32), rng.integers(0, 19, n).astype(np.uint8)
        )
        for n in sizes
    ]
    passed = list(keep_keyframes(tmp_path, [10**18 + i for i in range(4)], frames, METADATA))
    path = part_path(tmp_path, 0)
    assert pq.ParquetFile(path).num_row_groups == 4
    for i, (frame, kept) in enumerate(zip(frames, passed, strict=True)):
        read = read_keyframe(tmp_path, i)
        np.testing.assert_array_equal(read.label, frame.label)
        assert read.points.shape == frame.points.shape
        np.testing.assert_allclose(read.points, frame.points, atol=1 / 1024 + 1e-6)
        # the result equals the stored keyframe
        np.testing.assert_array_equal(read.points, kept.points)
        again = tmp_path / "again"
        again.mkdir(exist_ok=True)
        list(keep_keyframes(again, [0], [read], METADATA))
        # what lies on the grid is kept exactly
        np.testing.assert_array_equal(read_keyframe(again, 0).points, read.points)
    table = pq.read_table(path)
    assert table["keyframe"].to_pylist() == [0] * 5 + [2] * 7 + [3]
    assert table["stamp_ns"].to_pylist()[-1] == 10**18 + 3
    assert read_metadata(path) == METADATA


def test_keyframes_are_in_parts_of_64(tmp_path: Path) -> None:
    one = Keyframe(np.ones((1, 3), np.float32), np.zeros(1, np.uint8))
    assert (
        len(
            list(
                keep_keyframes(
                    tmp_path, range(2 * PART + 1), (one for _ in range(2 * PART + 1)), METADATA
                )
            )
        )
        == 2 * PART + 1
    )
    assert [pq.ParquetFile(p).num_row_groups for p in sorted(tmp_path.iterdir())] == [PART, PART, 1]
    assert pq.read_table(part_path(tmp_path, 2 * PART))["keyframe"].to_pylist() == [2 * PART]


def test_the_uncertainty_of_ranges_comes_back_where_there_is_any(tmp_path: Path) -> None:
    points = np.ones((3, 3), np.float32)
    label = np.zeros(3, np.uint8)
    frames = [
        Keyframe(points, label, np.array([0.0, 0.25, 2.0], np.float32)),
        Keyframe(points, label),
    ]
    list(keep_keyframes(tmp_path, [1, 2], frames, METADATA))
    sigma = read_keyframe(tmp_path, 0).sigma
    assert sigma is not None
    assert sigma.tolist() == [0.0, 0.25, 2.0]
    assert read_keyframe(tmp_path, 1).sigma is None
    keyframe = Keyframe(np.array([[1, 0, 0], [9, 0, 0]], np.float32), label[:2], sigma[:2]).near(
        np.array([2.0, 0, 0]), 3.0
    )
    assert (keyframe.points.tolist(), keyframe.label.tolist()) == ([[1, 0, 0]], [0])


def test_missing_and_damaged_keyframes_and_blocks_are_refused(tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match="overwrite"):
        read_keyframe(tmp_path, 0)
    list(
        keep_keyframes(
            tmp_path, [1], [Keyframe(np.ones((4, 3), np.float32), np.zeros(4, np.uint8))], METADATA
        )
    )
    with pytest.raises(WorkspaceError, match="overwrite"):
        read_keyframe(tmp_path, 1)  # beyond the last
    content = part_path(tmp_path, 0).read_bytes()
    for damaged in (content[:-30], content[: len(content) // 2], b"", b"PAR1" * 10):
        part_path(tmp_path, 0).write_bytes(damaged)
        with pytest.raises(WorkspaceError, match="overwrite"):
            read_keyframe(tmp_path, 0)
        with pytest.raises(WorkspaceError, match="overwrite"):
            read_blocks(part_path(tmp_path, 0))


def test_poses_as_columns() -> None:
    poses = np.stack([np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0])])
    poses[1, :3, 3] = [1, 2, 3]
    columns = pose_columns(poses)
    assert columns["t_y"].tolist() == [0, 2]
    assert columns["q_w"].tolist() == [1, 0]
    assert abs(columns["q_z"][1]) == 1
    import pyarrow as pa

    np.testing.assert_allclose(poses_of(pa.table(columns)), poses, atol=1e-15)
    assert [len(v) for v in pose_columns(np.zeros((0, 4, 4))).values()] == [0] * 7


CLAMP = (-2.0, 2.0)


def union(submaps: list[BlockMap]) -> dict[tuple[int, ...], tuple[int, int, int]]:
    """Of each voxel all evidence added up: (class, log-odds in 1/20, votes) where more speaks for
    occupied than for free.
    """
    odds: dict[tuple[int, ...], int] = defaultdict(int)
    votes: dict[tuple[int, ...], Counter[int]] = defaultdict(Counter)
    for blocks in submaps:
        corners = unpack(blocks.keys).tolist()

        def voxel_at(row: int, cell: int, corners: list[list[int]] = corners) -> tuple[int, ...]:
            return tuple(
                k * 16 + i
                for k, i in zip(
                    corners[row], (cell // 256, cell // 16 % 16, cell % 16), strict=True
                )
            )

        for row, log_odds in enumerate(blocks.log_odds):
            for cell in np.flatnonzero(log_odds != UNOBSERVED).tolist():
                odds[voxel_at(row, cell)] += int(log_odds[cell])
        for ballot, count in zip(blocks.ballots.tolist(), blocks.votes.tolist(), strict=True):
            votes[voxel_at(ballot // 2**20, ballot // 256 % 4096)][ballot % 256] += count
    out = {}
    for voxel in (v for v, total in odds.items() if total > 0):
        known = {c: n for c, n in votes[voxel].items() if c != 255}
        label = min(known, key=lambda c, of=known: (-of[c], c)) if known else 255  # type: ignore[misc]
        out[voxel] = (label, min(odds[voxel], 40), votes[voxel].total())
    return out


def test_the_session_map_is_the_union_of_overlapping_submaps(tmp_path: Path) -> None:
    submaps = [small_map(0), small_map(1, (6.0, 0.0, 0.0), 6), small_map(2, (-6.0, 300.0, 0.0))]
    expected = union(submaps)
    lost = {tuple(v) for s in submaps for v in s.occupied()[0].tolist()} - set(expected)
    assert len(lost) > 10  # occupied in one, carved free in the other
    assert max(odds for _, odds, _ in expected.values()) == 40
    assert len(expected) + len(lost) < sum(len(s.occupied()[0]) for s in submaps)  # they do overlap
    folder = tmp_path / "voxels"
    assert write_voxels(folder, submaps, METADATA, CLAMP) == len(expected)
    tiles = sorted(folder.rglob("*.parquet"))
    assert len(tiles) > 3
    voxels: dict[tuple[int, ...], tuple[int, int, int]] = {}
    for path in tiles:
        table = pq.ParquetFile(path).read()
        assert read_metadata(path) == METADATA
        ijk = np.stack([table[c].to_numpy() for c in ("ix", "iy", "iz")], 1)
        assert (np.diff(morton(ijk).astype(np.int64)) > 0).all()  # Morton order, none twice
        assert len(np.unique(ijk[:, :2] // TILE, axis=0)) == 1
        odds = np.rint(table["occupancy"].to_numpy() * 20).astype(int)
        for k, *v in zip(
            ijk.tolist(),
            table["label"].to_pylist(),
            odds.tolist(),
            table["hits"].to_pylist(),
            strict=True,
        ):
            assert tuple(k) not in voxels
            voxels[tuple(k)] = tuple(v)
    assert voxels == expected
    assert not list(tmp_path.rglob(".*"))


def test_the_session_map_in_duckdb_and_polars(tmp_path: Path) -> None:
    submaps = [small_map(0), small_map(1, (140.0, 0.0, 0.0))]
    total = write_voxels(tmp_path / "voxels", submaps, METADATA, CLAMP)
    expected = union(submaps).values()
    mean = np.mean([odds / 20 for _, odds, _ in expected])
    rows = (
        duckdb.connect()
        .execute(
            f"select count(*), avg(occupancy), sum(hits) from '{tmp_path}/voxels/**/*.parquet'"
        )
        .fetchall()
    )
    assert rows[0][0] == total
    assert rows[0][1] == pytest.approx(mean, rel=1e-6)
    assert rows[0][2] == sum(h for *_, h in expected)
    frame = pl.read_parquet(f"{tmp_path}/voxels/**/*.parquet")
    assert frame.height == total
    assert frame.schema["ix"] == pl.Int32
    assert frame.schema["label"] == pl.UInt8
    assert frame["occupancy"].mean() == pytest.approx(mean, rel=1e-6)


def plain(width: int) -> BlockMap:
    """A level floor of ``width`` x ``width`` voxels, one voxel thick."""
    n = width // 16
    blocks = np.stack(np.meshgrid(np.arange(n), np.arange(n), [0], indexing="ij"), -1).reshape(
        -1, 3
    )
    state = np.full((len(blocks), 4096), FREE_STATE, np.uint8)
    state[:, ::16] = 0
    ballots = np.flatnonzero(state.ravel() == 0) * 256
    return BlockMap(
        pack(blocks),
        np.where(state == 0, 20, -8).astype(np.int8),
        state,
        ballots,
        np.ones(len(ballots), np.int64),
    )


def test_a_bounding_box_reads_few_row_groups(tmp_path: Path) -> None:
    """By the statistics alone: other files and other row groups are not read; DuckDB and Arrow find
    the same rows.
    """
    assert write_voxels(tmp_path / "voxels", [plain(512)], METADATA, CLAMP) == 512 * 512
    import pyarrow.dataset as ds

    data = ds.dataset(tmp_path / "voxels", partitioning="hive")
    box = (
        (ds.field("ix") >= 100)
        & (ds.field("ix") < 167)
        & (ds.field("iy") >= 300)
        & (ds.field("iy") < 367)
    )
    every = [g for f in data.get_fragments() for g in f.split_by_row_group()]
    read = [g for f in data.get_fragments(box) for g in f.split_by_row_group(box)]
    assert len(every) == 4 * 256 * 256 // 16384
    # each is a square of 128 x 128 voxels; the box lies in x over one border of them
    assert len(read) <= 2
    assert max(g.row_groups[0].num_rows for g in every) <= 16384
    table = data.to_table(filter=box)
    query = (
        f"SELECT * FROM '{tmp_path}/voxels/**/*.parquet' "
        "WHERE ix BETWEEN 100 AND 166 AND iy BETWEEN 300 AND 366"
    )
    rows = duckdb.connect().execute(query).fetchall()
    assert len(rows) == table.num_rows == 67 * 67
    assert {r[:2] for r in rows} == set(
        zip(table["ix"].to_pylist(), table["iy"].to_pylist(), strict=True)
    )
    assert {d.name for d in (tmp_path / "voxels").iterdir()} == {
        f"tile={x}_{y}" for x in (0, 1) for y in (0, 1)
    }


@pytest.mark.parametrize("submaps", [[], [empty_map()], "free only"])
def test_a_session_map_without_voxels_is_a_table_without_rows(submaps: Any, tmp_path: Path) -> None:
    if submaps == "free only":
        fuser = Fuser(Settings().resolved().fusion)
        fuser.add(np.array([[500.0, 0, 0]]), np.zeros(1, np.uint8), np.zeros(3))
        submaps = [fuser.finish()]
        assert (submaps[0].state == FREE_STATE).any()
    assert write_voxels(tmp_path / "voxels", submaps, METADATA, CLAMP) == 0
    assert duckdb.connect().execute(
        f"select count(*) from '{tmp_path}/voxels/**/*.parquet'"
    ).fetchall() == [(0,)]
    assert read_metadata(next((tmp_path / "voxels").rglob("*.parquet"))) == METADATA


def test_writing_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_voxels(
            tmp_path / name, [small_map(0), small_map(1, (140.0, 0.0, 0.0))], METADATA, CLAMP
        )
        write_blocks(tmp_path / f"{name}.parquet", small_map(0), METADATA)
    a = {p.relative_to(tmp_path / "a"): p.read_bytes() for p in (tmp_path / "a").rglob("*.parquet")}
    b = {p.relative_to(tmp_path / "b"): p.read_bytes() for p in (tmp_path / "b").rglob("*.parquet")}
    assert a == b
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()

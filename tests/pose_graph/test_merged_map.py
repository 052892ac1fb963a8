"""Two drives past hand-made walls: one map, and the voxels that are gone or new."""

from typing import Any

import numpy as np
import pytest

from semloc_logs.errors import WorkspaceError
from semloc_logs.numerics.transforms import apply, inverse, yaw_transform
from semloc_logs.settings import load
from semloc_logs.stages.optimise import merge_maps, optimise
from semloc_logs.tables.table import read_json, read_table, write_json
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE, BlockMap
from semloc_logs.voxels.keys import BLOCK, pack
from semloc_logs.voxels.store import blocks_path, write_blocks

pytest.importorskip("gtsam")
VOXEL = 0.3
WALL = 2  # Cityscapes building
CAR = 13


def _write_submap(drives: Any, name: str, classes: dict[tuple[int, int, int], int]) -> None:
    """One submap: 4 x 4 x 1 blocks of free space in the common frame, with occupied ``classes``.

    Voxels are given in the common frame; the session has them in its own map frame.
    """
    common = np.stack(np.meshgrid(*(np.arange(n) for n in (64, 64, 16)), indexing="ij"), -1)
    common = common.reshape(-1, 3)
    value = np.full(len(common), FREE_STATE, np.uint8)
    for voxel, label in classes.items():
        value[(common == voxel).all(1)] = label
    map_T_common = inverse(drives.true[name][0])
    own = np.floor(apply(map_T_common, (common + 0.5) * VOXEL) / VOXEL).astype(np.int64)
    block_of = pack(own // BLOCK)
    keys = np.unique(block_of)
    state = np.full((len(keys), BLOCK**3), UNOBSERVED_STATE, np.uint8)
    inner = own % BLOCK
    cell = (inner[:, 0] * BLOCK + inner[:, 1]) * BLOCK + inner[:, 2]
    state[np.searchsorted(keys, block_of), cell] = value
    nothing = np.zeros(0, np.int64)
    blocks = BlockMap(keys, np.zeros(state.shape, np.int8), state, nothing, nothing)
    folder = drives.work.session(name)
    write_blocks(blocks_path(folder.blocks, 0), blocks, {"schema_version": 1})
    last = len(drives.true[name]) - 1
    submaps = [{"id": 0, "first": 0, "last": last}]
    write_json(folder.session_json, read_json(folder.session_json) | {"submaps": submaps})


def _voxels(table: Any) -> list[tuple[int, int, int]]:
    return [*zip(*(table[c].to_pylist() for c in ("ix", "iy", "iz")), strict=True)]


def test_a_car_that_left_and_a_wall_that_was_built_are_changes(drives: Any, square_of: Any) -> None:
    drives.add("may", square_of(1), 0.0, 1.0)
    # June starts elsewhere and faces another way
    drives.add("june", yaw_transform(np.pi / 2, (30.0, 0.0, 0.0)) @ square_of(1), 0.0, 1.0)
    may_T_june = inverse(drives.true["may"][0]) @ drives.true["june"][0]
    assert may_T_june[0, 3] == pytest.approx(30.0)
    drives.close([("june", k, "may", k, None) for k in range(0, 400, 40)])
    both = {(5, 20, 2): WALL, (5, 21, 2): WALL}
    _write_submap(drives, "may", both | {(40, 40, 1): CAR, (20, 5, 3): WALL})
    # the wall that May saw at x = 20 is a voxel farther: the same wall
    _write_submap(drives, "june", both | {(50, 10, 4): WALL, (21, 5, 3): WALL})
    optimise(drives.work, load().resolved())
    (merged,) = merge_maps(drives.work)
    # frames are called after the first session by name, and have its map frame
    assert merged.frame == "june"
    assert (merged.voxels, merged.changed) == (4, 2)

    tiles = sorted(drives.work.merged_map("june").rglob("*.parquet"))
    rows = [row for path in tiles for row in read_table(path).to_pylist()]
    june_T_common = inverse(drives.true["june"][0])

    def own(voxel: tuple[int, int, int]) -> tuple[int, int, int]:
        point = apply(june_T_common, (np.array([voxel]) + 0.5) * VOXEL)[0]
        x, y, z = np.floor(point / VOXEL).astype(int).tolist()
        return x, y, z

    by_voxel = {(row["ix"], row["iy"], row["iz"]): row for row in rows}
    assert set(by_voxel) == {own(v) for v in [*both, (50, 10, 4), (21, 5, 3)]}
    wall = by_voxel[own((5, 20, 2))]
    assert (wall["label"], wall["sessions"], wall["session"]) == (WALL, 2, "june")

    changes = read_table(drives.work.changed_voxels("june"))
    change_of = dict(zip(_voxels(changes), changes.to_pylist(), strict=True))
    assert set(change_of) == {own((40, 40, 1)), own((50, 10, 4))}
    car = change_of[own((40, 40, 1))]
    assert (car["label"], car["change"]) == (CAR, "gone")
    assert (car["occupied_session"], car["free_session"]) == ("may", "june")
    built = change_of[own((50, 10, 4))]
    assert (built["label"], built["change"]) == (WALL, "appeared")
    assert (built["occupied_session"], built["free_session"]) == ("june", "may")


def test_voxels_of_two_sizes_do_not_make_one_map(drives: Any, square_of: Any) -> None:
    for name in ("a", "b", "c"):
        drives.add(name, square_of(1), 0.0, 1.0)
        _write_submap(drives, name, {(5, 20, 2): WALL})
    path = drives.work.session("b").session_json
    write_json(path, read_json(path) | {"voxel_size": 0.1})
    drives.close([("c", 0, "a", 0, None)])
    optimise(drives.work, load().resolved())
    merged = merge_maps(drives.work)  # b has a frame of its own
    assert [one.frame for one in merged] == ["a", "b"]
    drives.close([("b", 0, "a", 0, None)])
    optimise(drives.work, load().resolved())
    with pytest.raises(WorkspaceError, match=r"voxels of 0\.1, 0\.3 m"):
        merge_maps(drives.work)

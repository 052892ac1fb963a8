from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from semloc_logs.errors import ContractError, WorkspaceError
from semloc_logs.schemas import read_text
from semloc_logs.tables import contracts
from semloc_logs.tables.table import read_json, read_metadata, read_table, write_json, write_table


def columns(n: int = 3) -> dict[str, object]:
    return {
        "submap": np.arange(n),
        "variant": ["geometric"] * n,
        **{c: np.arange(n) * 1.5 for c in "xyz"},
        "yaw": np.zeros(n),
        "word": np.arange(n),
        "code": np.full(n, 2**64 - 1, np.uint64),
    }


@pytest.mark.parametrize("rows", [0, 3])
def test_tables_come_back_with_their_metadata(rows: int, tmp_path: Path) -> None:
    path = tmp_path / "words.parquet"
    table = contracts.table("words", columns(rows))
    write_table(path, table, {"b": [1, 2], "a": "ü"}, ("submap",))
    read = read_table(path)
    assert read.schema.equals(contracts.schema("words"))
    assert read.num_rows == rows
    assert read.to_pydict() == table.to_pydict()
    assert read_table(path, ["word", "x"]).column_names == ["word", "x"]
    assert read_metadata(path) == {"a": "ü", "b": [1, 2]}
    plain = tmp_path / "plain"
    plain.touch()
    assert path.stat().st_mode == plain.stat().st_mode  # no private file


def test_writing_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_table(
            tmp_path / name,
            contracts.table("words", columns(1000)),
            {"z": 1, "a": {"d": 1, "c": 2}},
            ("submap",),
        )
        write_json(tmp_path / f"{name}.json", {"z": 1, "a": [1.5, None]})
    write_json(tmp_path / "c.json", {"a": [1.5, None], "z": 1})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert (
        (tmp_path / "a.json").read_bytes()
        == (tmp_path / "b.json").read_bytes()
        == (tmp_path / "c.json").read_bytes()
    )
    assert read_json(tmp_path / "a.json") == {"a": [1.5, None], "z": 1}


def test_missing_and_damaged_files_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "words.parquet"
    for read in (read_table, read_metadata, read_json):
        with pytest.raises(WorkspaceError, match=r"words\.parquet"):
            read(path)
    write_table(path, contracts.table("words", columns(1000)), {})
    whole = path.read_bytes()
    with pytest.raises(WorkspaceError, match=r"words\.parquet"):
        read_table(path, ["no such column"])
    for damaged in (b"", b"PAR1PAR1", whole[:-9], whole[: len(whole) // 2], os.urandom(200)):
        path.write_bytes(damaged)
        for read in (read_table, read_metadata, read_json):
            with pytest.raises(WorkspaceError, match=r"words\.parquet"):
                read(path)
    pq.write_table(pa.table({"a": [1]}), path)
    with pytest.raises(WorkspaceError, match="metadata"):
        read_metadata(path)
    (tmp_path / "list.json").write_text("[1]")
    with pytest.raises(WorkspaceError, match=r"list\.json"):
        read_json(tmp_path / "list.json")


def test_every_contract_is_a_schema() -> None:
    assert set(contracts.tables()) >= {
        "blocks",
        "closures",
        "frames",
        "keyframes",
        "rejected",
        "trajectory",
        "voxels",
        "words",
    }
    for name in contracts.tables():
        assert contracts.contract(name)["version"] == 1
        assert len(contracts.schema(name).names) == len(set(contracts.schema(name).names))
        assert read_text(f"parquet/{name}.json").endswith("}\n")


def test_the_columns_of_closures_are_those_promised() -> None:
    names = (
        "query_session target_session query_stamp_ns target_stamp_ns t_x t_y t_z q_x q_y q_z q_w "
    )
    names += "covariance overlap probability inliers words"
    schema = contracts.schema("closures")
    assert schema.names == names.split()
    assert schema.field("covariance").type == pa.list_(pa.float64(), 36)
    assert [
        str(schema.field(n).type) for n in ("query_stamp_ns", "t_x", "probability", "inliers")
    ] == [
        "int64",
        "double",
        "double",
        "int32",
    ]


@pytest.mark.parametrize(
    "change",
    [
        {"extra": [1, 2, 3]},
        {"word": None},
        {"word": [1, 2]},
        {"word": [1, 2, 70000]},
        {"word": [1, -1, 2]},
        {"x": ["a", "b", "c"]},
    ],
)
def test_columns_that_break_the_contract_are_refused(change: dict[str, object]) -> None:
    broken = columns() | change
    broken = {k: v for k, v in broken.items() if v is not None}
    with pytest.raises(ContractError, match="words"):
        contracts.table("words", broken)

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from semloc_logs.errors import ContractError, WorkspaceError
from semloc_logs.schemas import read_text
from semloc_logs.tables import contracts
from semloc_logs.tables.table import (
    read_json,
    read_metadata,
    read_table,
    replacing_file,
    replacing_folder,
    write_json,
    write_table,
)


def leftovers(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir() if p.name.startswith("."))


def test_a_file_is_replaced_at_the_end_of_the_block(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "er" / "file"
    for content in ("old", "new"):
        with replacing_file(path) as temporary:
            temporary.write_text(content)
            assert not path.exists() or path.read_text() == "old"
        assert path.read_text() == content
    assert not leftovers(path.parent)


def test_an_exception_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old")

    def half() -> None:
        with replacing_file(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        half()
    assert path.read_text() == "old"
    assert not leftovers(tmp_path)


def test_a_folder_is_replaced_as_a_whole(tmp_path: Path) -> None:
    path = tmp_path / "folder"
    for n in (3, 2):
        with replacing_folder(path) as temporary:
            (temporary / "sub").mkdir()
            for i in range(n):
                (temporary / "sub" / f"{i}").write_text(f"{n}")
        assert sorted(p.name for p in (path / "sub").iterdir()) == [str(i) for i in range(n)]
    assert not leftovers(tmp_path)


def test_an_exception_leaves_the_old_folder(tmp_path: Path) -> None:
    path = tmp_path / "folder"
    path.mkdir()
    (path / "a").write_text("old")

    def half() -> None:
        with replacing_folder(path) as temporary:
            (temporary / "a").write_text("half")
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        half()
    assert (path / "a").read_text() == "old"
    assert not leftovers(tmp_path)


def test_what_a_killed_run_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a[1]"  # no pattern
    for name in (".a[1].0badcafe.tmp", ".a[1].0badcafe.old.tmp", ".other.0badcafe.tmp", "a[1].tmp"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "x").write_text("x")
    with replacing_folder(path) as temporary:
        (temporary / "x").write_text("new")
    assert leftovers(tmp_path) == [".other.0badcafe.tmp"]
    assert sorted(p.name for p in tmp_path.iterdir() if p.name[0] != ".") == ["a[1]", "a[1].tmp"]


WRITER = """
import sys
from pathlib import Path
from semloc_logs.tables.table import replacing_file, replacing_folder
root = Path(sys.argv[1])
print("ready", flush=True)
n = 0
while True:
    n += 1
    with replacing_file(root / "file") as temporary:
        temporary.write_text(f"{n}\\n" * 2000)
    with replacing_folder(root / "folder") as temporary:
        for i in range(5):
            (temporary / f"{i}").write_text(f"{n}\\n" * 500)
"""


@pytest.mark.parametrize("wait", [0.02, 0.11])
def test_a_kill_leaves_old_or_new_but_never_half(wait: float, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    while not (tmp_path / "folder").exists():
        time.sleep(0.005)
    time.sleep(wait)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    lines = (tmp_path / "file").read_text().splitlines()
    assert len(lines) == 2000
    assert len(set(lines)) == 1
    if (tmp_path / "folder").exists():  # between the two renames there is none
        contents = [p.read_text() for p in sorted((tmp_path / "folder").iterdir())]
        assert len(contents) == 5
        assert len(set(contents)) == 1
        assert contents[0].count("\n") == 500
    with replacing_folder(tmp_path / "folder") as temporary:
        (temporary / "0").write_text("after")
    assert [p.name for p in (tmp_path / "folder").iterdir()] == ["0"]
    assert not [name for name in leftovers(tmp_path) if name.startswith(".folder")]


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
    found = read_table(path)
    assert found.schema.equals(contracts.schema("words"))
    assert found.num_rows == rows
    assert found.to_pydict() == table.to_pydict()
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

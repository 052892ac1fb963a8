"""The macro of the guide gives voxels in metres, with classes and sessions."""

import re
from pathlib import Path

import pytest

from semloc_logs.labels.space import cityscapes
from semloc_logs.tables import contracts
from semloc_logs.tables.table import write_table

PAGE = Path(__file__).resolve().parents[2] / "docs/how_to/tables.md"


def _macro() -> str:
    (statement,) = re.findall(r"CREATE OR REPLACE MACRO.*?;", PAGE.read_text(), re.DOTALL)
    return str(statement)


def _write(path: Path, size: float, label: int) -> None:
    columns = {
        "ix": [0],
        "iy": [-2],
        "iz": [3],
        "label": [label],
        "occupancy": [1.0],
        "hits": [4],
    }
    metadata = {"schema_version": 1, "voxel_size": size}
    write_table(path, contracts.table("voxels", columns), metadata)


def test_voxels_in_metres_with_their_session_and_class(tmp_path: Path) -> None:
    duckdb = pytest.importorskip("duckdb")
    for name, size, label in (("monday", 0.5, 8), ("room", 0.05, 255)):
        _write(tmp_path / f"sessions/{name}/voxels/tile=0_0/part-0.parquet", size, label)
    connection = duckdb.connect()
    connection.execute(_macro())
    files = tmp_path / "sessions/*/voxels/**/*.parquet"
    rows = connection.execute(
        f"SELECT session, x, y, z, class FROM voxels('{files}') ORDER BY session"
    ).fetchall()
    assert rows[0] == ("monday", 0.25, -0.75, 1.75, "vegetation")
    assert rows[1][0::4] == ("room", "unlabelled")
    assert rows[1][1:4] == pytest.approx((0.025, -0.075, 0.175))
    target = tmp_path / "by_session"
    connection.execute(
        f"COPY (SELECT * FROM voxels('{files}')) TO '{target}'"
        " (FORMAT parquet, PARTITION_BY (session))"
    )
    assert sorted(p.name for p in target.iterdir()) == ["session=monday", "session=room"]


def test_the_macro_names_all_classes() -> None:
    names = re.findall(r"'([a-z ]+)'", _macro())
    classes = cityscapes().names
    start = names.index("road")
    assert names[start : start + len(classes)] == list(classes)

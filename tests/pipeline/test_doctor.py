"""`doctor`: each kind of damage is named with its file and with what mends it."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from semloc_logs.stages.doctor import examine
from semloc_logs.tables.table import read_json, write_json
from semloc_logs.workspace import Workspace

MONDAY = "sessions/monday/"


def cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-200])


def without_a_column(path: Path) -> None:
    table = pq.read_table(path, partitioning=None)
    pq.write_table(table.drop_columns([table.column_names[0]]), path)


def without_a_row(path: Path) -> None:
    table = pq.read_table(path, partitioning=None)
    pq.write_table(table.slice(1), path)


def with_another_type(path: Path) -> None:
    table = pq.read_table(path, partitioning=None)
    pq.write_table(table.set_column(0, table.column_names[0], table[0].cast(pa.string())), path)


def of_another_decision(path: Path) -> None:
    table = pq.read_table(path, partitioning=None)
    metadata = json.loads(table.schema.metadata[b"semloc"]) | {"fingerprint": "0" * 16}
    pq.write_table(table.replace_schema_metadata({"semloc": json.dumps(metadata)}), path)


def of_another_map(path: Path) -> None:
    write_json(path, read_json(path) | {"fingerprint": "0" * 16})


def without_settings(path: Path) -> None:
    write_json(path, {})


def test_a_whole_workspace_has_no_faults(coarse: Workspace) -> None:
    result = examine(coarse)
    assert result.findings == ()
    tables = len(list(coarse.path.rglob("*.parquet")))
    assert result.files == tables
    assert result.rows > 1000


@pytest.mark.parametrize(
    ("file", "damage", "fault", "remedy"),
    [
        (
            MONDAY + "frames.parquet",
            cut_off,
            "cannot be read",
            "fuse .*monday.* --over",
        ),
        (MONDAY + "frames.parquet", Path.unlink, "is missing", "fuse .*monday.*"),
        (
            MONDAY + "trajectory.parquet",
            without_a_column,
            "column stamp_ns",
            "fuse .*monday",
        ),
        (
            MONDAY + "trajectory.parquet",
            with_another_type,
            "column stamp_ns is not there as int64",
            "fuse .*monday",
        ),
        (MONDAY + "frames.parquet", without_a_row, "rows are there of", "fuse .*monday.*"),
        (MONDAY + "session.json", cut_off, "cannot be read", "fuse LOG"),
        (MONDAY + "words.json", of_another_map, "of another map", "describe monday"),
        (
            MONDAY + "words/submap-00000.parquet",
            cut_off,
            "cannot be read",
            "describe monday",
        ),
        (
            "alignments/query=tuesday/target=monday/alignments.parquet",
            Path.unlink,
            "tuesday was not searched in monday",
            "semloc close",
        ),
        (
            "alignments/query=tuesday/target=monday/alignments.parquet",
            cut_off,
            "damaged",
            "semloc close",
        ),
        ("workspace.json", without_settings, "of another version", "rm .*workspace.json$"),
        ("closures.parquet", cut_off, "cannot be read", "semloc close .* --overwrite"),
        ("rejected.parquet", Path.unlink, "is missing", "semloc close .* --overwrite"),
        ("closures.parquet", of_another_decision, "was not decided from", "semloc close -w"),
    ],
)
def test_damage_is_named_with_what_mends_it(
    coarse: Workspace, file: str, damage: Callable[[Path], None], fault: str, remedy: str
) -> None:
    damage(coarse.path / file)
    before = {p: p.read_bytes() for p in coarse.path.rglob("*") if p.is_file()}
    first = examine(coarse).findings[0]
    assert str(first.path).startswith(str(coarse.path / Path(file).parts[0]))
    assert re.search(fault, first.fault)
    assert re.search(remedy, first.remedy)
    assert {p: p.read_bytes() for p in coarse.path.rglob("*") if p.is_file()} == before


def test_other_settings_and_sessions_that_are_gone_are_named(coarse: Workspace) -> None:
    shutil.rmtree(coarse.session("tuesday").path)
    faults = {f.fault for f in examine(coarse).findings}
    assert "the alignments are of sessions that are gone" in faults
    content = read_json(coarse.settings)
    content["given"]["fusion"]["hit"] = 0.9
    write_json(coarse.settings, content)
    faults = {f.fault for f in examine(coarse).findings}
    assert any("monday was fused with fusion.hit=0.85" in fault for fault in faults)


def test_failed_logs_and_searches_that_were_not_ended_are_named(coarse: Workspace) -> None:
    write_json(coarse.failure("friday"), {"reason": "friday.bag is cut off.", "fingerprint": ""})
    part = coarse.search_parts("tuesday")
    part.mkdir(parents=True)
    failed, interrupted = examine(coarse).findings
    assert (failed.path, failed.fault) == (coarse.failure("friday"), "friday.bag is cut off.")
    assert failed.remedy.endswith("--retry-failed")
    assert (interrupted.path, interrupted.fault) == (part, "a search was interrupted")
    assert interrupted.remedy == f"semloc close -w {coarse.path}"

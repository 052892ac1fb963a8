"""What `report` gathers from the tables of a workspace."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from semloc_logs.closures.closure import Closure, Reason, Rejected
from semloc_logs.closures.exclusions import Exclusions
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.report_page import closure_pictures, map_sheets
from semloc_logs.report_page.map_sheets import MapSheet
from semloc_logs.settings import Settings
from semloc_logs.stages import report_page
from semloc_logs.stages.report_page import write_report
from semloc_logs.tables import contracts
from semloc_logs.tables.table import read_json, read_metadata, read_table, write_json, write_table
from semloc_logs.workspace import Workspace


def data_of(path: Path) -> dict[str, Any]:
    """The data of a page."""
    data_element = re.search(
        r'id="data">(.*?)</script>', path.read_text(encoding="utf-8"), re.DOTALL
    )
    assert data_element
    data: dict[str, Any] = json.loads(data_element[1])
    return data


def test_the_page_has_the_settings_of_the_closures(report: Path, tables: Workspace) -> None:
    settings = data_of(report)["settings"]
    assert settings["fusion"]["voxel_size"] == Settings().resolved().fusion.voxel_size
    assert settings == read_metadata(tables.closures)["settings"]


def test_closures_that_the_optimisation_refused_have_its_reason(
    tables: Workspace, tmp_path: Path
) -> None:
    work = Workspace(Path(shutil.copytree(tables.path, tmp_path / "work")))
    rows = read_table(work.closures).to_pylist()
    ends = ("query_session", "target_session", "query_stamp_ns", "target_stamp_ns")
    columns: dict[str, Any] = {end: [row[end] for row in rows] for end in ends}
    columns["kept"] = [k != 7 for k in range(len(rows))]
    columns |= {name: np.zeros(len(rows)) for name in ("error_m", "error_deg", "squared_error")}
    columns["reason"] = ["contradicts" if k == 7 else "" for k in range(len(rows))]
    table = contracts.table("graph_closures", columns)
    write_table(work.graph_closures, table, {"schema_version": 1})
    page = write_report(work, Settings().resolved(), slim=True)
    assert page == work.report
    assert data_of(page)["closures"]["refused"] == {"7": "contradicts"}


def test_an_alignment_that_was_found_twice_is_a_closure_if_either_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ends = {
        "query_session": "a",
        "query_stamp_ns": 1,
        "target_session": "b",
        "target_stamp_ns": 2,
    }
    alignment = cast(Any, SimpleNamespace(**ends))
    decision = cast(Any, None)
    closure = Closure(alignment, decision)
    first, last = (Rejected(alignment, decision, Reason.SECOND_CHOICE) for _ in range(2))
    for decided, expected in (
        ([first, closure, last], closure),
        ([closure, last], closure),
        ([first, last], first),
    ):
        monkeypatch.setattr(report_page, "decided_alignments", lambda *_, rows=decided: rows)
        outcomes = report_page._outcomes(cast(Any, None), {}, Settings().resolved(), Exclusions())
        assert list(outcomes) == [("a", 1, "b", 2)]
        assert outcomes["a", 1, "b", 2] is expected


def test_sessions_that_get_no_closures_say_why(tables: Workspace, tmp_path: Path) -> None:
    work = Workspace(Path(shutil.copytree(tables.path, tmp_path / "work")))
    jumping = work.sessions()[0]
    fit = {"track": "its poses jump by 80 m", "streams": []}
    write_json(jumping.session_json, {**read_json(jumping.session_json), "fit": fit})
    data = data_of(write_report(work, Settings().resolved(), slim=True))
    names = [session["name"] for session in data["sessions"]]
    k = names.index(jumping.name)
    reason = f"the poses of {jumping.name} do not fit"
    pairs = [sorted((k, other)) for other in range(len(names))]
    assert data["excluded"] == {f"{first} {second}": reason for first, second in pairs}
    [sentence] = data["exclusions"]
    assert "its poses jump by 80 m" in sentence


def test_a_sheet_lies_where_its_map_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """A log without poses has no place, and an empty map no sheet."""
    sheet = MapSheet("picture of a", -5.0, 6.0, 10.0, 12.0, below_roof=False)
    sheets = {"map of a": sheet, "map of c": None}
    monkeypatch.setattr(map_sheets, "map_sheet", lambda session, most: sheets[session])
    monkeypatch.setattr(
        closure_pictures, "closure_pictures", lambda work, rows: {f"closure-{len(rows)}": "c"}
    )
    placed = {"a": yaw_transform(np.pi / 6, (1.0, 2.0, 3.0)), "c": np.eye(4)}
    tables = SimpleNamespace(
        maps={name: f"map of {name}" for name in "abc"},
        placement=SimpleNamespace(common_T_map=placed),
        closures=[{}, {}],
    )
    content: dict[str, Any] = {"sessions": [{"name": name} for name in "bac"]}
    pictures = report_page._pictures(cast(Any, None), content, cast(Any, tables))
    assert pictures == {"sheet-1": "picture of a", "closure-2": "c"}
    b, a, c = content["sessions"]
    assert (b, c) == ({"name": "b"}, {"name": "c"})
    assert a["place"] == pytest.approx([1.0, 2.0, np.pi / 6])
    edges = {"left": -5.0, "upper": 6.0, "width": 10.0, "height": 12.0, "below_roof": False}
    assert a["sheet"] == edges


def test_a_log_whose_name_is_not_unicode_is_named_as_far_as_it_goes(
    tables: Workspace, tmp_path: Path
) -> None:
    work = Workspace(Path(shutil.copytree(tables.path, tmp_path / "work")))
    reason = f"{os.fsdecode(bytes([0x63, 0xE9]))}.bag cannot be read."  # the second byte is Latin-1
    write_json(work.failure("c"), {"fingerprint": "", "reason": reason})
    page = write_report(work, Settings().resolved(), slim=True)
    assert data_of(page)["failed"] == [{"session": "c", "reason": "c?.bag cannot be read."}]

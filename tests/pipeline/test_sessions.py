"""Sessions of a workspace: listed, renamed and removed, with nothing left of the old name."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from semloc_logs.engines import Serial
from semloc_logs.errors import WorkspaceError
from semloc_logs.mapping.drift import UNMEASURED
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.stages import close as close_stage
from semloc_logs.stages import pair_search
from semloc_logs.stages.stored_sessions import list_sessions, remove_session, rename_session
from semloc_logs.tables.table import read_json, write_json
from semloc_logs.workspace import Workspace


def closures(work: Workspace) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = pq.read_table(work.closures).to_pylist()
    return rows


def test_sessions_are_listed_in_the_order_of_their_recording(coarse: Workspace) -> None:
    monday, tuesday = list_sessions(coarse)
    assert (monday.name, tuesday.name) == ("monday", "tuesday")
    assert monday.logs[0].endswith("monday.mcap")
    assert 10.0 < monday.road_m < 20.0
    assert monday.drift_percent is None  # too short a drive
    assert monday.described
    assert (monday.searched, monday.closures) == (2, len(closures(coarse)))
    assert [s.name for s in list_sessions(coarse, ["tuesday"])] == ["tuesday"]
    rename_session(coarse, "monday", "zulu")  # still the earlier one
    assert [s.name for s in list_sessions(coarse)] == ["zulu", "tuesday"]


def test_a_closure_within_a_session_counts_once(coarse: Workspace) -> None:
    ends = {"query_session": ["monday", "tuesday"], "target_session": ["monday", "monday"]}
    pq.write_table(pa.table(ends), coarse.closures)
    assert [(s.name, s.closures) for s in list_sessions(coarse)] == [("monday", 2), ("tuesday", 1)]


def test_a_session_tells_the_drift_that_its_clouds_showed(coarse: Workspace) -> None:
    path = coarse.session("monday").session_json
    content = read_json(path)
    content["fit"]["drift"] = {"translation": [0.0197, 0.004, 0.001], "rotation": [0.0, 0.0, 3e-4]}
    write_json(path, content)
    assert list_sessions(coarse, ["monday"])[0].drift_percent == 1.97
    assert SessionMap(coarse.session("monday")).drift.rotation == (0.0, 0.0, 3e-4)
    assert SessionMap(coarse.session("tuesday")).drift is UNMEASURED


@pytest.mark.parametrize("name", ["monday", "tuesday"])
def test_a_renamed_session_keeps_its_words_and_alignments(
    coarse: Workspace, tools: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    before = closures(coarse)
    rename_session(coarse, name, "rainy day")
    assert [s.name for s in coarse.sessions()] == sorted(
        {"monday", "tuesday"} - {name} | {"rainy day"}
    )
    assert read_json(coarse.session("rainy day").session_json)["name"] == "rainy day"
    expected = [
        {k: "rainy day" if k.endswith("_session") and v == name else v for k, v in row.items()}
        for row in before
    ]
    assert closures(coarse) == expected
    assert not [p for p in coarse.path.rglob("*") if name in str(p.relative_to(coarse.path))]
    monkeypatch.setattr(pair_search, "search_queries", None)
    assert close_stage.close(coarse, tools.coarse_settings(), Serial()).kept == ["closures"]


def test_a_name_that_is_taken_is_refused(coarse: Workspace, tools: SimpleNamespace) -> None:
    before = tools.files(coarse.path)
    with pytest.raises(WorkspaceError, match="has a session tuesday already"):
        rename_session(coarse, "monday", "tuesday")
    with pytest.raises(WorkspaceError, match=r"no session mondy .*Did you mean 'monday'\?"):
        rename_session(coarse, "mondy", "other")
    assert tools.files(coarse.path) == before


def test_of_a_removed_session_nothing_is_left(coarse: Workspace) -> None:
    coarse.search_parts("tuesday", "monday").mkdir(parents=True)  # a search was interrupted
    remove_session(coarse, "tuesday")
    assert [s.name for s in coarse.sessions()] == ["monday"]
    assert closures(coarse) == []
    assert not [p for p in coarse.path.rglob("*") if "tuesday" in str(p.relative_to(coarse.path))]
    coarse.picture.touch()
    remove_session(coarse, "monday")
    assert coarse.sessions() == []
    assert {p.name for p in coarse.path.iterdir() if p.is_file()} == {"workspace.json"}

"""Tables do not depend on where the work runs: in this process, in one worker or in two."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from semloc_logs.engines import make_engine
from semloc_logs.workspace import Workspace


@pytest.mark.parametrize("jobs", [1, 2])
def test_tables_of_serial_and_processes_are_byte_identical(
    jobs: int, tools: SimpleNamespace, drives: Any, coarse: Workspace, tmp_path: Path
) -> None:
    """Both drives are fused and described, and each of them is a query: two tasks in every stage.
    ``coarse`` was made serially.
    """
    expected = tools.files(coarse.path)
    assert {
        "closures.parquet",
        "rejected.parquet",
        "sessions/tuesday/words.json",
        "sessions/monday/frames.parquet",
    } <= set(expected)
    engine = make_engine("processes", jobs)
    try:
        two = {name: drives[name] for name in ("monday", "tuesday")}
        work = tools.whole(tmp_path / "again", two, tools.coarse_settings(), engine)
    finally:
        engine.close()
    assert tools.files(work.path) == expected

"""`run`: every stage after the other, resumable, with annotated logs at the end."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow.parquet as pq

from semloc_logs.engines import Serial
from semloc_logs.stages import run as run_stage
from semloc_logs.stages.annotate import AnnotationMode
from semloc_logs.stages.report import Report
from semloc_logs.tables.table import read_json
from semloc_logs.workspace import Workspace

STAGES = ["fuse monday", "fuse tuesday", "describe monday", "describe tuesday", "close closures"]


def test_a_run_goes_on_where_it_was(
    tools: SimpleNamespace, drives: Any, coarse: Workspace, tmp_path: Path
) -> None:
    inputs = tools.inputs(drives, "monday", "tuesday")

    def run(work: Workspace, annotation: str = "none", overwrite: bool = False) -> Report:
        return run_stage.run(
            inputs,
            work,
            tools.coarse_settings(),
            Serial(),
            annotation=AnnotationMode(annotation),
            overwrite=overwrite,
        )

    tables = tools.files(coarse.path)
    report = run(coarse, "sidecar")
    assert (report.done, report.kept, report.failed) == ([], STAGES, [])
    assert sorted(p.name for p in coarse.annotated.iterdir()) == [
        "monday.semloc.mcap",
        "tuesday.semloc.mcap",
    ]
    assert (
        read_json(coarse.summary)["closures"]
        == report.closures
        == pq.read_metadata(coarse.closures).num_rows
    )
    assert set(report.seconds) == {"fuse", "describe", "close", "annotate"}
    coarse.session("tuesday").words_json.unlink()
    assert run(coarse).done == ["describe tuesday"]
    coarse.session("tuesday").session_json.unlink()
    assert run(coarse).done == ["fuse tuesday", "describe tuesday"]
    again = run(coarse, overwrite=True)
    assert (again.done, again.kept) == (STAGES, [])
    coarse.summary.unlink()
    assert tools.files(coarse.path) == tables

"""`run`: every stage after the other, resumable, with annotated logs at the end."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow.parquet as pq
import pytest

from semloc_logs.engines import Serial
from semloc_logs.settings import Settings
from semloc_logs.stages import run as run_stage
from semloc_logs.stages.annotate import Annotation, AnnotationMode
from semloc_logs.stages.inputs import Redo, SessionInput
from semloc_logs.stages.report import Report
from semloc_logs.tables.table import read_json, write_json
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
            redo=Redo.of(overwrite=overwrite),
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


def test_a_log_that_cannot_be_read_does_not_stop_the_others(
    tools: SimpleNamespace, drives: Any, coarse: Workspace, tmp_path: Path
) -> None:
    """It is named in the report and in the summary; with ``retry_failed`` it is read again."""
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"not a log")
    inputs = [SessionInput("broken", (broken,)), *tools.inputs(drives, "monday")]

    def run(retry_failed: bool = False) -> Report:
        return run_stage.run(
            inputs,
            coarse,
            tools.coarse_settings(),
            Serial(),
            annotation=AnnotationMode.COPY,
            redo=Redo.of(retry_failed=retry_failed),
        )

    [sentence] = run().failed
    assert "broken.mcap" in sentence
    assert read_json(coarse.summary)["failed"] == [sentence]
    assert [p.name for p in coarse.annotated.iterdir()] == ["monday.mcap"]
    before = coarse.failure("broken").stat().st_mtime_ns
    assert len(run().failed) == 1  # and monday's log is annotated again
    assert coarse.failure("broken").stat().st_mtime_ns == before
    assert len(run(retry_failed=True).failed) == 1
    assert coarse.failure("broken").stat().st_mtime_ns > before


def test_the_report_is_written_again_when_something_was_done(
    tools: SimpleNamespace, drives: Any, coarse: Workspace
) -> None:
    """And rates are kept that a run without work does not measure."""

    def run() -> int:
        inputs = tools.inputs(drives, "monday", "tuesday")
        run_stage.run(inputs, coarse, tools.coarse_settings(), Serial())
        return coarse.report.stat().st_mtime_ns

    first = run()
    assert run() == first
    coarse.report.unlink()
    second = run()
    content = read_json(coarse.summary)
    write_json(coarse.summary, content | {"rates": {"fuse": 7.0, "describe": 8.0}})
    coarse.session("tuesday").words_json.unlink()
    assert run() > second
    rates = read_json(coarse.summary)["rates"]
    assert rates["fuse"] == 7.0
    assert rates["describe"] != 8.0


def test_rates_are_of_one_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two workers take 5 s for 10 units, then 8 s for 4."""
    now = iter((100.0, 105.0, 113.0, 114.0))
    monkeypatch.setattr("time.perf_counter", lambda: next(now))
    total = run_stage._Total(2)
    total.add("fuse", Report(amount=10.0, closures=0))
    total.add("close", Report(amount=4.0, closures=3))
    total.add("annotate", Report(closures=3))
    assert total.rates == {"fuse": 1.0, "close": 4.0}
    assert total.report.seconds == {"fuse": 5.0, "close": 8.0, "annotate": 1.0}


def test_reports_of_stages_are_joined() -> None:
    total = run_stage._Total(1)
    total.add("fuse", Report(done=["a"], kept=["b"], skipped=["no fix"], failed=["no log"]))
    total.add("close", Report(done=["closures"], skipped=["no fit"], closures=3))
    report = total.report
    assert report.done == ["fuse a", "close closures"]
    assert report.kept == ["fuse b"]
    assert report.skipped == ["no fix", "no fit"]
    assert report.failed == ["no log"]
    assert report.closures == 3


def test_a_map_without_a_log_is_not_annotated(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(run_stage, "annotate", None)
    monkeypatch.setattr(run_stage, "SessionMap", lambda _: SimpleNamespace(is_map=True))
    session = SessionInput("a", (tmp_path / "a.ply",))
    settings = Settings().resolved()
    run_stage._annotate_logs(session, Workspace(tmp_path), settings, AnnotationMode.COPY)


def test_several_logs_of_a_session_have_outputs_of_their_own(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    work = Workspace(tmp_path)
    outputs: list[Path | None] = []

    def annotate(
        log: Path, work: Workspace, settings: Any, annotation: Annotation, session: str
    ) -> SimpleNamespace:
        outputs.append(annotation.output)
        return SimpleNamespace(messages=0, path=annotation.output)

    monkeypatch.setattr(run_stage, "annotate", annotate)
    monkeypatch.setattr(run_stage, "SessionMap", lambda _: SimpleNamespace(is_map=False))
    settings = Settings().resolved()
    two = SessionInput("both", (tmp_path / "first.bag", tmp_path / "second.bag"))
    one = SessionInput("one", (tmp_path / "third.bag",))
    for session in (two, one):
        for mode in (AnnotationMode.COPY, AnnotationMode.SIDECAR, AnnotationMode.IN_PLACE):
            run_stage._annotate_logs(session, work, settings, mode)
    names = [output and output.name for output in outputs]
    assert names == [
        *("first.mcap", "second.mcap", "first.semloc.mcap", "second.semloc.mcap", None, None),
        *("one.mcap", "one.semloc.mcap", None),
    ]
    assert {output.parent for output in outputs if output} == {work.annotated}

"""The pipeline on one screen: fuse, describe, close, annotate."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import semloc_logs
from semloc_logs.engines import Engine
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import Resolved
from semloc_logs.stages.annotate import Annotation, AnnotationMode, annotate
from semloc_logs.stages.close import close
from semloc_logs.stages.describe import describe
from semloc_logs.stages.dry_run import measured_rates
from semloc_logs.stages.fuse import fuse
from semloc_logs.stages.inputs import Redo, SessionInput, session_name
from semloc_logs.stages.lock import one_writer
from semloc_logs.stages.report import Report
from semloc_logs.stages.report_page import write_report
from semloc_logs.tables.table import write_json
from semloc_logs.workspace import Workspace, checked_name

LOGGER = logging.getLogger(__name__)


@one_writer
def run(
    sessions: Sequence[SessionInput],
    work: Workspace,
    settings: Resolved,
    engine: Engine,
    *,
    annotation: AnnotationMode = AnnotationMode.NONE,
    redo: Redo = Redo.NOTHING,
) -> Report:
    """All of it, resumable: sessions are fused, and all of the workspace described and closed."""
    total = _Total(engine.jobs)
    total.add("fuse", fuse(sessions, work, settings, engine, redo=redo))
    fused = [s for s in sessions if work.session(s.name).session_json.exists()]
    # of those that are fused again, words are made again
    total.add("describe", describe(work, [], settings, engine))
    total.add("close", close(work, settings, engine, overwrite=redo is Redo.EVERYTHING))
    if annotation is not AnnotationMode.NONE:
        for session in fused:
            _annotate_logs(session, work, settings, annotation)
        total.add("annotate", Report(closures=total.report.closures))
    _write_summary(work, total.report, {**measured_rates(work), **total.rates})
    if total.report.done or not work.report.exists():
        write_report(work, settings)
    return total.report


class _Total:
    """One report of all stages."""

    def __init__(self, workers: int) -> None:
        self.report = Report()
        self.rates: dict[str, float] = {}
        self._workers = workers
        self._begun = time.perf_counter()

    def add(self, stage: str, part: Report) -> None:
        """Add what a stage did since the last one was added."""
        self.report.done += [f"{stage} {name}" for name in part.done]
        self.report.kept += [f"{stage} {name}" for name in part.kept]
        self.report.skipped += part.skipped
        self.report.failed += part.failed
        self.report.closures = part.closures
        now = time.perf_counter()
        seconds = now - self._begun
        self.report.seconds[stage] = round(seconds, 3)
        if part.amount:
            self.rates[stage] = round(seconds * self._workers / part.amount, 4)
        self._begun = now


def _annotate_logs(
    session: SessionInput, work: Workspace, settings: Resolved, mode: AnnotationMode
) -> None:
    if SessionMap(work.session(session.name)).is_map:  # it has no channels
        return
    for log in session.logs:
        output = None if mode is AnnotationMode.IN_PLACE else _output(session, log, work, mode)
        annotation = Annotation(mode, output, overwrite=True)
        made = annotate(log, work, settings, annotation, session=session.name)
        LOGGER.info("%s: %d messages in %s", session.name, made.messages, made.path)


def _output(session: SessionInput, log: Path, work: Workspace, mode: AnnotationMode) -> Path:
    # several logs of one session have names of their own
    name = checked_name(session.name if len(session.logs) == 1 else session_name(log))
    ending = ".semloc.mcap" if mode is AnnotationMode.SIDECAR else ".mcap"
    return work.annotated / f"{name}{ending}"


def _write_summary(work: Workspace, report: Report, rates: Mapping[str, float]) -> None:
    content = {
        "version": semloc_logs.__version__,
        "seconds": report.seconds,
        "rates": dict(rates),
        "skipped": report.skipped,
        "failed": report.failed,
        "closures": report.closures,
    }
    write_json(work.summary, content)

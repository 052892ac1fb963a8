"""A log alone: whether its poses and its range data fit each other, without a workspace."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from semloc_logs.labels.geometry_labels import NoLabels
from semloc_logs.logs.problems import sentences, to_report
from semloc_logs.logs.session.session import open_session
from semloc_logs.mapping.fit.findings import SessionFit
from semloc_logs.mapping.fit.fit_check import check_session
from semloc_logs.mapping.keyframes import collect
from semloc_logs.mapping.levelling import level
from semloc_logs.mapping.session_fusion import reading_options
from semloc_logs.settings import Settings


def check_log(log: Path, settings: Settings, topics: Mapping[str, str]) -> SessionFit:
    """Reads the keyframes of a log and checks them. LogError and RoleError as in fusing."""
    resolved = settings.resolved()
    fusion = resolved.fusion
    options = reading_options(resolved, topics)
    with closing(open_session([log], options)) as session, tempfile.TemporaryDirectory() as folder:
        labeller = NoLabels()
        collected = collect(session, labeller, fusion, Path(folder), log.name)
        check = check_session(session, collected, fusion.voxel_size)
        if check.fits and len(collected):
            check.add_tilt(level(session, collected, resolved).tilt, session.roles.imu or "")
        return check


def with_fit(content: Mapping[str, Any], fit: SessionFit) -> dict[str, Any]:
    """The object of ``inspect --json`` with the check under ``fit``; its findings are problems."""
    reported = sentences(to_report(fit.problems))
    verdict = content["verdict"]
    if not fit.fits:
        verdict = f"not to be trusted: {reported[0]}"
    return {
        **content,
        "problems": [*content["problems"], *sentences(fit.problems)],
        "skipped": [*content["skipped"], *reported],
        "fit": fit.to_json(),
        "verdict": verdict,
        "suggested": content["suggested"] if fit.fits else "",
    }

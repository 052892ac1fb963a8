"""The report of a workspace: one page that opens anywhere."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from semloc_logs.closures.closure import Closure, Rejected
from semloc_logs.closures.closure_tables import read_closures
from semloc_logs.closures.exclusions import Exclusions
from semloc_logs.errors import WorkspaceError
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.pictures.placement import Tie, place_sessions
from semloc_logs.report_page.content import Key, Tables, content_of, key_of
from semloc_logs.report_page.page import page
from semloc_logs.settings import Resolved
from semloc_logs.stages.close import decided_alignments
from semloc_logs.tables.atomic_files import replacing_file
from semloc_logs.tables.table import read_metadata
from semloc_logs.workspace import Workspace


def write_report(
    work: Workspace, settings: Resolved, output: Path | None = None, *, slim: bool = False
) -> Path:
    """Write report.html, or ``output``; ``slim`` without pictures. The file that was written.

    Raises WorkspaceError where the workspace has no sessions or was not closed.
    """
    maps = {folder.name: SessionMap(folder) for folder in work.chosen(())}
    if not work.closures.exists():
        raise WorkspaceError(
            f"{work.closures} does not exist: run 'semloc close -w {work.path}' first."
        )
    closures = read_closures(work.closures)
    rejected = read_closures(work.rejected)
    placement = place_sessions(work, maps, [Tie.of_row(row) for row in closures])
    exclusions = Exclusions.of(maps, settings)
    outcomes = _outcomes(work, maps, settings, exclusions)
    tables = Tables(maps, closures, rejected, outcomes, placement, _refused(work), exclusions)
    content = content_of(work, tables, _settings_of(work))
    pictures = {} if slim else _pictures(work, content, tables)
    path = output or work.report
    with replacing_file(path) as temporary:
        # a name that is not Unicode becomes a replacement character
        temporary.write_bytes(page(content, pictures).encode("utf-8", "replace"))
    return path


def _outcomes(
    work: Workspace, maps: dict[str, SessionMap], settings: Resolved, exclusions: Exclusions
) -> dict[Key, Closure | Rejected]:
    """What was decided about each alignment, with its features and votes."""
    outcomes: dict[Key, Closure | Rejected] = {}
    for outcome in decided_alignments(work, maps, settings, exclusions):
        a = outcome.alignment
        key = (a.query_session, a.query_stamp_ns, a.target_session, a.target_stamp_ns)
        if key not in outcomes or isinstance(outcome, Closure):
            outcomes[key] = outcome
    return outcomes


def _refused(work: Workspace) -> dict[Key, str]:
    """Closures that the optimisation refused, with the reason."""
    path = work.graph_closures
    if not path.exists():
        return {}
    return {key_of(row): row["reason"] for row in read_closures(path) if not row["kept"]}


def _settings_of(work: Workspace) -> dict[str, Any]:
    """The settings that the closures were found with."""
    settings = read_metadata(work.closures).get("settings")
    return settings if isinstance(settings, dict) else {}


def _pictures(work: Workspace, content: dict[str, Any], tables: Tables) -> dict[str, str]:
    """Pictures by their ids; where the maps lie is added to ``content``."""
    # matplotlib and OpenCV are loaded only where something is drawn
    from semloc_logs.report_page.closure_pictures import closure_pictures
    from semloc_logs.report_page.map_sheets import map_sheet, sheet_size

    pictures = {}
    most = sheet_size(len(tables.maps))
    for number, session in enumerate(content["sessions"]):
        T = tables.placement.common_T_map.get(session["name"])
        sheet = None if T is None else map_sheet(tables.maps[session["name"]], most)
        if T is None or sheet is None:  # a log without poses, an empty map
            continue
        session["place"] = [float(T[0, 3]), float(T[1, 3]), float(np.arctan2(T[1, 0], T[0, 0]))]
        session["sheet"] = {k: v for k, v in asdict(sheet).items() if k != "picture"}
        pictures[f"sheet-{number}"] = sheet.picture
    return pictures | closure_pictures(work, tables.closures)

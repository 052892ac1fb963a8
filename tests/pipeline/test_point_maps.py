"""A map of points that others made, as the target of a drive."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from semloc_logs.closures.closure_tables import read_closures
from semloc_logs.engines import Serial
from semloc_logs.errors import WorkspaceError
from semloc_logs.exports.export import Selection, export
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse, transform
from semloc_logs.stages import run as run_stage
from semloc_logs.stages.annotate import Annotation, AnnotationMode, annotate
from semloc_logs.stages.inputs import SessionInput
from semloc_logs.workspace import Workspace


def test_a_drive_is_found_in_the_points_of_another(
    tools: SimpleNamespace, drives: Any, labelled: Workspace, tmp_path: Path
) -> None:
    (points,) = export(
        labelled, ["monday"], "pcd", tmp_path / "points", Selection(what="keyframes")
    )
    work = Workspace(tmp_path / "work")
    settings = tools.quick_settings()
    inputs = [SessionInput("hdmap", (points,)), *tools.inputs(drives, "tuesday")]
    run_stage.run(inputs, work, settings, Serial(), annotation=AnnotationMode.SIDECAR)

    # the map has no channels, and no revisits of its own
    assert [path.name for path in work.annotated.iterdir()] == ["tuesday.semloc.mcap"]
    with pytest.raises(WorkspaceError, match="is a map of points, which has no channels"):
        annotate(
            points,
            work,
            settings,
            Annotation(AnnotationMode.COPY, tmp_path / "x.mcap"),
            session="hdmap",
        )
    closures = read_closures(work.closures)
    assert {row["query_session"] for row in closures} == {"tuesday"}
    in_map = [row for row in closures if row["target_session"] == "hdmap"]
    assert in_map

    hdmap = SessionMap(work.session("hdmap"))
    assert hdmap.is_map
    assert not SessionMap(work.session("tuesday")).is_map
    stations = np.array(hdmap.json["session_T_map"]) @ hdmap.map_T_base
    for row in in_map:
        station = stations[hdmap.stamps_ns.tolist().index(row["target_stamp_ns"])]
        pose = station @ transform(
            np.array([row[f"t_{c}"] for c in "xyz"]), np.array([row[f"q_{c}"] for c in "xyzw"])
        )
        # the points are in the frame of Monday's odometry
        truth = drives["monday"].session_T_world @ drives["tuesday"].world_T_base(
            row["query_stamp_ns"]
        )
        assert np.linalg.norm((inverse(truth) @ pose)[:3, 3]) < 0.3

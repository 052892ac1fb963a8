from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pytest
from click.testing import CliRunner

from semloc_logs.alignment.query_map import Query
from semloc_logs.alignment.target_map import Target
from semloc_logs.cli.main import program
from semloc_logs.errors import WorkspaceError
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.pictures.closure_sheet import draw_views
from semloc_logs.pictures.closure_view import Choice, ClosureView, Match, Wanted, choose, drawn
from semloc_logs.settings import Settings
from semloc_logs.tables import contracts
from semloc_logs.tables.table import write_json, write_table
from semloc_logs.voxels.grid import Fuser
from semloc_logs.voxels.store import pose_columns
from semloc_logs.workspace import Workspace

# query session, target session, query stamp in seconds, probability
Row = tuple[str, str, float, float]


def _zeros(schema: pa.Schema, rows: int) -> dict[str, Any]:
    return {
        f.name: np.zeros(rows, f.type.to_pandas_dtype())
        for f in schema
        if pa.types.is_primitive(f.type)
    }


def tables(folder: Path, accepted: list[Row], rejected: list[Row]) -> Workspace:
    """A workspace with these rows, and sessions whose first keyframe is at 1000 s."""
    work = Workspace(folder)
    for rows, path, name in (
        (accepted, work.closures, "closures"),
        (rejected, work.rejected, "rejected"),
    ):
        schema = contracts.schema(name)
        columns: dict[str, Any] = _zeros(schema, len(rows))
        columns |= {
            "query_session": [r[0] for r in rows],
            "target_session": [r[1] for r in rows],
            "query_stamp_ns": [int(r[2] * 1e9) for r in rows],
            "probability": [r[3] for r in rows],
            **pose_columns(np.tile(np.eye(4), (len(rows), 1, 1))),
        }
        columns |= (
            {"covariance": [np.eye(6).ravel().tolist()] * len(rows)}
            if name == "closures"
            else {"reason": ["too little"] * len(rows)}
        )
        write_table(path, contracts.table(name, columns), {})
    for session in {r[0] for r in accepted + rejected}:
        frames = _zeros(contracts.schema("frames"), 1) | {
            "stamp_ns": [1000 * 10**9],
            "topic": ["/points"],
        }
        write_table(work.session(session).frames, contracts.table("frames", frames), {})
        write_json(work.session(session).session_json, {})
    return work


@pytest.fixture
def work(tmp_path: Path) -> Workspace:
    accepted = [("a", "b", 1001.0, 0.998), ("a", "b", 1003.0, 0.999), ("b", "c", 1002.0, 0.995)]
    rejected = [("a", "b", 1003.0, 0.99), ("a", "c", 1010.0, 0.4), ("a", "c", 1020.0, 0.7)]
    return tables(tmp_path, accepted, rejected)


def stamps(choices: list[Choice]) -> list[tuple[str, float, bool]]:
    return [(c.row["query_session"], c.row["query_stamp_ns"] / 1e9, c.accepted) for c in choices]


def test_the_best_of_each_pair_of_sessions_and_the_best_rejected_without_a_closure(
    work: Workspace,
) -> None:
    assert stamps(choose(work, Wanted())) == [
        ("a", 1003.0, True),
        ("b", 1002.0, True),
        ("a", 1020.0, False),
    ]
    assert stamps(choose(work, Wanted(count=3)))[:3] == [
        ("a", 1003.0, True),
        ("b", 1002.0, True),
        ("a", 1001.0, True),
    ]
    assert stamps(choose(work, Wanted(session="b"))) == [("b", 1002.0, True)]


@pytest.mark.parametrize(
    ("seconds", "expected"),
    [
        (1003.2, (1003.0, True)),
        (3.2, (1003.0, True)),
        (11.0, (1010.0, False)),
        (1e6, (1020.0, False)),
    ],
)
def test_the_query_nearest_to_a_time(
    work: Workspace, seconds: float, expected: tuple[float, bool]
) -> None:
    assert stamps(choose(work, Wanted(session="a", at=seconds))) == [("a", *expected)]


def test_a_closure_by_its_number(work: Workspace) -> None:
    assert stamps(choose(work, Wanted(number=3))) == [("b", 1002.0, True)]
    for number in (0, 4):
        with pytest.raises(WorkspaceError, match="3 closures"):
            choose(work, Wanted(number=number))


def test_nothing_to_show(work: Workspace, tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match="'z'"):
        choose(work, Wanted(session="z"))
    with pytest.raises(WorkspaceError, match="semloc fuse"):
        choose(Workspace(tmp_path / "none"), Wanted())


def view(shift: float, *, accepted: bool) -> ClosureView:
    """A square of walls seen from its middle, ``shift`` metres off before the alignment."""
    side = np.linspace(-4.0, 4.0, 60)
    walls = [
        np.stack(np.broadcast_arrays(*xy, z), -1)
        for z in (0.2, 0.5, 0.8)
        for xy in ((side, 4.0), (side, -4.0), (4.0, side), (-4.0, side))
    ]
    points = np.concatenate(walls)
    fuser = Fuser(Settings().resolved().fusion)
    fuser.add(
        points.astype(np.float32), np.full(len(points), 2, np.uint8), np.array([0.0, 0.0, 1.0])
    )
    blocks = fuser.finish()
    row: dict[str, Any] = {
        "query_session": "a",
        "target_session": "b",
        "query_stamp_ns": 10**9,
        "target_stamp_ns": 2 * 10**9,
    }
    row |= {"probability": 0.999, "overlap": 0.6, "inliers": 10, "words": 3}
    row |= (
        {"covariance": (np.eye(6) * 1e-4).ravel().tolist()}
        if accepted
        else {"reason": "too little"}
    )
    roads = (np.diag([1.0, 0, 0]), np.zeros((1, 3)))
    state = np.full((32, 32, 32), 253, np.uint8)
    state[:, :, 3] = 0
    match = Match(state, state, state, 5, (1.0, 2.0, 0.0))
    before = yaw_transform(0.0, (shift, 0.0, 0.0))
    return ClosureView(
        Choice(row, np.eye(4)),
        Query(blocks, points, 0.3),
        Target(blocks, 0.3),
        np.eye(4),
        before,
        np.eye(4),
        np.eye(3),
        roads,
        (match,),
        "log",
    )


def test_a_sheet_shows_the_walls_apart_and_together(tmp_path: Path) -> None:
    path = tmp_path / "out.png"
    draw_views(path, [view(2.0, accepted=True), view(2.0, accepted=False)])
    image = np.asarray(cv2.imread(str(path)), int)[:, :, ::-1]
    assert image.shape[1] > 1900
    green = (image[..., 1] - image[..., [0, 2]].max(2) > 40) & (image[..., 1] < 200)
    assert green.sum() > 2000  # every voxel of the aligned query lies on the map's
    # the map's pale walls stand free before the alignment, and lie under the query's after it
    pale = (image.min(2) > 130) & (image.max(2) < 215) & (np.ptp(image, axis=2) < 12)
    before, aligned = (pale[130:700, x : x + 600].sum() for x in (44, 696))
    assert before > 3000
    assert before > 4 * aligned


def test_what_json_says() -> None:
    content = drawn(view(0.0, accepted=False))
    assert content["accepted"] is False
    assert content["reason"] == "too little"
    assert content["matches"] == [{"bits": 5, "target_position_m": [1.0, 2.0, 0.0]}]


def test_the_command_refuses_what_cannot_be_shown(tmp_path: Path) -> None:
    def show(*args: object) -> tuple[int, str]:
        done = CliRunner().invoke(
            program,
            ["show", "-w", str(tmp_path), "-o", str(tmp_path / "o.png"), *map(str, args)],
            prog_name="semloc",
        )
        return done.exit_code, done.output

    assert show("--closure", 1, "--at", 3)[0] == 2
    code, output = show()
    assert code == 1
    assert "semloc fuse" in output
    (tmp_path / "o.png").write_bytes(b"")
    assert "--overwrite" in show()[1]

"""Our whole pipeline as a system: sessions, words, hypotheses, search and fit."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

import numpy as np

from semloc_logs import progress
from semloc_logs.alignment.hypotheses import Hypothesis, pose_matrix, same_place
from semloc_logs.alignment.search import Candidate
from semloc_logs.arrays import F64
from semloc_logs.closures.closure import Alignment
from semloc_logs.closures.database import Database
from semloc_logs.closures.matching import (
    QueryContext,
    align_candidates,
    find_hypotheses,
    verify_hypotheses,
)
from semloc_logs.closures.query import build_query
from semloc_logs.closures.visibility import visible_to
from semloc_logs.engines import Serial
from semloc_logs.experiments.system import MOST_POSES, Query, RankedPose, View
from semloc_logs.experiments.view_sessions import fuse_views
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import Resolved, Settings
from semloc_logs.stages.describe import describe
from semloc_logs.workspace import Workspace

QUERY = "query"


@dataclass(eq=False)
class Ours:
    """The pipeline with ``settings`` (the defaults without any), under the ``name`` of its row.

    Sessions of the database are kept in the folder ``work``, a temporary one without it. A query is
    answered by itself: the acceptance, which compares it with its neighbours, takes no part. First
    come the poses that were fitted on points, ranked as in the pipeline by the structure that is
    aligned less the structure in free space, then poses after the search, then the other hypotheses
    by their votes. Scores of the latter two only keep the order.
    """

    name: str = "ours"
    settings: Resolved = field(default_factory=lambda: Settings().resolved())
    work: Path | None = None

    def __post_init__(self) -> None:
        self._temporary = tempfile.TemporaryDirectory(prefix="semloc-ours-")
        self._scratch = Workspace(Path(self._temporary.name))
        self._database: Database | None = None
        self._world_T_map: dict[str, F64] = {}

    def fit(self, database: Sequence[View]) -> None:
        """Fuse the views into a session for each of theirs, in the world of their truth."""
        work = Workspace(self.work or Path(self._temporary.name) / "database")
        rows: dict[str, list[int]] = {}
        for row, view in enumerate(database):
            rows.setdefault(view.session, []).append(row)
        for name, chosen in rows.items():
            folder = work.session(name)
            self._world_T_map[name] = fuse_views(
                (database[row] for row in chosen), folder, self.settings, "truth"
            )
        describe(work, [*rows], self.settings, Serial())
        self._database = Database(work, tuple(rows), self.settings)

    def localise(self, query: Query) -> list[RankedPose]:
        """The ranked poses of the query's last view."""
        if self._database is None:
            raise ValueError("a system is fitted before it localises")
        folder = self._scratch.session(QUERY)
        shutil.rmtree(folder.path, ignore_errors=True)
        settings = self.settings.model_copy(
            update={
                "query": self.settings.query.model_copy(
                    update={"frames": len(query.views), "length": None}
                )
            }
        )
        with progress.listening(lambda _: None):  # a second's work
            fuse_views(query.views, folder, settings, "odometry")
        session = SessionMap(folder)
        last = len(query.views) - 1
        built, query_T_base = build_query(session, last, settings)
        if not len(built.structure[0]):
            return []
        visible = visible_to(self._database, session, last)
        return self._ranked(QueryContext(visible, session, last, built, query_T_base))

    def _ranked(self, context: QueryContext) -> list[RankedPose]:
        """Poses of the query of ``context``, each place once."""
        hypotheses = self._hypotheses(context)
        searched = verify_hypotheses(context, hypotheses)
        fitted = [a for candidates in searched for a in self._aligned(context, candidates)]
        scores = [self._score(a) for a in fitted]
        poses: list[RankedPose] = []
        for i in np.argsort(-np.array(scores), kind="stable").tolist():
            self._add(poses, RankedPose(self._fitted_pose(fitted[i]), scores[i]))
        worst = min(scores, default=0.0)
        by_score = sorted(chain.from_iterable(searched), key=lambda c: -c.score)
        by_weight = sorted(hypotheses, key=lambda h: -h.weight)
        rest = chain(
            ((c.group, c.target_T_query) for c in by_score),
            ((h.group, pose_matrix(np.array(h.pose))) for h in by_weight),
        )
        for rank, (group, target_T_query) in enumerate(rest, 1):
            pose = self._world_T_map_of(group) @ target_T_query @ context.query_T_base
            self._add(poses, RankedPose(pose, worst - rank))
        return poses

    def _add(self, poses: list[RankedPose], pose: RankedPose) -> None:
        """Append ``pose`` where there is room and its place is not ``poses`` yet."""
        v = self.settings.fusion.voxel_size
        if len(poses) < MOST_POSES and not any(
            same_place(pose.world_T_base, f.world_T_base, v) for f in poses
        ):
            poses.append(pose)

    def _hypotheses(self, context: QueryContext) -> list[Hypothesis]:
        return find_hypotheses(context)

    def _score(self, alignment: Alignment) -> float:
        features = alignment.features
        return features.structure - features.contradiction

    def _aligned(self, context: QueryContext, candidates: list[Candidate]) -> list[Alignment]:
        return align_candidates(context, candidates)

    def _world_T_map_of(self, group: int) -> F64:
        if self._database is None:
            raise ValueError("a system is fitted before it localises")
        return self._world_T_map[self._database.places[group].session]

    def _fitted_pose(self, alignment: Alignment) -> F64:
        if self._database is None:
            raise ValueError("a system is fitted before it localises")
        name = alignment.target_session
        map_T_target = self._database.sessions[name].map_T_base[alignment.target_keyframe]
        return np.asarray(self._world_T_map[name] @ map_T_target @ alignment.target_T_query)

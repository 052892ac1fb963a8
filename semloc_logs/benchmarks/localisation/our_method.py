"""Our localisation in the benchmark: as it is, with parts replaced, and where its time goes."""

from __future__ import annotations

import cProfile
import os
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import torch

from semloc_logs.alignment.hypotheses import Hypothesis
from semloc_logs.alignment.query_map import Query
from semloc_logs.benchmarks.localisation.city import DATABASE, WorldDrive
from semloc_logs.benchmarks.localisation.judged_answers import Answer, World, read_world
from semloc_logs.benchmarks.spans import FunctionTimes, Span, span_seconds
from semloc_logs.closures.acceptance.calibration import shipped
from semloc_logs.closures.acceptance.decide import decide
from semloc_logs.closures.closure import Alignment, Closure
from semloc_logs.closures.database import Database
from semloc_logs.closures.matching import (
    FindHypotheses,
    QueryContext,
    align_candidates,
    close_query,
    find_hypotheses,
    verify_hypotheses,
)
from semloc_logs.closures.query import build_query, query_keyframes
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import STREET_VOXEL, Resolved
from semloc_logs.subvolumes.cut import turned_map
from semloc_logs.subvolumes.describe import Described, Windows, describe_map, load_encoder
from semloc_logs.subvolumes.network import Completion
from semloc_logs.subvolumes.submap_descriptors import describe_submap
from semloc_logs.subvolumes.weight_files import save_weights
from semloc_logs.voxels.store import blocks_path
from semloc_logs.words.index import Allowed, Index, Matches
from semloc_logs.words.vocabulary import save_vocabulary, train_vocabulary
from semloc_logs.workspace import Workspace

Arrays = TypeVar("Arrays", Described, Matches)
STEP = 4.0  # m between hypotheses of the grid along the road, and across it
GRID_SEED = 7  # of the random choice among the hypotheses of the grid
PROFILED = 30  # queries, one after the other along the road
WHOLE = "whole query"
SPANS = (  # of a query
    Span("fuse", (build_query,)),
    Span("describe", (describe_map, turned_map)),
    Span("search words", (Index.search,)),
    Span("verify", (verify_hypotheses,)),
    Span("align and judge", (align_candidates,)),
)


@dataclass(frozen=True, slots=True)
class OurSystem:
    """A variant of our localisation.

    ``query``: settings of how a query is fused; ``labels``: their source; ``weights``: of the
    network. ``hypotheses`` come from words, from words of the query described again in every
    heading (sweep), from a grid over all of the road (all), or from as many places of that grid as
    there are hypotheses from words (some).
    """

    name: str
    query: tuple[tuple[str, Any], ...] = (("length", 20.0),)
    labels: Literal["auto", "geometry"] = "auto"
    weights: Literal["trained", "random"] = "trained"
    hypotheses: Literal["words", "sweep", "some", "all"] = "words"

    def search(self, settings: Resolved) -> FindHypotheses:
        """The function that finds its hypotheses."""
        if self.hypotheses == "words":
            return find_hypotheses
        if self.hypotheses == "sweep":
            return partial(find_hypotheses, match=sweep_words)
        count = settings.closures.hypotheses if self.hypotheses == "some" else None
        return partial(grid_hypotheses, count=count)


OURS = (
    OurSystem("ours"),
    OurSystem("ours, one frame", (("frames", 1),)),
    OurSystem("ours, no labels", labels="geometry"),
    OurSystem("ours, every heading described", hypotheses="sweep"),
    OurSystem("random weights", weights="random"),
    OurSystem("grid, as many", hypotheses="some"),
    OurSystem("grid, exhaustive", hypotheses="all"),
)


@dataclass(frozen=True, slots=True)
class OurTask:
    """Queries of one drive by one system; picklable."""

    work: Path
    drive: WorldDrive
    system: OurSystem
    keyframes: tuple[int, ...]
    settings: Resolved  # of the system

    def answers(self) -> list[Answer]:
        """One for each keyframe; the first query runs twice, the first time to warm up."""
        world = read_world(self.work, self.drive)
        query = self._query_function(world)
        query(self.keyframes[0])

        alignments: list[list[Alignment]] = []
        seconds = []
        for keyframe in self.keyframes:
            begin = time.perf_counter()
            alignments.append(query(keyframe))
            seconds.append(time.perf_counter() - begin)

        maps = {self.drive.name: world.query, DATABASE: world.database}
        decided = decide([a for of_query in alignments for a in of_query], maps, self.settings)
        accepted = {
            c.alignment.query_keyframe: c.alignment for c in decided if isinstance(c, Closure)
        }
        return [
            self._answer(
                world, keyframe, duration, of_query[0] if of_query else None, accepted.get(keyframe)
            )
            for keyframe, duration, of_query in zip(
                self.keyframes, seconds, alignments, strict=True
            )
        ]

    def profile(self) -> dict[str, float]:
        """Seconds of a whole query and of its parts, under the profiler.

        The queries come one after the other along the road, as in `semloc close`.
        """
        world = read_world(self.work, self.drive)
        query = self._query_function(world)
        possible = query_keyframes(world.query, self.settings)
        keyframes = possible[max(0, (len(possible) - PROFILED) // 2) :][:PROFILED]
        query(keyframes[0])

        begin = time.perf_counter()
        for keyframe in keyframes:
            query(keyframe)
        whole = (time.perf_counter() - begin) / len(keyframes)

        profiler = cProfile.Profile()
        for keyframe in keyframes:
            profiler.runcall(query, keyframe)
        parts = span_seconds(SPANS, FunctionTimes(profiler), close_query)
        return {WHOLE: whole} | {part: total / len(keyframes) for part, total in parts.items()}

    def _query_function(self, world: World) -> Callable[[int], list[Alignment]]:
        """The alignments of the query at a keyframe, by this system."""
        database = Database(world.work, (DATABASE,), self.settings)
        find = self.system.search(self.settings)
        return partial(close_query, database, world.query, find=find)

    def _answer(
        self,
        world: World,
        keyframe: int,
        seconds: float,
        first: Alignment | None,
        accepted: Alignment | None,
    ) -> Answer:
        """The answer of which ``first`` is most probable by itself, which is its score.

        ``accepted`` may be another alignment, one that is consistent with other queries.
        """

        def errors(alignment: Alignment | None) -> tuple[float, float] | tuple[None, None]:
            if alignment is None:
                return None, None
            return world.errors(
                keyframe,
                world.database.map_T_base[alignment.target_keyframe] @ alignment.target_T_query,
            )

        error_m, error_deg = errors(first)
        accepted_m, accepted_deg = errors(accepted)
        return Answer(
            keyframe,
            seconds,
            float(shipped().own_log_odds(first.features)) if first else -np.inf,
            error_m,
            error_deg,
            True,
            accepted_m,
            accepted_deg,
        )


def sweep_words(
    database: Database, variant: str, allowed: Allowed, query: Query, ground_z: float
) -> tuple[Described, Matches]:
    """Word matches of a query that is turned into every heading and described there (paper 4).

    :func:`semloc_logs.closures.matching.match_words` describes it once: the difference is the gain
    by an encoder that turns with its input.
    """
    settings = database.settings
    descriptor = settings.descriptor
    closures = settings.closures
    v = settings.fusion.voxel_size
    low, high = query.blocks.bounds()
    state = query.blocks.dense(low, tuple((high - low).tolist()))
    encoder = load_encoder(variant, descriptor.weights)
    step = 2 * np.pi / descriptor.headings
    described = []
    matches = []
    rows = 0
    for heading in range(descriptor.headings):
        turned = turned_map(state, low, heading * step)
        words = describe_map(
            turned.state,
            turned.low,
            ground_z,
            encoder,
            Windows(v, descriptor.query_stride, descriptor.min_occupied),
        )
        nearest = database.words(variant).search(
            words.descriptor, closures.neighbours, closures.probes, allowed
        )
        yaw = (np.round(nearest.yaw / step).astype(int) - heading) % descriptor.headings * step
        matches.append(replace(nearest, query=nearest.query + np.int32(rows), yaw=yaw))
        described.append(Described(turned.to_map(words.centre), words.descriptor))
        rows += len(words.descriptor)
    return _joined(described), _joined(matches)


def _joined(parts: Sequence[Arrays]) -> Arrays:
    """Dataclasses of arrays, one after the other."""
    kind = type(parts[0])
    return kind(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(kind)))


def grid_hypotheses(context: QueryContext, count: int | None = None) -> list[Hypothesis]:
    """Every heading every few metres along and across the database's road, without words.

    With ``count``, so many of them at random.
    """
    database = context.visible.database
    settings = database.settings
    step = STEP * settings.fusion.voxel_size / STREET_VOXEL
    yaws = np.split(
        2 * np.pi * np.arange(settings.descriptor.headings) / settings.descriptor.headings,
        [settings.descriptor.headings // 2],
    )
    out: list[Hypothesis] = []
    for group, place in enumerate(database.places):
        target = database.sessions[place.session]
        submap = target.submaps[place.submap]
        ids = np.arange(submap["first"], submap["last"] + 1)
        _, first = np.unique(np.floor(target.distance[ids] / step), return_index=True)
        for pose in target.map_T_base[ids[first]]:
            for across in (-step, 0.0, step):
                # places of opposite headings alternate: the search merges hypotheses at one place
                for half in (0, 1):
                    x, y, z = (
                        pose[:3, 3] + across * pose[:3, 1] + half * step / 2 * pose[:3, 0]
                    ).tolist()
                    out += [Hypothesis(group, (float(yaw), x, y, z), 0, 0.0) for yaw in yaws[half]]
    if count is None or len(out) <= count:
        return out
    rng = np.random.default_rng([GRID_SEED, context.keyframe])
    return [out[i] for i in np.sort(rng.choice(len(out), count, replace=False))]


def settings_of(system: OurSystem, settings: Resolved, folder: Path) -> Resolved:
    """The settings of the queries of ``system``; random weights are kept in ``folder``."""
    update: dict[str, Any] = {
        "query": settings.query.model_copy(update=dict(system.query)),
        "labels": settings.labels.model_copy(update={"source": system.labels}),
    }
    if system.weights == "random":
        files = {
            "weights": folder / "random-weights.safetensors",
            "vocabulary": folder / "random-vocabulary.safetensors",
        }
        update["descriptor"] = settings.descriptor.model_copy(update=files)
    return settings.model_copy(update=update)


def write_random(work: Workspace, settings: Resolved) -> None:
    """Write random weights, and a vocabulary of the database's descriptors by them.

    Only where ``settings`` (see :func:`settings_of`) name them.
    """
    weights = settings.descriptor.weights
    vocabulary = settings.descriptor.vocabulary
    if weights is None or vocabulary is None or vocabulary.exists():
        return
    weights.parent.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(0)
    save_weights(weights, Completion("semantic").eval(), {"note": "random"})
    database = SessionMap(work.session(DATABASE))
    encoder = load_encoder("semantic", weights)
    parts = [
        describe_submap(
            blocks_path(database.folder.blocks, s["id"]),
            s["ground_z"],
            database.road(s),
            encoder,
            settings,
        )
        for s in database.submaps
    ]
    save_vocabulary(
        vocabulary,
        train_vocabulary(np.concatenate([d.descriptor for part in parts for d in part])),
        {"note": "random"},
    )


def link_workspace(source: Workspace, target: Workspace) -> None:
    """Link the sessions of ``source`` without words into ``target``, unless they exist there."""
    for session in source.sessions():
        goal = target.session(session.name)
        if not goal.session_json.exists():
            shutil.rmtree(goal.path, ignore_errors=True)
            left_out: Callable[[str, list[str]], set[str]] = shutil.ignore_patterns(
                "words", "words.json", "session.json"
            )
            shutil.copytree(session.path, goal.path, copy_function=os.link, ignore=left_out)
            os.link(session.session_json, goal.session_json)

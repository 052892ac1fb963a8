"""Our localisation in the benchmark: as it is, with parts of it replaced, and where its time goes."""

from __future__ import annotations

import cProfile
import os
import pstats
import shutil
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from semloc_logs.alignment.hypotheses import Hypothesis
from semloc_logs.alignment.verify import Query
from semloc_logs.benchmarks.localisation.answers import Answer, World, read_world
from semloc_logs.benchmarks.localisation.city import DATABASE, WorldDrive
from semloc_logs.closures import matching
from semloc_logs.closures.acceptance.consistency import decide
from semloc_logs.closures.closure import Alignment
from semloc_logs.closures.database import Database
from semloc_logs.closures.query import query_keyframes
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import STREET_VOXEL, Resolved
from semloc_logs.subvolumes.cut import turned_map
from semloc_logs.subvolumes.describe import Described, describe_map, load_encoder
from semloc_logs.subvolumes.network import Completion
from semloc_logs.subvolumes.submap_descriptors import describe_submap
from semloc_logs.subvolumes.weight_files import save_weights
from semloc_logs.words.index import Allowed, Matches
from semloc_logs.words.vocabulary import save_vocabulary, train_vocabulary
from semloc_logs.workspace import Workspace

STEP = 4.0  # m between hypotheses of the grid along the road, and across it
PROFILED = 30  # queries, one after the other along the road
WHOLE = "whole query"
PARTS = {  # of a query, by the functions that do them
    "fuse": ("queries.py build_query",),
    "describe": ("describe.py describe_map", "cut.py turn"),
    "search words": ("index.py search",),
    "verify": ("closing.py verify_hypotheses",),
    "align and judge": ("closing.py _align",),
}


@dataclass(frozen=True, slots=True)
class OurSystem:
    """A way of asking: ``labels`` of the log or from geometry; how a query is fused, ``weights``
    trained or random; ``hypotheses`` by words, by words of the query described again in every
    heading, of a grid over all of the road, or as many of that grid as words give.
    """

    name: str
    query: tuple[tuple[str, Any], ...] = (("length", 20.0),)
    labels: str = "auto"
    weights: str = "trained"
    hypotheses: str = "words"


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
        """One for each keyframe; the first query is asked twice, to warm up."""
        world = read_world(self.work, self.drive)
        database = Database(world.work, (DATABASE,), self.settings)
        matching.close_query(database, world.query, self.keyframes[0])
        with self._hypotheses():
            asked = [self._ask(database, world, k) for k in self.keyframes]
        maps = {self.drive.name: world.query, DATABASE: world.database}
        decided = decide([a for _, found in asked for a in found], maps, self.settings)
        accepted = {a.query_keyframe: a for a in decided if a.accepted}
        return [
            self._answer(world, k, *said, accepted.get(k))
            for k, said in zip(self.keyframes, asked, strict=True)
        ]

    def profile(self) -> dict[str, float]:
        """Seconds of a query when they come one after the other, as `semloc close` asks, and of its
        parts, under the profiler.
        """
        world = read_world(self.work, self.drive)
        database = Database(world.work, (DATABASE,), self.settings)
        every = query_keyframes(world.query, self.settings)
        asked = every[max(0, (len(every) - PROFILED) // 2) :][:PROFILED]
        profiler = cProfile.Profile()
        with self._hypotheses():
            matching.close_query(database, world.query, asked[0])
            begin = time.perf_counter()
            for keyframe in asked:
                matching.close_query(database, world.query, keyframe)
            whole = (time.perf_counter() - begin) / len(asked)
            for keyframe in asked:
                profiler.runcall(matching.close_query, database, world.query, keyframe)
        return {WHOLE: whole} | {
            part: seconds / len(asked) for part, seconds in _parts(profiler).items()
        }

    def _hypotheses(self) -> Any:
        if self.system.hypotheses == "words":
            return nullcontext()
        if self.system.hypotheses == "sweep":
            return patch.object(matching, "match_words", sweep_words)
        most = self.settings.closures.hypotheses if self.system.hypotheses == "some" else None
        return patch.object(matching, "find_hypotheses", partial(grid_hypotheses, most=most))

    def _ask(
        self, database: Database, world: World, keyframe: int
    ) -> tuple[float, list[Alignment]]:
        begin = time.perf_counter()
        found = matching.close_query(database, world.query, keyframe)
        return time.perf_counter() - begin, found

    def _answer(
        self,
        world: World,
        keyframe: int,
        seconds: float,
        found: list[Alignment],
        accepted: Alignment | None,
    ) -> Answer:
        """First is what is most probable by itself, which is its score; accepted may be another
        one, that other queries agree with.
        """

        def errors(alignment: Alignment | None) -> tuple[float, float] | tuple[None, None]:
            if alignment is None:
                return None, None
            return world.errors(
                keyframe,
                world.database.map_T_base[alignment.target_keyframe] @ alignment.target_T_query,
            )

        first = found[0] if found else None
        (m, deg), (accepted_m, accepted_deg) = errors(first), errors(accepted)
        return Answer(
            keyframe,
            seconds,
            first.probability if first else -np.inf,
            m,
            deg,
            True,
            accepted_m,
            accepted_deg,
        )


def _parts(profiler: cProfile.Profile) -> dict[str, float]:
    """Seconds of each of ``PARTS`` and of the rest."""
    total: dict[str, float] = {}
    for (path, _, name), (_, _, _, cumulative, _) in pstats.Stats(profiler).stats.items():  # type: ignore[attr-defined]
        key = f"{Path(path).name} {name}"
        total[key] = total.get(key, 0.0) + cumulative
    out = {part: sum(total.get(f, 0.0) for f in functions) for part, functions in PARTS.items()}
    return out | {"rest": max(0.0, total.get("closing.py close_query", 0.0) - sum(out.values()))}


def sweep_words(
    database: Database, variant: str, allowed: Allowed, query: Query, ground_z: float
) -> tuple[Described, Matches]:
    """What :func:`semloc_logs.closures.matching.match_words` finds when the query is turned into
    every heading and described there, as by the paper (4), instead of once: what an encoder that
    turns with its input saves.
    """
    settings = database.settings
    descriptor = settings.descriptor
    closures = settings.closures
    v = settings.fusion.voxel_size
    low, high = query.blocks.bounds()
    state = query.blocks.dense(low, tuple((high - low).tolist()))
    encoder = load_encoder(variant, descriptor.weights)
    step = 2 * np.pi / descriptor.headings
    words = []
    found = []
    rows = 0
    for heading in range(descriptor.headings):
        turned = turned_map(state, low, heading * step)
        d = describe_map(
            turned.state,
            turned.low,
            ground_z,
            v,
            encoder,
            descriptor.query_stride,
            descriptor.min_occupied,
        )
        m = database.words(variant).search(
            d.descriptor, closures.neighbours, closures.probes, allowed
        )
        yaw = (np.round(m.yaw / step).astype(int) - heading) % descriptor.headings * step
        found.append(replace(m, query=m.query + np.int32(rows), yaw=yaw))
        words.append(Described(turned.to_map(d.centre), d.descriptor))
        rows += len(d.descriptor)
    described = Described(
        *(np.concatenate([getattr(d, f.name) for d in words]) for f in fields(Described))
    )
    return described, Matches(
        *(np.concatenate([getattr(m, f.name) for m in found]) for f in fields(Matches))
    )


def grid_hypotheses(
    database: Database, session: SessionMap, keyframe: int, query: Query, most: int | None = None
) -> list[Hypothesis]:
    """Instead of word matches: every heading every few metres along and across the database's road,
    or ``most`` of these at random.
    """
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
                # opposite headings lie between each other: the search takes two at one place for
                # the same
                for half in (0, 1):
                    x, y, z = (
                        pose[:3, 3] + across * pose[:3, 1] + half * step / 2 * pose[:3, 0]
                    ).tolist()
                    out += [Hypothesis(group, (float(yaw), x, y, z), 0, 0.0) for yaw in yaws[half]]
    if most is None or len(out) <= most:
        return out
    rng = np.random.default_rng([7, keyframe])
    return [out[i] for i in np.sort(rng.choice(len(out), most, replace=False))]


def settings_of(system: OurSystem, settings: Resolved, folder: Path) -> Resolved:
    """The settings that ``system`` asks with; random weights are kept in ``folder``."""
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
    """Random weights and a vocabulary of the database's descriptors by them, where ``settings``
    (see :func:`settings_of`) name them.
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
            database.folder, s["id"], s["ground_z"], database.road(s), encoder, settings
        )
        for s in database.submaps
    ]
    save_vocabulary(
        vocabulary,
        train_vocabulary(np.concatenate([d.descriptor for part in parts for d in part])),
        {"note": "random"},
    )


def link_workspace(source: Workspace, target: Workspace) -> None:
    """The sessions of ``source`` without their words, as hard links in ``target``, unless they are
    there.
    """
    for session in source.sessions():
        goal = target.session(session.name)
        if not goal.session_json.exists():
            shutil.rmtree(goal.path, ignore_errors=True)
            left_out: Callable[[str, list[str]], set[str]] = shutil.ignore_patterns(
                "words", "words.json", "session.json"
            )
            shutil.copytree(session.path, goal.path, copy_function=os.link, ignore=left_out)
            os.link(session.session_json, goal.session_json)

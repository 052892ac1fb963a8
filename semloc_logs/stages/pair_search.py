"""Words -> alignments of each pair of sessions: the missing ones are searched."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from semloc_logs import progress
from semloc_logs.closures.exclusions import Exclusions
from semloc_logs.closures.query import query_keyframes
from semloc_logs.closures.search_tasks import SearchTask, block_size, search_queries
from semloc_logs.closures.session_pairs import (
    Missing,
    Pair,
    finish,
    forget,
    known_pair,
    known_pairs,
    missing,
    pairs_of_sessions,
)
from semloc_logs.engines import Engine
from semloc_logs.errors import WorkspaceError
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import Resolved
from semloc_logs.stages.describe import check_settings, is_described, words_fingerprints
from semloc_logs.stages.inputs import fingerprint_of
from semloc_logs.stages.state import OF_DECISION
from semloc_logs.subvolumes.submap_descriptors import variants_for
from semloc_logs.tables.metadata import map_metadata
from semloc_logs.workspace import Workspace

QUERIES_A_TASK = 8  # or more, as tasks hold whole blocks
Maps = Mapping[str, SessionMap]


@dataclass(frozen=True, slots=True)
class Selection:
    """Sessions to search and sessions to search them in; all where empty.

    It restricts the search; known alignments stay.
    """

    queries: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    self_closures: bool = True

    def has(self, pair: Pair) -> bool:
        """Whether a pair is to be searched; which of the two was recorded later does not matter."""
        if pair.query == pair.target and not self.self_closures:
            return False
        return any(
            (not self.queries or query in self.queries)
            and (not self.targets or target in self.targets)
            for query, target in ((pair.query, pair.target), (pair.target, pair.query))
        )


EVERYTHING = Selection()


@dataclass(frozen=True, slots=True)
class PairSearch:
    """The pairs of a workspace to search: all that are ``chosen`` and not up to date.

    ``fingerprints`` are of what the alignments of every pair depend on, ``known`` of the
    alignments that are there. ``alone``: this process searches one pair, while others search
    others. ``exclusions``: pairs that are not searched.
    """

    work: Workspace
    maps: Maps
    settings: Resolved
    fingerprints: Mapping[Pair, str]
    known: Mapping[Pair, str]
    chosen: Sequence[Pair]
    exclusions: Exclusions
    alone: bool = False

    @classmethod
    def of_pair(cls, work: Workspace, settings: Resolved, pair: Pair) -> PairSearch:
        """Of one pair, chosen where it is not up to date. WorkspaceError for another direction."""
        sessions = work.chosen(sorted({pair.query, pair.target}))
        maps = {folder.name: SessionMap(folder) for folder in sessions}
        for session in maps.values():
            check_settings(session, settings)
        fingerprints = {p: f for p, f in pair_fingerprints(maps, settings).items() if p == pair}
        if not fingerprints:
            raise WorkspaceError(
                f"{pair.query} was recorded before {pair.target}, so that the search is"
                f" 'search/{pair.target}/{pair.query}': 'semloc tasks search -w {work.path}' lists"
                " all."
            )
        known = known_pair(work, pair)
        exclusions = Exclusions.of(maps, settings)
        is_missing = known.get(pair) != fingerprints[pair] and not exclusions.has(pair)
        chosen = [pair] if is_missing else []
        _check_words(work, chosen, maps, settings)
        return cls(work, maps, settings, fingerprints, known, chosen, exclusions, alone=True)

    @classmethod
    def of(
        cls,
        work: Workspace,
        settings: Resolved,
        selection: Selection = EVERYTHING,
        *,
        overwrite: bool = False,
    ) -> PairSearch:
        """WorkspaceError where a session or its words are missing."""
        work.chosen((*selection.queries, *selection.targets))
        maps = {folder.name: SessionMap(folder) for folder in work.chosen(())}
        for session in maps.values():
            check_settings(session, settings)
        exclusions = Exclusions.of(maps, settings)
        fingerprints = pair_fingerprints(maps, settings)
        known = known_pairs(work)
        chosen = [
            pair
            for pair, fingerprint in fingerprints.items()
            if selection.has(pair)
            and not exclusions.has(pair)
            and (overwrite or known.get(pair) != fingerprint)
        ]
        _check_words(work, chosen, maps, settings)
        return cls(work, maps, settings, fingerprints, known, chosen, exclusions)

    def run(self, engine: Engine) -> int:
        """Search the pairs, and return the number of searches of one query in one session.

        Each session that is done gets its tables of alignments. A session whose search was
        interrupted goes on where it was. Alignments that belong to no present pair are removed.
        """
        for pair in self.chosen:
            if self.known.get(pair) == self.fingerprints[pair]:  # to be overwritten
                shutil.rmtree(self.work.search_parts(pair.query), ignore_errors=True)
        if not self.alone:
            self._remove_old_parts()
        sessions = self._missing()
        words = words_fingerprints(self.maps, self.settings)
        tasks = [task for one in sessions for task in self._tasks(one, words)]
        results = zip(tasks, engine.map(search_queries, tasks), strict=True)
        searches = sum(len(task.keyframes) for task in tasks)
        searched = 0
        progress.report_start("close", searches, "queries")
        for one in sessions:
            of_session = [task for task in tasks if task.session == one.session]
            total = sum(len(task.keyframes) for task in of_session)
            done = 0
            for task in of_session:
                next(results)
                done += len(task.keyframes)
                progress.report("close", one.session, done, total, "queries")
                progress.report("close", "", searched + done, searches, "queries")
            searched += total
            finish(self.work, self._left(one), self._metadata(one))
        stale = [p for p, made_from in self.known.items() if made_from != self.fingerprints.get(p)]
        forget(self.work, [p for p in stale if p not in self.chosen])
        return sum(len(task.keyframes) * len(task.targets) for task in tasks)

    def searched(self) -> dict[Pair, str]:
        """The pairs whose alignments are there after a run, with their fingerprints."""
        present = {p: f for p, f in self.known.items() if f == self.fingerprints.get(p)}
        return present | {pair: self.fingerprints[pair] for pair in self.chosen}

    def _missing(self) -> list[Missing]:
        """What is left to search of each session."""
        block = block_size(self.settings)
        size = block * -(-QUERIES_A_TASK // block)
        of_targets: dict[str, dict[str, str]] = {}
        for pair in self.chosen:
            of_targets.setdefault(pair.query, {})[pair.target] = self.fingerprints[pair]
        out = []
        for session, fingerprints in of_targets.items():
            keyframes = query_keyframes(self.maps[session], self.settings)
            chunks = [
                tuple(keyframes[first : first + size]) for first in range(0, len(keyframes), size)
            ]
            alone = next(iter(fingerprints)) if self.alone else None
            out.append(missing(self.work, session, fingerprints, chunks, alone))
        return out

    def _left(self, one: Missing) -> Missing:
        """The same after some tasks are done."""
        alone = next(iter(one.fingerprints)) if self.alone else None
        return missing(self.work, one.session, one.fingerprints, one.chunks, alone)

    def _remove_old_parts(self) -> None:
        """Remove parts of searches that are over, or of sessions that are gone."""
        open_searches = {
            p.query for p, made_from in self.fingerprints.items() if self.known.get(p) != made_from
        }
        for folder in self.work.all_search_parts.glob("*"):
            if folder.name not in open_searches:
                shutil.rmtree(folder, ignore_errors=True)

    def _tasks(self, one: Missing, words: Mapping[str, str]) -> list[SearchTask]:
        path = self.work.path.absolute()
        of_targets = {name: words[name] for name in one.fingerprints}
        tasks = []
        for chunk in one.chunks:
            targets = one.targets(chunk)
            if targets:
                name = f"{chunk[0]:06d}-{fingerprint_of(targets.values())}.parquet"
                output = one.folder.absolute() / name
                tasks.append(
                    SearchTask(path, one.session, chunk, targets, of_targets, self.settings, output)
                )
        return tasks

    def _metadata(self, one: Missing) -> dict[str, dict[str, Any]]:
        """Of the table of each target."""
        return {
            target: metadata_of(self.settings, (self.maps[one.session], self.maps[target]))
            for target in one.fingerprints
        }


def metadata_of(settings: Resolved, maps: Iterable[SessionMap]) -> dict[str, Any]:
    """The metadata that tables about some sessions share."""
    sources = ",".join(sorted({m.label_source for m in maps}))
    return map_metadata(settings.fusion.voxel_size, np.eye(4), sources)


def pair_fingerprints(maps: Maps, settings: Resolved) -> dict[Pair, str]:
    """All pairs, with what their alignments depend on."""
    words = words_fingerprints(maps, settings)
    used = settings.tables("query", "closures")
    for key in OF_DECISION:
        section, name = key.split(".")
        del used[section][name]
    return {
        pair: fingerprint_of((words[pair.query], words[pair.target], repr(used)))
        for pair in pairs_of_sessions(maps)
    }


def _check_words(work: Workspace, pairs: Iterable[Pair], maps: Maps, settings: Resolved) -> None:
    """WorkspaceError where a session lacks words that a pair is searched with."""
    needed: dict[str, set[str]] = {}
    for pair in pairs:
        both = {pair.query, pair.target}
        sources = [maps[name].label_source for name in both]
        # classes are compared where both ends know them
        common = set.intersection(*(set(variants_for(s, sources, settings)) for s in sources))
        for name in both:
            needed.setdefault(name, set()).update(common)
    for name, variants in sorted(needed.items()):
        maps[name].check_version()
        if not is_described(maps[name], variants, settings):
            raise WorkspaceError(
                f"Session {name} lacks {' and '.join(sorted(variants))} words of its present map"
                f" and settings: run 'semloc describe -w {work.path}' first."
            )

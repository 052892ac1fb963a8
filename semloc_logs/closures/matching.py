"""One query against the database: words, hypotheses, verified alignments (paper 3.4, 3.5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.covariance import covariance_of, stiffness
from semloc_logs.alignment.hypotheses import Hypothesis, keep_best_submaps, pool, same_place
from semloc_logs.alignment.icp import Fit
from semloc_logs.alignment.query_map import Query
from semloc_logs.alignment.refine import coarse_fit, escaped, fine_fit, measured
from semloc_logs.alignment.scores import MutualScores, mutual_scores, mutual_shares
from semloc_logs.alignment.search import Candidate, search_hypotheses
from semloc_logs.alignment.target_map import is_uncertain
from semloc_logs.alignment.tau import tau
from semloc_logs.arrays import F64, I64
from semloc_logs.closures.closure import Alignment, Features
from semloc_logs.closures.database import Database
from semloc_logs.closures.query import build_query, query_members, stretch
from semloc_logs.closures.target_surface import target_surface
from semloc_logs.closures.visibility import Visibility, visible_to
from semloc_logs.labels.space import cityscapes
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply, inverse, turned_about_z
from semloc_logs.settings import STREET_VOXEL, Resolved
from semloc_logs.subvolumes.describe import (
    Described,
    Windows,
    describe_map,
    load_encoder,
    quarter_turns,
)
from semloc_logs.words.index import Allowed, LookUp, Matches, look_ups
from semloc_logs.words.vocabulary import load_vocabulary

VOTE_CELL = 2.4  # m, at voxels of 0.30 m: edge of the cells that word matches vote in
# the weight of a word match falls to LEAST_WEIGHT at so many bits between the words
FAR_WORD = 32.0
LEAST_WEIGHT = 1e-3
# of the best score, and a score: right alignments have more
MIN_RELATIVE_SCORE = 0.8
MIN_SCORE = 0.25

Prepared = tuple[Described, list[list[LookUp]]]
# of each query by what its words depend on
_PREPARED: WeakKeyDictionary[Query, dict[tuple[Any, ...], Prepared]] = WeakKeyDictionary()


@dataclass(frozen=True, slots=True, eq=False)
class QueryContext:
    """The query at ``keyframe`` of ``session`` and what it may see.

    ``query_T_base`` (4, 4) is the base in the level frame of the ``query``.
    """

    visible: Visibility
    session: SessionMap
    keyframe: int
    query: Query
    query_T_base: F64

    @property
    def settings(self) -> Resolved:
        return self.visible.database.settings

    @property
    def voxel_size(self) -> float:
        return self.settings.fusion.voxel_size

    @property
    def ground_z(self) -> float:
        """Height of the ground under the query in its frame, metres."""
        return ground_below(self.session, self.keyframe)

    def target_session(self, group: int) -> SessionMap:
        return self.visible.database.session(group)


def ground_below(session: SessionMap, keyframe: int) -> float:
    """Height of the ground under the query at ``keyframe`` in its frame, metres."""
    return float(session.ground_z[keyframe] - session.map_T_base[keyframe][2, 3])


# how hypotheses of a query are found, and how the words of a query whose ground is at a height are
# matched; benchmarks compare other ways with the package's own
FindHypotheses = Callable[[QueryContext], list[Hypothesis]]
MatchWords = Callable[[Database, str, Allowed, Query, float], tuple[Described, Matches]]


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A candidate after a fit on the points.

    ``nearest`` is the target's keyframe nearest to it, ``view`` (3,) where the query looks, in the
    target's map, ``keyframes`` (n,) of it that saw this; ``range_sigma`` the median standard
    deviation of points along their rays, metres, of the query or of the target's surface, whichever
    is larger.
    """

    candidate: Candidate
    nearest: int
    view: F64
    keyframes: I64
    fit: Fit
    scores: MutualScores
    range_sigma: float


def close_query(
    database: Database, session: SessionMap, keyframe: int, find: FindHypotheses | None = None
) -> list[Alignment]:
    """Alignments of the query at ``keyframe`` with every target session, best first.

    Hypotheses come from ``find``, by default :func:`find_hypotheses`.
    """
    query = build_query(session, keyframe, database.settings)
    return search_query(database, session, keyframe, query, find)


def search_query(
    database: Database,
    session: SessionMap,
    keyframe: int,
    built: tuple[Query, F64],
    find: FindHypotheses | None = None,
    *,
    least_agreement: float = 0.0,
) -> list[Alignment]:
    """The same of a query that is built already, with its ``query_T_base``.

    There are none where no hypothesis has ``least_agreement``.
    """
    query, query_T_base = built
    if not len(query.structure[0]):
        return []

    context = QueryContext(
        visible_to(database, session, keyframe), session, keyframe, query, query_T_base
    )
    hypotheses = (find or find_hypotheses)(context)
    if max((h.agreement for h in hypotheses), default=0.0) < least_agreement:
        return []
    alignments = [
        alignment
        for candidates in verify_hypotheses(context, hypotheses)
        for alignment in align_candidates(context, candidates)
    ]
    return sorted(
        alignments,
        key=lambda a: (
            a.features.contradiction - a.features.structure,
            a.target_session,
            a.target_stamp_ns,
        ),
    )


# -- words


def allowed_words(visible: Visibility, session: SessionMap) -> dict[str, Allowed]:
    """Which words may match, by their variant: semantic where both label sources know classes.

    Of the query's own session only words of another time may (:mod:`.visibility`).
    """
    database = visible.database
    forced = database.settings.descriptor.variant
    semantic = (
        database.has_classes & session.has_classes
        if forced == "auto"
        else np.full(len(database.places), forced == "semantic")
    )
    submaps = visible.submaps()
    groups = {"semantic": submaps & semantic, "geometric": submaps & ~semantic}
    return {
        variant: visible.allowed_words(variant, chosen)
        for variant, chosen in groups.items()
        if chosen.any()
    }


def match_words(
    database: Database, variant: str, allowed: Allowed, query: Query, ground_z: float
) -> tuple[Described, Matches]:
    """The subvolumes of a query, described once, and their nearest words in all headings.

    The query's ground is at ``ground_z`` (m). The ``yaw`` of a match is of ``target_T_query``.
    """
    index = database.words(variant)
    described, prepared = prepare(query, variant, ground_z, database.settings)
    closures = database.settings.closures
    quarters = [index.find(batches, closures.neighbours, allowed) for batches in prepared]
    return described, turned_matches(quarters)


def turned_matches(quarters: Sequence[Matches]) -> Matches:
    """The matches of a query's words in each quarter turn, with the yaw of ``target_T_query``."""
    turned = [
        replace(matches, yaw=np.mod(matches.yaw + turns * np.pi / 2, 2 * np.pi))
        for turns, matches in enumerate(quarters)
    ]
    columns = (np.concatenate([getattr(m, f.name) for m in turned]) for f in fields(Matches))
    return Matches(*columns)


def prepare(query: Query, variant: str, ground_z: float, settings: Resolved) -> Prepared:
    """The subvolumes of a query and their look-ups in each quarter turn, once for all targets."""
    of_query = _PREPARED.setdefault(query, {})
    probes = settings.closures.probes
    key = (variant, ground_z, settings.descriptor, settings.fusion.voxel_size, probes)
    if key not in of_query:
        described = _describe(query, variant, ground_z, settings)
        turned = (quarter_turns(described.descriptor, turns) for turns in range(4))
        vocabulary = load_vocabulary(variant, settings.descriptor.vocabulary)
        of_query[key] = (
            described,
            [look_ups(vocabulary, descriptors, probes) for descriptors in turned],
        )
    return of_query[key]


def _describe(query: Query, variant: str, ground_z: float, settings: Resolved) -> Described:
    descriptor = settings.descriptor
    low, high = query.blocks.bounds()
    return describe_map(
        query.blocks.dense(low, tuple((high - low).tolist())),
        low,
        ground_z,
        load_encoder(variant, descriptor.weights),
        Windows(settings.fusion.voxel_size, descriptor.query_stride, descriptor.min_occupied),
    )


# -- hypotheses


def find_hypotheses(context: QueryContext, match: MatchWords = match_words) -> list[Hypothesis]:
    """Word matches of the query in all headings, pooled for each target session.

    ``match`` finds the matches.
    """
    database = context.visible.database
    closures = context.settings.closures
    parts = [
        _votes(context, variant, allowed, match)
        for variant, allowed in allowed_words(context.visible, context.session).items()
    ]
    if not parts:
        return []
    group, yaw, translation, weight = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )

    # each target session has its share, whatever the others have
    owner = np.array([place.session for place in database.places], dtype=object)[group]
    cell = VOTE_CELL * context.voxel_size / STREET_VOXEL
    hypotheses: list[Hypothesis] = []
    for name in database.sessions:
        rows = np.flatnonzero(owner == name)
        pooled = pool(
            group[rows], yaw[rows], translation[rows], weight[rows], cell, closures.hypotheses
        )
        hypotheses += keep_best_submaps(pooled, closures.places)
    return hypotheses


def _votes(
    context: QueryContext, variant: str, allowed: Allowed, match: MatchWords
) -> tuple[NDArray[np.int64], F64, F64, F64]:
    """Submap (n,), yaw (n,), translation (n, 3) and weight (n,) that each word match votes for."""
    described, matches = match(
        context.visible.database, variant, allowed, context.query, context.ground_z
    )
    centre = described.centre[matches.query].astype(float) * context.voxel_size
    translation = matches.centre - turned_about_z(centre, matches.yaw)
    weight = np.maximum(0.0, 1.0 - matches.distance / FAR_WORD) ** 2 + LEAST_WEIGHT
    return matches.group, matches.yaw, translation, weight


def verify_hypotheses(context: QueryContext, hypotheses: list[Hypothesis]) -> list[list[Candidate]]:
    """The best candidates in each target session after the search over their voxels."""
    database = context.visible.database
    headings = context.settings.descriptor.headings
    most = context.settings.closures.candidates
    candidates = []
    for name in database.sessions:
        in_session = [h for h in hypotheses if database.places[h.group].session == name]
        targets = {g: context.visible.target(g) for g in {h.group for h in in_session}}
        candidates.append(search_hypotheses(in_session, targets, context.query, headings, most))
    return candidates


# -- alignments


def align_candidates(context: QueryContext, candidates: list[Candidate]) -> list[Alignment]:
    """Candidates in one target session, aligned on the points and compared with each other.

    All of them, as rivals tell how distinct the best one is.
    """
    coarse = _each_place_once([_coarse(context, c) for c in candidates], context.voxel_size)
    fine: list[Fitted] = []
    for fitted in coarse[: max(1, context.settings.closures.rejected_per_query)]:
        best = max((f.scores.score for f in fine), default=0.0)
        fine.append(_fine(context, fitted, best))
    fine = _each_place_once(fine, context.voxel_size)
    return [_alignment(context, f) for f in fine]


def _coarse(context: QueryContext, candidate: Candidate) -> Fitted:
    """A candidate aligned with the target's voxels."""
    visible = context.visible
    query = context.query
    group = candidate.group
    target = visible.target(group)
    view = apply(candidate.target_T_query, query.view_centre[None])[0]
    fit = coarse_fit(candidate, target, query)
    fit = escaped(fit, candidate, target, query, context.settings.descriptor.headings)
    return Fitted(
        candidate,
        visible.nearest_keyframe(group, candidate.target_T_query[:3, 3]),
        view,
        np.array([visible.viewing_keyframe(group, view)]),
        fit,
        mutual_scores(query, target, fit.target_T_query),
        query.sigma,
    )


def _fine(context: QueryContext, fitted: Fitted, best_score: float) -> Fitted:
    """A coarse fit aligned with the target's points, if it may be accepted beside ``best_score``.

    Reading keyframes takes longer than fitting them, so other fits are only measured on voxels.
    """
    query = context.query
    group = fitted.candidate.group
    target = context.visible.target(group)
    start = fitted.fit.target_T_query
    if fitted.scores.score < max(MIN_RELATIVE_SCORE * best_score, MIN_SCORE):
        return replace(fitted, fit=measured(start, target.surface, query))
    around = target_surface(context.visible, group, fitted.view)
    surface = around.surface
    fit = fine_fit(start, surface, query)
    return replace(
        fitted,
        keyframes=around.keyframes,
        fit=fit,
        scores=mutual_scores(query, target, fit.target_T_query),
        range_sigma=max(query.sigma, surface.sigma),
    )


def _each_place_once(fitted: list[Fitted], voxel_size: float) -> list[Fitted]:
    """Best first, each place once."""
    kept: list[Fitted] = []
    for f in sorted(fitted, key=lambda f: -f.scores.score):
        pose = f.fit.target_T_query
        if not any(same_place(pose, other.fit.target_T_query, voxel_size) for other in kept):
            kept.append(f)
    return kept


def _alignment(context: QueryContext, fitted: Fitted) -> Alignment:
    """The alignment of one candidate with its features and covariance."""
    visible = context.visible
    session = context.session
    group = fitted.candidate.group
    target_session = context.target_session(group)
    features = _features(fitted, context.voxel_size)
    overlap, inliers = _overlap(context, fitted)

    map_T_query_base = fitted.fit.target_T_query @ context.query_T_base
    nearest = visible.nearest_keyframe(group, map_T_query_base[:3, 3])
    map_T_target = target_session.map_T_base[nearest]
    members = query_members(session, context.keyframe, context.settings)
    return Alignment(
        query_session=session.folder.name,
        target_session=target_session.folder.name,
        query_keyframe=context.keyframe,
        target_keyframe=nearest,
        query_stamp_ns=int(session.stamps_ns[context.keyframe]),
        target_stamp_ns=int(target_session.stamps_ns[nearest]),
        target_T_query=inverse(map_T_target) @ map_T_query_base,
        covariance=covariance_of(
            fitted.fit,
            map_T_query_base,
            map_T_target,
            context.voxel_size,
            (
                stretch(session, context.keyframe, members),
                stretch(target_session, nearest, fitted.keyframes),
            ),
            uncertain=is_uncertain(fitted.range_sigma, context.voxel_size),
        ),
        overlap=overlap,
        inliers=inliers,
        words=fitted.candidate.votes,
        features=features,
    )


def _features(fitted: Fitted, voxel_size: float) -> Features[float]:
    """The evidence of both sides: the query on the target's map, and this on the query's."""
    forward, reverse = fitted.scores
    structure, contradiction = mutual_shares(forward, reverse)
    return Features(
        structure=structure,
        coverage=forward.coverage,
        contradiction=contradiction,
        fit=fitted.fit.inliers,
        support=float(np.log10(forward.aligned + reverse.aligned + 1)),
        stiffness=float(np.log10(stiffness(fitted.fit) + 1)),
        range_sigma=fitted.range_sigma / voxel_size,
    )


def _overlap(context: QueryContext, fitted: Fitted) -> tuple[float, int]:
    """The paper's tau and the number of aligned voxels.

    Classes are compared as they are where both label sources are the same, else coarsely.
    """
    group = fitted.candidate.group
    sources = (
        session.json["label_source"] for session in (context.session, context.target_session(group))
    )
    return tau(
        context.query.occupied,
        context.visible.target(group).blocks,
        context.voxel_size,
        fitted.fit.target_T_query,
        context.settings.closures.kappa * context.voxel_size,
        None if len(set(sources)) == 1 else cityscapes().coarse,
    )

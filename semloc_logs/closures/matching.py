"""One query against the database: words -> hypotheses -> verified alignments -> closures and
rejections (paper 3.4, 3.5).
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.hypotheses import Hypothesis, of_best_groups, pool
from semloc_logs.alignment.icp import Fit
from semloc_logs.alignment.overlap import tau, yaw_between
from semloc_logs.alignment.verify import (
    Candidate,
    Features,
    Query,
    Scores,
    coarse_fit,
    escaped,
    fine_fit,
    measured,
    same_place,
    search_hypotheses,
    structure_scores,
)
from semloc_logs.closures.acceptance.calibration import CLOSE, HOPELESS, own_values, shipped
from semloc_logs.closures.closure import Agreement, Alignment
from semloc_logs.closures.database import Database, open_database
from semloc_logs.closures.query import build_query
from semloc_logs.labels.space import cityscapes
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply, inverse, turned_about_z
from semloc_logs.settings import STREET_VOXEL, Resolved
from semloc_logs.subvolumes.describe import Described, describe_map, load_encoder, quarter_turns
from semloc_logs.words.index import Allowed, Matches
from semloc_logs.workspace import Workspace

F64 = NDArray[np.float64]
# candidates of a target session that are fitted on the points: also hopeless ones tell which
# streets look like others
ALIGNED = 4
LEAST_HYPOTHESES = 16  # for a target session, however many there are
NORMAL_NOISE = np.radians(2.0)
INFLATION = 12.0  # of the covariance: neighbouring points share their errors
# standard deviations that uncertain ranges of a query, and of a target, may all be off by
SYSTEMATIC = 1.0
# of the variance of that: what query and target have in common, and cancels where both look the
# same way
COMMON = 0.5
DRIFT = 0.01  # of the way: the odometry of a target
FLOOR = np.diag([1e-4] * 3 + [1e-6] * 3)  # 1 cm and 1 mrad


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A candidate after a fit on the points; ``nearest`` is the target's keyframe nearest to it,
    ``sees`` (3,) what the query looks at, in the target's map.
    """

    candidate: Candidate
    nearest: int
    sees: F64
    fit: Fit
    scores: Scores


@dataclass(frozen=True, slots=True)
class CloseTask:
    """Some queries of one session against target sessions; picklable."""

    work: Path
    session: str
    keyframes: tuple[int, ...]
    targets: tuple[str, ...]
    settings: Resolved


def close_queries(task: CloseTask) -> list[list[Alignment]]:
    """For each keyframe of the task the alignments found, best first; not yet accepted or rejected."""
    database = open_database(task.work, task.targets, task.settings)
    session = SessionMap(Workspace(task.work).session(task.session))
    return [close_query(database, session, k) for k in task.keyframes]


def close_query(database: Database, session: SessionMap, keyframe: int) -> list[Alignment]:
    """Alignments of the query at ``keyframe`` with every target session, best first."""
    database = database.asked_by(session, keyframe)
    query, query_T_base = build_query(session, keyframe, database.settings)
    if not len(query.structure[0]):
        return []
    hypotheses = find_hypotheses(database, session, keyframe, query)
    candidates = verify_hypotheses(database, query, hypotheses)
    out: list[Alignment] = []
    by_session: dict[str, list[Candidate]] = defaultdict(list)
    for c in candidates:
        by_session[database.places[c.group].session].append(c)
    for found in by_session.values():
        out += _align(database, session, keyframe, query, query_T_base, found)
    return sorted(
        out,
        key=lambda a: (-a.probability, -a.features.structure, a.target_session, a.target_stamp_ns),
    )


def allowed_places(database: Database, session: SessionMap) -> dict[str, Allowed]:
    """Which words may answer, by the variant of the words: semantic where both label sources know
    classes.

    Of the query's own session those where it came by at another time (:meth:`Database.asked_by`).
    """
    forced = database.settings.descriptor.variant
    semantic = (
        database.has_classes & session.has_classes
        if forced == "auto"
        else np.full(len(database.places), forced == "semantic")
    )
    seen = database.seen()
    groups = {"semantic": seen & semantic, "geometric": seen & ~semantic}
    return {
        variant: database.allowed(variant, mine) for variant, mine in groups.items() if mine.any()
    }


def match_words(
    database: Database, variant: str, allowed: Allowed, query: Query, ground_z: float
) -> tuple[Described, Matches]:
    """The subvolumes of a query whose ground is at ``ground_z`` (m), described once, and their
    nearest words in all headings.

    The matches' ``yaw`` is that of ``target_T_query``.
    """
    settings = database.settings
    descriptor = settings.descriptor
    closures = settings.closures
    low, high = query.blocks.bounds()
    state = query.blocks.dense(low, tuple((high - low).tolist()))
    encoder = load_encoder(variant, descriptor.weights)
    d = describe_map(
        state,
        low,
        ground_z,
        settings.fusion.voxel_size,
        encoder,
        descriptor.query_stride,
        descriptor.min_occupied,
    )
    found = []
    for turns in range(4):
        m = database.words(variant).search(
            quarter_turns(d.descriptor, turns), closures.neighbours, closures.probes, allowed
        )
        found.append(replace(m, yaw=np.mod(m.yaw + turns * np.pi / 2, 2 * np.pi)))
    return d, Matches(
        *(np.concatenate([getattr(m, f.name) for m in found]) for f in fields(Matches))
    )


def find_hypotheses(
    database: Database, session: SessionMap, keyframe: int, query: Query
) -> list[Hypothesis]:
    """Word matches of the query in all headings, pooled."""
    settings = database.settings
    closures = settings.closures
    v = settings.fusion.voxel_size
    parts: list[tuple[NDArray[np.int64], F64, F64, F64]] = []
    ground = float(session.ground_z[keyframe] - session.map_T_base[keyframe][2, 3])
    for variant, allowed in allowed_places(database, session).items():
        d, m = match_words(database, variant, allowed, query, ground)
        shift = m.centre - turned_about_z(d.centre[m.query].astype(float) * v, m.yaw)
        parts.append((m.group, m.yaw, shift, np.maximum(0.0, 1.0 - m.distance / 32.0) ** 2 + 1e-3))
    if not parts:
        return []
    group, yaws, shift, weight = (np.concatenate([p[k] for p in parts]) for k in range(4))
    # each target session has its share, so that one that looks alike everywhere cannot crowd out
    # the others
    owner = np.array([place.session for place in database.places], dtype=object)[group]
    most = max(LEAST_HYPOTHESES, closures.hypotheses // len(database.sessions))
    found: list[Hypothesis] = []
    for name in database.sessions:
        mine = np.flatnonzero(owner == name)
        found += pool(
            group[mine], yaws[mine], shift[mine], weight[mine], 2.4 * v / STREET_VOXEL, most
        )
    return of_best_groups(found, closures.places)


def verify_hypotheses(
    database: Database, query: Query, hypotheses: list[Hypothesis]
) -> list[Candidate]:
    """The best candidates of each target session after the search over their voxels, best first."""
    out: list[Candidate] = []
    for name in database.sessions:
        mine = [h for h in hypotheses if database.places[h.group].session == name]
        targets = {group: database.target(group) for group in {h.group for h in mine}}
        out += search_hypotheses(
            mine, targets, query, database.settings.descriptor.headings, ALIGNED
        )
    return out


def _align(
    database: Database,
    session: SessionMap,
    keyframe: int,
    query: Query,
    query_T_base: F64,
    candidates: list[Candidate],
) -> list[Alignment]:
    """Candidates of one target session, aligned on the points, compared with each other, judged."""
    v = database.settings.fusion.voxel_size
    fitted: list[Fitted] = []
    headings = database.settings.descriptor.headings
    for c in candidates:
        near = database.nearest_keyframe(c.group, c.target_T_query[:3, 3])
        fit = escaped(
            coarse_fit(c, database.target(c.group), query),
            c,
            database.target(c.group),
            query,
            headings,
        )
        sees = apply(c.target_T_query, query.middle[None])[0]
        fitted.append(
            Fitted(
                c,
                near,
                sees,
                fit,
                structure_scores(query, database.target(c.group), fit.target_T_query),
            )
        )
    best = _distinct(fitted, v)[: max(1, database.settings.closures.rejected_per_query)]
    fine: list[Fitted] = []
    for f in best:
        target = database.target(f.candidate.group)
        if f.scores.rank >= max(CLOSE * max((o.scores.rank for o in fine), default=0.0), HOPELESS):
            fit = fine_fit(f.fit.target_T_query, database.surface(f.candidate.group, f.sees), query)
            fine.append(
                replace(f, fit=fit, scores=structure_scores(query, target, fit.target_T_query))
            )
        else:  # reading keyframes takes longer than fitting them: not for what cannot be accepted
            fine.append(replace(f, fit=measured(f.fit.target_T_query, target.surface, query)))
    fine = _distinct(fine, v)
    asked = database.sessions[database.places[candidates[0].group].session]
    return [
        _judge(database, session, keyframe, query, query_T_base, f, _rival(f, fine, asked, v))
        for f in fine
    ]


def _rival(one: Fitted, fitted: list[Fitted], target: SessionMap, voxel_size: float) -> float:
    """The best rank of another place; the same place, driven again and moved by the drift of the
    target's odometry, is no other one.
    """
    best = 0.0
    for other in fitted:
        a = one.fit.target_T_query
        b = other.fit.target_T_query
        road = abs(float(target.distance[one.nearest] - target.distance[other.nearest]))
        off = float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
        drifted = off < 3.3 * voxel_size + DRIFT * road and yaw_between(a, b) < np.radians(
            5.0 + 0.02 * road
        )
        if other is not one and not (drifted and road > 50 * voxel_size):
            best = max(best, other.scores.rank)
    return best


def _distinct(fitted: list[Fitted], voxel_size: float) -> list[Fitted]:
    """Best first, each place once."""
    kept: list[Fitted] = []
    for f in sorted(fitted, key=lambda f: -f.scores.rank):
        if not any(
            same_place(f.fit.target_T_query, o.fit.target_T_query, voxel_size) for o in kept
        ):
            kept.append(f)
    return kept


def _judge(
    database: Database,
    session: SessionMap,
    keyframe: int,
    query: Query,
    query_T_base: F64,
    fitted: Fitted,
    second: float,
) -> Alignment:
    """The alignment of one candidate with its features, probability and covariance."""
    settings = database.settings
    v = settings.fusion.voxel_size
    candidate = fitted.candidate
    fine = fitted.fit
    scores = fitted.scores
    place = database.places[candidate.group]
    target_session = database.sessions[place.session]
    target = database.target(candidate.group)
    T = fine.target_T_query
    features = Features(
        structure=scores.structure,
        coverage=scores.coverage,
        contradiction=scores.contradiction,
        fit=fine.inliers,
        rmse=fine.rmse / v,
        distinct=min(max(second, 0.0) / max(scores.rank, 1e-3), 2.0),
        support=float(np.log10(scores.aligned + 1)),
        stiffness=float(np.log10(_stiffness(fine) + 1)),
    )
    probability = float(shipped().own(own_values(features)))
    same_source = session.json["label_source"] == target_session.json["label_source"]
    overlap, inliers = tau(
        query.occupied,
        target.blocks,
        v,
        T,
        settings.closures.kappa * v,
        None if same_source else cityscapes().coarse,
    )
    map_T_query_base = T @ query_T_base
    nearest = database.nearest_keyframe(candidate.group, map_T_query_base[:3, 3])
    map_T_target = target_session.map_T_base[nearest]
    looking = database.looking_keyframe(candidate.group, fitted.sees)
    road = abs(float(target_session.distance[nearest] - target_session.distance[looking]))
    return Alignment(
        query_session=session.folder.name,
        target_session=place.session,
        query_keyframe=keyframe,
        target_keyframe=nearest,
        query_stamp_ns=int(session.stamps_ns[keyframe]),
        target_stamp_ns=int(target_session.stamps_ns[nearest]),
        target_T_query=inverse(map_T_target) @ map_T_query_base,
        covariance=covariance_of(fine, map_T_query_base, map_T_target, v, road),
        overlap=overlap,
        probability=probability,
        inliers=inliers,
        words=candidate.votes,
        features=features,
        agreement=Agreement(probability),
    )


def _stiffness(fit: Fit) -> float:
    """Least information about the position, the rotation being free: how many points hold the
    weakest direction.
    """
    H = fit.information
    if not np.isfinite(H).all() or np.linalg.matrix_rank(H) < 6:
        return 0.0
    reduced = H[:3, :3] - H[:3, 3:] @ np.linalg.solve(H[3:, 3:], H[3:, :3])
    return float(max(np.linalg.eigvalsh(reduced).min(), 0.0))


def _beyond_noise(information: F64, pull: F64) -> tuple[F64, F64]:
    """Information (6, 6) less what normals that are 2 degrees off would pretend, in axes scaled so
    that lengths and angles compare; and the share of ``pull`` (n, 6) in what is left of it.
    """
    points = float(np.trace(information[:3, :3]))
    arms = float(np.trace(information[3:, 3:]))
    if points <= 0:
        return np.zeros((6, 6)), np.zeros_like(pull)
    scale = np.r_[1.0, 1.0, 1.0, np.full(3, max(np.sqrt(arms / points), 1e-6))]
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    kept = np.maximum(values - points * np.sin(NORMAL_NOISE) ** 2, 0.0)
    share = np.divide(kept, values, out=np.zeros(6), where=values > 0)
    return np.asarray((vectors * kept) @ vectors.T * np.outer(scale, scale)), pull / scale @ (
        vectors * share
    ) @ vectors.T * scale


def covariance_of(
    fit: Fit, map_T_query: F64, map_T_target: F64, voxel_size: float, road: float = 0.0
) -> F64:
    """Covariance (6, 6) of target_T_query from the fit's information, in the target's axes (DESIGN:
    closures.parquet).

    What noisy normals alone would claim to know is taken off first. Where the points then hold
    nothing (along a corridor) the error is as large as the search lets it be: 3.3 voxels, 5
    degrees. Uncertain ranges may all be too long or too short, which no number of points averages
    out. The target's keyframe may lie metres from what was aligned, and ``road`` metres from where
    that was seen: between them its odometry drifts.
    """
    noise = max(fit.rmse if np.isfinite(fit.rmse) else 1.0, 0.02) ** 2
    prior = np.diag([1 / (3.3 * voxel_size) ** 2] * 3 + [1 / np.radians(5.0) ** 2] * 3)
    information, pull = _beyond_noise(fit.information, fit.pull)
    about_centre = np.linalg.inv(information / (INFLATION * noise) + prior)
    of_query, of_target = SYSTEMATIC * pull / (INFLATION * noise) @ about_centre
    alone = np.sqrt(1 - COMMON)
    common = np.sqrt(COMMON)
    pulled = np.stack([alone * of_query, alone * of_target, common * (of_query - of_target)])
    about_centre += pulled.T @ pulled
    x, y, z = map_T_query[:3, 3] - fit.centre
    A = np.eye(6)
    A[:3, 3:] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turned = np.zeros((6, 6))
    turned[:3, :3] = turned[3:, 3:] = map_T_target[:3, :3].T
    away = float(np.linalg.norm(map_T_query[:3, 3] - map_T_target[:3, 3])) + road
    drift = np.diag([(DRIFT * away) ** 2 / 3] * 3 + [0.0] * 3)
    C = turned @ A @ about_centre @ A.T @ turned.T + drift + FLOOR
    return np.asarray((C + C.T) / 2)

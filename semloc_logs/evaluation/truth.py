"""Closures against the truth: which are right, how far off, and how many of the revisits were found
(docs/reference/truth.md).
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semloc_logs.arrays import F64, I64
from semloc_logs.closures.closure_tables import read_closures
from semloc_logs.closures.query import query_keyframes
from semloc_logs.errors import TruthError, WorkspaceError
from semloc_logs.evaluation.headings import headings_deg, in_window
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import interpolate, inverse, rotation_angle, transform
from semloc_logs.settings import Resolved, ResolvedClosures, ResolvedQuery
from semloc_logs.tables.table import read_metadata, read_table
from semloc_logs.voxels.store import poses_of
from semloc_logs.workspace import Workspace

CORRECT_M, CORRECT_DEG = 1.0, 5.0
REVISIT_M = 5.0
SLACK_NS = 100_000_000  # a pose is known so far beyond the ends of its trajectory


@dataclass(frozen=True, slots=True, eq=False)
class TrueTrack:
    """True poses ``common_T_base`` (n, 4, 4) of a session at ascending ``stamps_ns`` (n,)."""

    stamps_ns: I64
    common_T_base: F64

    def at(self, stamps_ns: I64) -> tuple[F64, NDArray[np.bool_]]:
        """Poses (m, 4, 4) and whether they are known (m,)."""
        if not len(self.stamps_ns):
            return np.tile(np.eye(4), (len(stamps_ns), 1, 1)), np.zeros(len(stamps_ns), bool)
        known = (stamps_ns >= self.stamps_ns[0] - SLACK_NS) & (
            stamps_ns <= self.stamps_ns[-1] + SLACK_NS
        )
        return interpolate(self.stamps_ns, self.common_T_base, stamps_ns), known


@dataclass(frozen=True, slots=True)
class Judged:
    """One closure; without errors, and neither correct nor false, when the truth does not know an
    end.
    """

    query_session: str
    target_session: str
    query_stamp_ns: int
    target_stamp_ns: int
    probability: float
    error_m: float | None
    error_deg: float | None
    correct: bool | None


@dataclass(frozen=True, slots=True)
class PairFigures:
    """The figures of two ``sessions``, sorted, or of one and itself: ``possible`` are the queries
    of either near the other one, ``answered`` those with a correct closure of the two.
    """

    sessions: tuple[str, str]
    closures: int
    correct: int
    false: int
    possible: int
    answered: int

    @property
    def recall(self) -> float | None:
        return self.answered / self.possible if self.possible else None


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The figures: medians over all judged closures; ``recall`` = ``answered`` / ``possible``
    queries, None without possible ones. ``pairs``: of those that have closures or could have.
    """

    rows: list[Judged] = field(repr=False)
    queries: int
    possible: int
    answered: int
    pairs: list[PairFigures] = field(default_factory=list, repr=False)

    @property
    def closures(self) -> int:
        return len(self.rows)

    @property
    def correct(self) -> int:
        return sum(r.correct is True for r in self.rows)

    @property
    def false(self) -> int:
        return sum(r.correct is False for r in self.rows)

    @property
    def unjudged(self) -> int:
        return sum(r.correct is None for r in self.rows)

    @property
    def median_error_m(self) -> float | None:
        return _median(r.error_m for r in self.rows)

    @property
    def median_error_deg(self) -> float | None:
        return _median(r.error_deg for r in self.rows)

    @property
    def recall(self) -> float | None:
        return self.answered / self.possible if self.possible else None

    def to_json(self) -> dict[str, Any]:
        """As ``semloc evaluate --json`` prints it."""
        figures = (
            "closures",
            "correct",
            "false",
            "unjudged",
            "median_error_m",
            "median_error_deg",
            "recall",
            "queries",
            "possible",
            "answered",
        )
        return {name: getattr(self, name) for name in figures} | {
            "pairs": [asdict(p) | {"recall": p.recall} for p in self.pairs],
            "rows": [asdict(r) for r in self.rows],
        }


def _median(values: Iterable[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.median(known)) if known else None


def evaluate_closures(
    work: Workspace,
    truth: Path,
    settings: Resolved,
    *,
    self_closures: bool = True,
    heading_deg: float | None = None,
) -> Evaluation:
    """The closures of a workspace against the file ``truth``; queries are counted with the settings
    that the closures were made with.

    A query is possible when a keyframe of another session, or one of its own that is not excluded
    as near in time or along the road, truly lies within 5 m. It is answered when a correct closure
    has it at either end: a closure found from both ends is reported once. With ``heading_deg`` a
    query is possible only where all these keyframes of a session were truly driven at this angle to
    it (+- 20 degrees), and only closures between such views count. Raises TruthError when the truth
    file is missing or wrong, WorkspaceError without closures.
    """
    work.chosen(())
    if not work.closures.exists():
        raise WorkspaceError(f"{work.path} has no closures yet: run 'semloc close' first.")
    settings = _settings_of(work, settings.resolved())
    sessions = {f.name: SessionMap(f) for f in work.sessions()}
    tracks = read_truth(truth, sessions)
    closures = read_closures(work.closures)
    if heading_deg is not None:
        closures = [row for row in closures if _is_at_heading(row, tracks, heading_deg)]
    rows = [judge_closure(row, tracks) for row in closures]
    revisits = _Revisits.of(sessions, tracks, heading_deg)
    counts = _count_queries(sessions, revisits, rows, settings, self_closures)
    return Evaluation(rows, counts.queries, counts.possible, counts.answered, _pairs(rows, counts))


def _settings_of(work: Workspace, settings: Resolved) -> Resolved:
    """``settings`` with the sections that closures.parquet was made with, where it has them."""
    recorded = read_metadata(work.closures).get("settings")
    if not isinstance(recorded, dict):
        return settings
    try:
        update = {
            "query": ResolvedQuery.model_validate(recorded["query"]),
            "closures": ResolvedClosures.model_validate(recorded["closures"]),
        }
    except (KeyError, ValueError):
        raise WorkspaceError(
            f"{work.closures} was made by another version: "
            f"run 'semloc close -w {work.path} --overwrite'."
        ) from None
    return settings.model_copy(update=update)


def judge_closure(row: Mapping[str, Any], tracks: Mapping[str, TrueTrack]) -> Judged:
    """A row of closures.parquet or rejected.parquet against the true tracks of its sessions."""
    ends = [
        _pose(tracks.get(row[f"{end}_session"]), row[f"{end}_stamp_ns"])
        for end in ("query", "target")
    ]
    error_m = error_deg = correct = None
    if ends[0] is not None and ends[1] is not None:
        measured = transform(
            np.array([row[f"t_{c}"] for c in "xyz"]), np.array([row[f"q_{c}"] for c in "xyzw"])
        )
        rest = inverse(inverse(ends[1]) @ ends[0]) @ measured
        error_m = float(np.linalg.norm(rest[:3, 3]))
        error_deg = float(np.degrees(rotation_angle(rest[:3, :3])))
        correct = error_m <= CORRECT_M and error_deg <= CORRECT_DEG
    names = ("query_session", "target_session", "query_stamp_ns", "target_stamp_ns", "probability")
    return Judged(
        **{n: row[n] for n in names}, error_m=error_m, error_deg=error_deg, correct=correct
    )


def _is_at_heading(
    row: Mapping[str, Any], tracks: Mapping[str, TrueTrack], heading_deg: float
) -> bool:
    """Whether the ends of a closure were truly driven at an angle to each other."""
    ends = [
        _pose(tracks.get(row[f"{end}_session"]), row[f"{end}_stamp_ns"])
        for end in ("query", "target")
    ]
    if ends[0] is None or ends[1] is None:
        return False
    query, target = headings_deg(np.stack([ends[0], ends[1]]))
    return bool(in_window(query, target, heading_deg))


def _pose(track: TrueTrack | None, stamp_ns: int) -> F64 | None:
    if track is None:
        return None
    poses, known = track.at(np.array([stamp_ns]))
    return poses[0] if known[0] else None


# -- recall


@dataclass(slots=True)
class _Counts:
    """Queries of known true pose, how many of them are possible, and how many of the latter are
    answered; the same by pairs of sessions.
    """

    queries: int = 0
    possible: int = 0
    answered: int = 0
    possible_of: Counter[tuple[str, str]] = field(default_factory=Counter)
    answered_of: Counter[tuple[str, str]] = field(default_factory=Counter)


def _pair(one: str, other: str) -> tuple[str, str]:
    return (one, other) if one <= other else (other, one)


def _pairs(rows: list[Judged], counts: _Counts) -> list[PairFigures]:
    judged: dict[tuple[str, str], list[Judged]] = {}
    for row in rows:
        judged.setdefault(_pair(row.query_session, row.target_session), []).append(row)
    return [
        PairFigures(
            pair,
            closures=len(closures := judged.get(pair, [])),
            correct=sum(r.correct is True for r in closures),
            false=sum(r.correct is False for r in closures),
            possible=counts.possible_of[pair],
            answered=counts.answered_of[pair],
        )
        for pair in sorted({*judged, *counts.possible_of})
    ]


@dataclass(slots=True, eq=False)
class _Revisits:
    """Where the keyframes of each session truly were, and which of them are revisits of a place:
    within ``REVISIT_M``, and all at ``heading_deg`` to the query if that is given.
    """

    positions: dict[str, F64]
    headings: dict[str, F64]
    known: dict[str, NDArray[np.bool_]]
    trees: dict[str, cKDTree]
    heading_deg: float | None

    @classmethod
    def of(
        cls,
        sessions: Mapping[str, SessionMap],
        tracks: Mapping[str, TrueTrack],
        heading_deg: float | None,
    ) -> _Revisits:
        """The revisits among the sessions whose tracks are known."""
        out = cls({}, {}, {}, {}, heading_deg)
        for name, track in tracks.items():
            poses, out.known[name] = track.at(sessions[name].stamps_ns)
            out.positions[name] = poses[:, :3, 3]
            out.headings[name] = headings_deg(poses)
            if out.known[name].any():
                out.trees[name] = cKDTree(out.positions[name][out.known[name]])
        return out

    def near(self, name: str, keyframes: I64, other: str) -> NDArray[np.bool_]:
        """Whether session ``other`` truly was where each of ``keyframes`` (n,) of a session is."""
        places = self.positions[name][keyframes]
        if self.heading_deg is None:
            return np.asarray(self.trees[other].query(places)[0] <= REVISIT_M)
        headings = self.headings[other][self.known[other]]
        neighbours = self.trees[other].query_ball_point(places, REVISIT_M)
        of_keyframes = zip(keyframes.tolist(), neighbours, strict=True)
        return np.array([self.fits(name, k, headings[rows]) for k, rows in of_keyframes], bool)

    def fits(self, name: str, keyframe: int, headings: F64) -> bool:
        """Whether there are headings (n,), and all are at the angle to a keyframe."""
        if self.heading_deg is None or not len(headings):
            return len(headings) > 0
        return bool(in_window(headings, self.headings[name][keyframe], self.heading_deg).all())


def _count_queries(
    sessions: Mapping[str, SessionMap],
    revisits: _Revisits,
    rows: list[Judged],
    settings: Resolved,
    self_closures: bool,
) -> _Counts:
    positions = revisits.positions
    known = revisits.known
    right = _correct_ends(sessions, rows)
    counts = _Counts()
    for name in revisits.trees:
        session = sessions[name]
        keyframes = np.array(query_keyframes(session, settings), np.int64)
        keyframes = keyframes[known[name][keyframes]]
        is_visited = {o: revisits.near(name, keyframes, o) for o in revisits.trees if o != name}
        counts.queries += len(keyframes)
        for number, k in enumerate(keyframes.tolist()):
            candidates = [other for other, visited in is_visited.items() if visited[number]]
            if self_closures and _revisits_itself(session, revisits, name, k, settings.closures):
                candidates.append(name)
            if not candidates:
                continue
            answered_in = {
                other
                for other, ends in right.get(name, {}).items()
                if _is_answered(positions[name], k, ends, settings.query.every)
            }
            counts.possible += 1
            counts.answered += bool(answered_in)
            pairs = {_pair(name, other) for other in candidates}
            counts.possible_of.update(pairs)
            counts.answered_of.update(pairs & {_pair(name, other) for other in answered_in})
    return counts


def _correct_ends(
    sessions: Mapping[str, SessionMap], rows: list[Judged]
) -> dict[str, dict[str, list[tuple[int, bool]]]]:
    """Keyframes of a session at the ends of correct closures with another one, and whether they
    were the query.
    """
    out: dict[str, dict[str, list[tuple[int, bool]]]] = {}
    for row in rows:
        if row.correct:
            ends = (
                (row.query_session, row.query_stamp_ns, row.target_session, True),
                (row.target_session, row.target_stamp_ns, row.query_session, False),
            )
            for session, stamp, other, is_query in ends:
                keyframe = int(np.argmin(np.abs(sessions[session].stamps_ns - stamp)))
                of_pair = out.setdefault(session, {}).setdefault(other, [])
                of_pair.append((keyframe, is_query))
    return out


def _is_answered(
    positions: F64, keyframe: int, ends: list[tuple[int, bool]], spacing: float
) -> bool:
    """As the query itself, or as the target of a closure found from the other end, within one query
    spacing.
    """
    return any(
        k == keyframe
        if is_query
        else float(np.linalg.norm(positions[k] - positions[keyframe])) < spacing
        for k, is_query in ends
    )


def _revisits_itself(
    session: SessionMap,
    revisits: _Revisits,
    name: str,
    keyframe: int,
    closures: ResolvedClosures,
) -> bool:
    if not session.posed:
        return False
    positions = revisits.positions[name]
    away = np.linalg.norm(positions - positions[keyframe], axis=1)
    is_revisit = revisits.known[name] & (away <= REVISIT_M)
    later = (
        np.abs(session.stamps_ns - session.stamps_ns[keyframe]) >= closures.exclude_seconds * 1e9
    )
    farther = np.abs(session.distance - session.distance[keyframe]) >= (closures.exclude_distance)
    return revisits.fits(name, keyframe, revisits.headings[name][is_revisit & later & farther])


# -- files


def read_truth(path: Path, sessions: Mapping[str, SessionMap]) -> dict[str, TrueTrack]:
    """The true tracks of those ``sessions`` that the file knows. Raises TruthError when it is
    missing or wrong, or knows none.
    """
    if not path.exists():
        raise TruthError(f"Truth file {path} does not exist.")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as problem:
        raise TruthError(
            f"Truth file {path} cannot be read as JSON ({problem}): "
            "give a file that maps a log's name to its truth."
        ) from None
    if not isinstance(content, dict) or not all(
        isinstance(entry, dict) for entry in content.values()
    ):
        raise TruthError(
            f"Truth file {path} does not map each log's name to an object "
            "with 'T_common_session' or 'trajectory'."
        )
    tracks = {}
    for file, entry in content.items():
        name = next((n for n in (file, Path(file).stem) if n in sessions), None)
        if name is not None:
            tracks[name] = _track(path, file, entry, sessions[name])
    if not tracks:
        raise TruthError(
            f"Truth file {path} knows {', '.join(content) or 'no log'}, "
            f"but the workspace has the sessions {', '.join(sessions) or 'none'}: name its keys "
            "like the sessions."
        )
    return tracks


def _track(path: Path, file: str, entry: Mapping[str, Any], session: SessionMap) -> TrueTrack:
    if "trajectory" in entry:
        return read_tum(path.parent / str(entry["trajectory"]))
    try:
        common_T_session = np.asarray(entry["T_common_session"], float)
        if common_T_session.shape != (4, 4) or not np.isfinite(common_T_session).all():
            raise ValueError
        R = common_T_session[:3, :3]
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or not np.allclose(
            common_T_session[3], (0, 0, 0, 1)
        ):
            raise ValueError
    except (KeyError, ValueError, TypeError):
        raise TruthError(
            f"Truth file {path}: {file} needs 'T_common_session', a rigid 4x4 matrix of numbers, "
            "or 'trajectory', a TUM file."
        ) from None
    table = read_table(session.folder.trajectory)
    return TrueTrack(np.asarray(table["stamp_ns"].to_numpy()), common_T_session @ poses_of(table))


def read_tum(path: Path) -> TrueTrack:
    """A TUM file: seconds, position (m) and quaternion xyzw on each line; stamps exact to the
    nanosecond.

    Raises TruthError when it is missing, or a line does not say this.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as problem:
        raise TruthError(f"Trajectory {path} cannot be read ({problem}).") from None
    rows: dict[int, list[float]] = {}
    for number, line in enumerate(lines, start=1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            stamp_ns = int(Decimal(words[0]) * 10**9)
            values = [float(w) for w in words[1:8]]
            if (
                len(values) != 7
                or not np.isfinite(values).all()
                or not np.linalg.norm(values[3:]) > 1e-6
                or abs(stamp_ns) >= 2**63
            ):
                raise ValueError
        except (ValueError, OverflowError, InvalidOperation):
            raise TruthError(
                f"Trajectory {path}, line {number}: "
                "give seconds, x y z (m) and a quaternion qx qy qz qw."
            ) from None
        rows[stamp_ns] = values
    if not rows:
        raise TruthError(f"Trajectory {path} holds no poses.")
    stamps = sorted(rows)
    values_of = np.array([rows[s] for s in stamps])
    return TrueTrack(np.array(stamps, np.int64), transform(values_of[:, :3], values_of[:, 3:]))

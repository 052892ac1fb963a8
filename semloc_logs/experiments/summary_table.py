"""The table of a run: a row a system, a column a scenario, in Markdown and JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semloc_logs.experiments.answers import Answers
from semloc_logs.experiments.measures import (
    FEWEST_PASSAGES,
    THRESHOLDS_M,
    Bounded,
    PrecisionRecall,
    abstaining,
    error_curve,
    localised,
    median_within,
    precision_recall,
    rank_recall,
    ratio,
)
from semloc_logs.experiments.orderings import Finding
from semloc_logs.experiments.pair_lists import PAIRS
from semloc_logs.experiments.protocols import (
    LOOP_M,
    Retrieval,
    loop_figures,
    nearest_frames,
    pair_figures,
    registration_figures,
)
from semloc_logs.experiments.scenarios import Scenario
from semloc_logs.experiments.system import MOST_POSES
from semloc_logs.experiments.views import ViewStore
from semloc_logs.numerics.evenly import evenly

TIME = (
    "Kept files are networks, words and features of pictures, made once for all databases. They"
    " count to every system that uses them, so that a row has what the system would take alone. The"
    " simulation of the streets that networks and words are learnt from counts to none."
)
COLUMNS = (
    "A column is a sensor and a scenario: the angle in degrees between the headings of the queries"
    " and of the database's views, or the conditions of the map and of the queries. Shares have"
    f" 95 % bounds over passages; of fewer than {FEWEST_PASSAGES} passages the queries are counted."
)
SMALL = (
    f"Every scenario has fewer than {FEWEST_PASSAGES} passages: this run shows that the systems"
    " work, and not how well. No ordering of the paper can be decided by it."
)
QUICK = (
    "A quick run: networks of CGF, 3DMatch, PoseNet and DSAC are trained for a few steps only,"
    " and cannot be good."
)
RANKS = (1, 5, 20, MOST_POSES)  # of the tables; the curves have all
ALLOWED_FDR = 0.05  # share of wrong answers that an abstaining system may give
ERRORS_M = np.array([0.1, 0.25, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 10.0, 20.0])
POINTS = 100  # of a precision-recall curve


@dataclass(eq=False)
class Row:
    """A system: ``name``, ``title``, its answers by sensor and scenario, and why it did not run."""

    name: str
    title: str
    remark: str = ""
    answers: dict[tuple[str, str], Answers] = field(default_factory=dict)
    not_run: dict[str, str] = field(default_factory=dict)  # by sensor

    @property
    def kept_s(self) -> float:
        """CPU time of the files that the system uses for several databases, each once."""
        files: dict[str, float] = {}
        for answers in self.answers.values():
            files |= answers.fit.kept_s
        return sum(files.values())

    @property
    def fit_s(self) -> float:
        """CPU time of learning the databases, without such files."""
        return sum(answers.fit.cpu_s for answers in self.answers.values())

    @property
    def cpu_hours(self) -> float:
        """Of kept files, of learning the databases, and of all queries."""
        queries = sum(float(answers.cpu_s.sum()) for answers in self.answers.values())
        return (self.kept_s + self.fit_s + queries) / 3600.0


@dataclass(frozen=True, eq=False)
class Outcome:
    """A whole run: ``rows`` of systems, ``scenarios`` and ``stores`` by sensor, ``findings``;
    ``is_quick``: networks are trained for a few steps.
    """

    rows: Sequence[Row]
    scenarios: Mapping[str, Sequence[Scenario]]
    stores: Mapping[str, ViewStore]
    findings: Sequence[Finding]
    is_quick: bool = False

    def columns(self) -> list[tuple[str, str]]:
        """Sensor and name of every scenario that has queries."""
        return [
            (sensor, scenario.name)
            for sensor, scenarios in self.scenarios.items()
            for scenario in scenarios
            if scenario.trials
        ]

    def passages(self) -> dict[tuple[str, str], int]:
        """The passages of every column."""
        return {
            (sensor, scenario.name): len({query.passage for query in scenario.queries})
            for sensor, scenarios in self.scenarios.items()
            for scenario in scenarios
        }


def figures_of(answers: Answers, scenario: Scenario, store: ViewStore) -> dict[str, Any]:
    """Every measure of one system on one scenario."""
    out: dict[str, Any] = {"queries": len(answers), "passages": len(np.unique(answers.passage))}
    for threshold in THRESHOLDS_M:
        curve = rank_recall(answers.errors_m, threshold)
        out[f"within {threshold:g} m"] = {
            **{
                f"rank {rank}": _json(
                    ratio(localised(answers.errors_m, threshold, rank), answers.passage)
                )
                for rank in RANKS
            },
            "rank-recall": [_number(value) for value in curve],
            "median error": _number(median_within(answers.first_m, threshold)),
        }
    out["localised within"] = dict(
        zip(
            (f"{error:g} m" for error in ERRORS_M.tolist()),
            map(_number, error_curve(answers.first_m, ERRORS_M).tolist()),
            strict=True,
        )
    )
    right = localised(answers.errors_m, THRESHOLDS_M[-1])
    out["precision-recall"] = _curve(precision_recall(answers.first_score, right, len(answers)))
    retrievals = retrievals_of(answers, scenario, store)
    loops = loop_figures(retrievals)
    pairs = pair_figures(retrievals)
    # a pair is to be registered, however far its frames are apart
    is_pair = np.full(len(answers), scenario.name == PAIRS)
    has_loop = is_pair | _has_loop(answers, scenario, store)
    registered = registration_figures(
        answers.first_m[has_loop], answers.errors_deg[has_loop, 0], answers.passage[has_loop]
    )
    careful = abstaining(answers.first_score, right, answers.passage, ALLOWED_FDR)
    return out | {
        "KITTI loops": {name: _number(value) for name, value in loops._asdict().items()},
        "SSC pairs": {name: _number(value) for name, value in pairs._asdict().items()},
        "registration": {
            "success": _json(registered.success),
            "translation_m": _number(registered.translation_m),
            "rotation_deg": _number(registered.rotation_deg),
        },
        "abstaining": {
            "allowed": ALLOWED_FDR,
            "false_discovery": _json(careful.false_discovery),
            "coverage": _json(careful.coverage),
        },
        "cpu_s": {
            "query": _number(float(np.median(answers.cpu_s)) if len(answers) else math.nan),
            "fit": answers.fit.cpu_s,
            "kept": sum(answers.fit.kept_s.values()),
        },
    }


def _curve(curve: PrecisionRecall) -> dict[str, Any]:
    """A precision-recall curve of at most ``POINTS`` points, and its figures."""
    kept = evenly(len(curve.recall), POINTS)
    return {
        "average_precision": curve.average_precision,
        "best_f1": curve.best_f1,
        "recall_at_full_precision": curve.recall_at_full_precision,
        "recall": curve.recall[kept].tolist(),
        "precision": curve.precision[kept].tolist(),
    }


def retrievals_of(answers: Answers, scenario: Scenario, store: ViewStore) -> list[Retrieval]:
    """The answers as frames of the database, a trial each."""
    out = []
    place = store.world_T_base[:, :3, 3]
    for trial in scenario.trials:
        rows = answers.of_trial(trial.name)
        if len(rows):
            database = place[trial.database]
            frame = nearest_frames(answers.positions[rows], database)
            out.append(Retrieval(answers.truth[rows], database, frame, answers.score[rows]))
    return out


def _has_loop(answers: Answers, scenario: Scenario, store: ViewStore) -> NDArray[np.bool_]:
    out = np.zeros(len(answers), bool)
    place = store.world_T_base[:, :3, 3]
    for trial in scenario.trials:
        rows = answers.of_trial(trial.name)
        away = np.linalg.norm(answers.truth[rows][:, None] - place[trial.database], axis=2)
        out[rows] = away.min(axis=1, initial=np.inf) <= LOOP_M
    return out


def to_json(outcome: Outcome) -> dict[str, Any]:
    """The whole run."""
    by_name = {
        sensor: {s.name: s for s in scenarios} for sensor, scenarios in outcome.scenarios.items()
    }
    return {
        "scenarios": [
            {
                "sensor": sensor,
                "scenario": scenario.name,
                "queries": len(scenario.queries),
                "passages": len({q.passage for q in scenario.queries}),
                "databases": [len(t.database) for t in scenario.trials],
            }
            for sensor, scenarios in outcome.scenarios.items()
            for scenario in scenarios
        ],
        "systems": [
            {
                "name": row.name,
                "title": row.title,
                "cpu_hours": row.cpu_hours,
                "kept_cpu_s": row.kept_s,
                "not_run": row.not_run,
                "remark": row.remark,
                "scenarios": {
                    f"{sensor} {name}": figures_of(
                        answers, by_name[sensor][name], outcome.stores[sensor]
                    )
                    for (sensor, name), answers in row.answers.items()
                    if len(answers)
                },
            }
            for row in outcome.rows
        ],
        "findings": [
            {
                "hypothesis": f.hypothesis,
                "method": f.method,
                "sensor": f.sensor,
                "scenario": f.scenario,
                "figure": None if f.figure is None else _json(f.figure),
                "verdict": str(f.verdict),
            }
            for f in outcome.findings
        ],
    }


def _json(value: Bounded) -> dict[str, float | None]:
    return {name: _number(figure) for name, figure in value._asdict().items()}


def _number(value: float) -> float | None:
    return None if math.isnan(value) else float(value)


# -- Markdown


def to_markdown(outcome: Outcome) -> str:
    """The tables of a run, hypotheses and remarks."""
    columns = outcome.columns()
    passages = outcome.passages()
    is_small = all(passages[column] < FEWEST_PASSAGES for column in columns)
    warnings = [
        *([QUICK] if outcome.is_quick else []),
        *([SMALL] if is_small else []),
    ]
    parts = ["# Experiments of the paper", *warnings, COLUMNS]
    shares = []
    for threshold in THRESHOLDS_M:
        for rank, title in ((1, "first pose"), (MOST_POSES, f"first {MOST_POSES} poses")):
            shares += [
                f"## Localised within {threshold:g} m, {title}",
                _table(outcome, partial(_localised, threshold=threshold, rank=rank)),
            ]
    errors = [
        "## Error of the first pose",
        "Median, metres; a query without a pose counts as farthest.",
        _table(outcome, _error),
    ]
    # of a few queries the errors tell more than counts
    parts += [*errors, *shares] if is_small else [*shares, *errors]
    parts += ["## Time", TIME, _times(outcome)]
    if not is_small:
        parts += ["## Orderings of the paper", _orderings(outcome)]
    remarks = [f"- {row.title}: {row.remark}" for row in outcome.rows if row.remark]
    sensors: dict[tuple[str, str], list[str]] = {}
    for row in outcome.rows:
        for sensor, reason in row.not_run.items():
            sensors.setdefault((row.title, reason), []).append(sensor)
    reasons = [
        f"- {title}, {', '.join(names)}: {reason}" for (title, reason), names in sensors.items()
    ]
    if remarks:
        parts += ["## Remarks", "\n".join(remarks)]
    if reasons:
        parts += ["## Not run", "\n".join(reasons)]
    return "\n\n".join(parts) + "\n"


def _table(outcome: Outcome, cell: Callable[[Answers, bool], str]) -> str:
    """A row a system and a column a scenario; ``cell`` gets answers and whether the scenario has
    few passages.
    """
    columns = outcome.columns()
    passages = outcome.passages()
    lines = [_line("", [f"{sensor} {name}" for sensor, name in columns])]
    lines.append(_line("---", ["---"] * len(columns)))
    counts = {
        (sensor, scenario.name): len(scenario.queries)
        for sensor, scenarios in outcome.scenarios.items()
        for scenario in scenarios
    }
    lines.append(_line("queries", [str(counts[column]) for column in columns]))
    for row in outcome.rows:
        cells = []
        for column in columns:
            answers = row.answers.get(column)
            if answers is None or not len(answers):
                cells.append("not run" if column[0] in row.not_run else "")
                continue
            open_ = "" if len(answers) == counts[column] else f" ({len(answers)} queries)"
            cells.append(cell(answers, passages[column] < FEWEST_PASSAGES) + open_)
        lines.append(_line(row.title, cells))
    return "\n".join(lines)


def _localised(answers: Answers, is_few: bool, *, threshold: float, rank: int) -> str:
    right = localised(answers.errors_m, threshold, rank)
    if is_few:
        return f"{int(right.sum())} of {len(right)}"
    return _shown(ratio(right, answers.passage))


def _error(answers: Answers, _: bool) -> str:
    # of an even number the farther one in the middle: the mean of it and no pose would be neither
    median = float(np.sort(answers.first_m)[len(answers) // 2])
    return f"{median:.2f}" if math.isfinite(median) else "no pose"


def _times(outcome: Outcome) -> str:
    lines = [
        _line(
            "",
            [
                "CPU hours",
                "median CPU s of a query",
                "CPU s of the databases",
                "CPU s of kept files",
            ],
        ),
        _line("---", ["---"] * 4),
    ]
    for row in outcome.rows:
        spent = [a.cpu_s for a in row.answers.values() if len(a)]
        median = f"{np.median(np.concatenate(spent)):.2f}" if spent else ""
        fits = f"{row.fit_s:.1f}" if spent else ""
        kept = f"{row.kept_s:.1f}" if spent else ""
        hours = f"{row.cpu_hours:.3f}" if spent else ""
        lines.append(_line(row.title, [hours, median, fits, kept]))
    return "\n".join(lines)


def _orderings(outcome: Outcome) -> str:
    lines = [
        _line("hypothesis", ["method", "sensor", "scenario", "figure", "verdict"]),
        _line("---", ["---"] * 5),
    ]
    lines += [
        _line(
            f.hypothesis,
            [
                f.method,
                f.sensor,
                f.scenario.replace("|", "/"),
                "" if f.figure is None else _shown(f.figure),
                str(f.verdict),
            ],
        )
        for f in outcome.findings
    ]
    return "\n".join(lines)


def _line(first: str, cells: Sequence[str]) -> str:
    return "| " + " | ".join([first, *cells]) + " |"


def _shown(value: Bounded) -> str:
    return f"{value.value:.2f} [{value.low:.2f}, {value.high:.2f}]"

"""Reports of stages."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(slots=True)
class Report:
    """The outcome of a stage, or of several.

    ``done`` and ``kept`` name the work that was done and the work that was up to date; ``skipped``
    and ``failed`` are sentences about input that was left out; ``seconds`` are by stage. ``amount``
    of work is in the units of the stage (:mod:`semloc_logs.stages.dry_run`).
    """

    done: list[str] = field(default_factory=list)
    kept: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    closures: int = 0
    amount: float = 0.0

"""What the check of poses and range data found, as sentences and for session.json."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from semloc_logs.logs.poses.plausibility import Jump
from semloc_logs.logs.problems import Problem, ProblemKind
from semloc_logs.mapping.drift import Drift
from semloc_logs.mapping.fit.model import PRIOR

LEAST_PAIRS = 4  # fewer tell nothing
# what a closure would suffer, in voxels: noted above the first, wrong above the second
NOTED, WRONG = 0.5, 1.0
NEAR_VOXELS = 33.0  # a rotation moves points at this distance (10 m at 0.30 m voxels)
LEAST_SIGMAS = 5.0  # standard deviations by which a fault's parameter differs from zero for sure
# parameters by position, and what a wrong one is called
NAMES = {
    "clock_s": "an offset of its clock",
    "rotation_x_rad": "a turn of its mounting about x",
    "rotation_y_rad": "a turn of its mounting about y",
    "rotation_z_rad": "a turn of its mounting about z",
    "lever_x_m": "a shift of its mounting along x",
    "lever_y_m": "a shift of its mounting along y",
    "lever_z_m": "a shift of its mounting along z",
    "scale_log": "a wrong scale",
}


class Severity(Enum):
    """How much a finding matters."""

    NOTED = "noted"
    WRONG = "wrong"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong with a stream: the sentence's end, after the topics."""

    severity: Severity
    text: str


@dataclass(slots=True)
class StreamFit:
    """The check of one stream.

    ``pairs`` were registered; poses and clouds differ by ``translation_m`` and ``rotation_rad`` in
    the median. ``parameters`` are (estimate, standard deviation) by name; ``hidden`` are the faults
    that the drive would not show: a straight one hides a lever arm, a steady one a clock offset.
    ``drift`` of the poses, where the clouds show it. ``frames``: of the sensor. ``is_doubtful``: a
    fault explains almost enough.
    """

    topic: str
    pairs: int = 0
    translation_m: float = 0.0
    rotation_rad: float = 0.0
    parameters: dict[str, tuple[float, float]] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    hidden: list[str] = field(default_factory=list)
    drift: Drift | None = None
    frames: Sequence[str] = ()
    is_doubtful: bool = False

    @property
    def is_wrong(self) -> bool:
        """Whether closures of this stream would be false."""
        return any(f.severity is Severity.WRONG for f in self.findings)

    def untold(self) -> str:
        """A sentence about the faults that could not be checked; empty where all could."""
        if self.pairs < LEAST_PAIRS:
            return (
                f"{self.topic}: whether the poses fit its clouds cannot be told: only {self.pairs}"
                " pairs of its keyframes could be compared."
            )
        if not self.hidden or self.findings:
            return ""
        faults = " or ".join(self._smallest(name) for name in self.hidden)
        return (
            f"{self.topic}: the drive would not show {faults}: it is too short, too straight or too"
            " steady, or the scene too plain."
        )

    def _smallest(self, name: str) -> str:
        """A hidden fault, with the size below which it is hidden where that means anything."""
        sigma = self.parameters[name][1]
        size = LEAST_SIGMAS * sigma
        if sigma > 0.5 * PRIOR[list(NAMES).index(name)]:
            return NAMES[name]
        unit = {
            "clock_s": f"{size:.2g} s",
            "scale_log": f"{100 * np.expm1(size):.0f} %",
        }.get(name, f"{np.degrees(size):.0f} degrees" if "rotation" in name else f"{size:.1f} m")
        return f"{NAMES[name]} of less than {unit}"

    def to_json(self) -> dict[str, object]:
        """For session.json."""
        return {
            "topic": self.topic,
            "frames": list(self.frames),
            "pairs": self.pairs,
            "translation_m": round(self.translation_m, 4),
            "rotation_rad": round(self.rotation_rad, 5),
            "parameters": {
                name: {"estimate": round(value, 5), "sigma": round(sigma, 5)}
                for name, (value, sigma) in self.parameters.items()
            },
            "hidden": self.hidden,
            "findings": [{"severity": f.severity.value, "text": f.text} for f in self.findings],
        }


@dataclass(slots=True)
class SessionFit:
    """The check of a session: of the track of its ``pose`` stream, and of each range stream.

    ``is_frozen``: the poses stand still while the surroundings move, which a problem of the session
    names.
    """

    pose: str
    jump: Jump | None = None
    is_frozen: bool = False
    streams: list[StreamFit] = field(default_factory=list)

    def add_tilt(self, angle: float, imu: str) -> None:
        """Enters that gravity by the topic ``imu`` contradicts the map by an angle (rad); 0: not.

        Other faults, which would turn the map, come first.
        """
        if not angle or not self.fits:
            return
        text = (
            f"its mounting is turned by {abs(np.degrees(angle)):.1f} degrees about the way of the"
            f" drive against {imu}: the ground and the walls beside the way are not level as it"
            " measures gravity, which the frame of the poses has as well; correct the transform of"
            " one of both"
        )
        for stream in self.streams:
            stream.findings.append(Finding(Severity.WRONG, text))

    @property
    def fits(self) -> bool:
        """Whether nothing is known that would make closures false."""
        if self.is_frozen or self.jump is not None:
            return False
        return not any(stream.is_wrong for stream in self.streams)

    @property
    def problems(self) -> list[Problem]:
        """A sentence for each finding."""
        problems = []
        if self.jump is not None:
            text = f"{self.pose}: {self.jump.text}."
            problems.append(Problem(self.pose, ProblemKind.FIT, text, lost=False, assumed=True))
        for stream in self.streams:
            for finding in stream.findings:
                is_wrong = finding.severity is Severity.WRONG
                verb = "do not fit each other" if is_wrong else "hardly fit each other"
                text = f"{stream.topic} and the poses of {self.pose} {verb}: {finding.text}."
                problem = Problem(stream.topic, ProblemKind.FIT, text, lost=False, assumed=is_wrong)
                problems.append(problem)
            if note := stream.untold():
                problems.append(Problem(stream.topic, ProblemKind.FIT, note, lost=False))
        return problems

    @property
    def drift(self) -> Drift | None:
        """The smallest one that a stream shows: noise of a stream only adds to it."""
        drifts = (stream.drift for stream in self.streams)
        shown = [drift for drift in drifts if drift is not None]
        return min(shown, key=lambda d: float(np.linalg.norm(d.translation)), default=None)

    def _track_text(self) -> str | None:
        if self.jump is not None:
            return self.jump.text
        return "the poses stand still while the surroundings move" if self.is_frozen else None

    def to_json(self) -> dict[str, object]:
        """For session.json."""
        return {
            "fits": self.fits,
            "track": self._track_text(),
            "streams": [stream.to_json() for stream in self.streams],
            "drift": None if self.drift is None else self.drift.to_json(),
        }

"""The decision which way is up, how sure it is, and what to say where it is not."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.logs.problems import Problem, ProblemKind
from semloc_logs.mapping.up_direction import find_up
from semloc_logs.mapping.up_evidence import Sky, UpEvidence
from semloc_logs.numerics.transforms import angle_between


class UpSource(Enum):
    """What settled which way is up."""

    SETTING = "setting"
    IMU = "imu"
    MAP = "map"  # its ground and walls, and the motion
    CONVENTION = "convention"  # of frames, because the map does not settle it


# by how much the score of another direction must exceed the score of the expected one, to be
# believed instead; upside down needs more, because a ceiling looks like a floor
LIMIT = {UpSource.CONVENTION: 0.1, UpSource.IMU: 0.25}
OPPOSITE = {Sky.OPEN: 0.1, Sky.CEILING: 0.2}  # more; nothing is enough where either may be it
DOUBT = {UpSource.CONVENTION: 0.1, UpSource.IMU: 0.15}  # is told, but the expected one stays
DOUBT_OPPOSITE = {Sky.OPEN: 0.1, Sky.CEILING: 0.15, Sky.UNKNOWN: 0.15}  # in place of it
FLAGRANT = 0.45  # in place of both, for an IMU where down may be the ceiling
FITS = 0.4  # score of an expected direction that stays in a room
CLEAR = 0.1  # lead over every other direction without which a finding is unsure
FAR_OFF = 30.0  # degrees off where it was expected: better directions may be beyond its reach
TILTED = 15.0  # degrees off an IMU; streets are less steep
GIVEN_WITHIN = 0.35  # rad, of a direction that was given; it is refined


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """Where up is expected in frame ``frame`` of log ``log``.

    ``convention`` (3,) is up by convention, ``imu`` (3,) by the IMU on ``imu_topic``, if any.
    """

    log: str
    frame: str
    convention: F64
    imu: F64 | None = None
    imu_topic: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Gravity:
    """``up`` (3,) in the session frame, or in the base frame of a log without poses.

    ``prior`` (3,) is the direction near which it was refined. ``margin`` is its score less the
    score of the best other direction; None where nothing was compared.
    """

    up: F64
    prior: F64
    source: UpSource
    margin: float | None = None
    off_convention: float | None = None  # degrees
    off_imu: float | None = None  # degrees
    problems: tuple[Problem, ...] = ()

    @property
    def is_assumed(self) -> bool:
        """Whether the log does not settle which way is up."""
        return any(p.assumed for p in self.problems)

    def to_json(self) -> dict[str, Any]:
        """For session.json."""

        def rounded(value: float | None, digits: int) -> float | None:
            return None if value is None else round(value, digits)

        return {
            "source": self.source.value,
            "up": [round(float(x), 6) for x in self.up],
            "margin": rounded(self.margin, 3),
            "assumed": self.is_assumed,
            "off_convention_deg": rounded(self.off_convention, 1),
            "off_imu_deg": rounded(self.off_imu, 1),
        }


def given_gravity(direction: F64, normals: F64, weights: F64) -> Gravity:
    """Up near a ``direction`` (3,) that the user gave, refined by the surfaces of the map."""
    prior = direction / np.linalg.norm(direction)
    return Gravity(find_up(normals, weights, prior, GIVEN_WITHIN), prior, UpSource.SETTING)


def find_gravity(expected: Expected, normals: F64, weights: F64, evidence: UpEvidence) -> Gravity:
    """Up as the IMU or the convention expects it, unless the map clearly shows another direction.

    ``normals`` (n, 3) and ``weights`` (n,) are of all flat places of the map.
    """
    by = UpSource.CONVENTION if expected.imu is None else UpSource.IMU
    prior = expected.convention if expected.imu is None else expected.imu
    up = find_up(normals, weights, prior)
    if not evidence.is_enough:
        problems = (_none(expected),) if expected.imu is None else ()
        return _gravity(expected, up, prior, by, None, problems)
    if _degrees(up, prior) > FAR_OFF:
        prior = up
        up = find_up(normals, weights, prior)

    others = evidence.others(up)  # the first is down
    scores = evidence.scores(np.concatenate([up[None], others]))
    sideways = 1 + int(np.argmax(scores[2:])) if len(others) > 1 else 0
    excess = float(scores[1 + sideways] - scores[:2].max()) if sideways else -np.inf
    opposite = float(scores[1] - scores[0])
    sky = evidence.sky(up) if opposite > 0 else Sky.UNKNOWN

    # a camera before a wall of a room sees little else; outdoors the ground is seen too
    if excess > LIMIT[by] and (
        float(scores[:2].max()) < FITS or evidence.sky(-others[sideways]) is Sky.OPEN
    ):
        return _by_map(expected, others[sideways], normals, weights, evidence)
    if sky in OPPOSITE and opposite > LIMIT[by] + OPPOSITE[sky]:
        return _by_map(expected, others[0], normals, weights, evidence, sky)

    lead = float(scores[0] - scores[1:].max())
    source = UpSource.MAP if by is UpSource.CONVENTION and lead >= CLEAR else by
    doubt = DOUBT_OPPOSITE[sky]
    if expected.imu is not None and sky is Sky.UNKNOWN:
        doubt = FLAGRANT
    other = None
    if excess > DOUBT[by]:
        other = others[sideways]
    elif opposite > doubt:
        other = others[0]
    problems = () if other is None else (_doubt(expected, up, other),)
    if not problems and source is UpSource.CONVENTION:
        problems = (_unsettled(expected, up, others[int(np.argmax(scores[1:]))]),)
    if not problems and expected.imu is not None and _degrees(up, expected.imu) > TILTED:
        problems = (_tilted(expected, up),)
    return _gravity(expected, up, prior, source, lead, problems)


def _by_map(
    expected: Expected,
    direction: F64,
    normals: F64,
    weights: F64,
    evidence: UpEvidence,
    sky: Sky = Sky.OPEN,
) -> Gravity:
    """Up near a ``direction`` (3,) that the map shows, against the expectation."""
    up = find_up(normals, weights, direction)
    scores = evidence.scores(np.concatenate([up[None], evidence.others(up)]))
    margin = float(scores[0] - scores[1:].max())
    if expected.imu is not None:
        problem = _contradiction(expected, up)
    else:
        problem = _found(expected, up, is_sure=margin >= CLEAR and sky is Sky.OPEN)
    return _gravity(expected, up, direction, UpSource.MAP, margin, (problem,))


def _gravity(
    expected: Expected,
    up: F64,
    prior: F64,
    source: UpSource,
    margin: float | None,
    problems: tuple[Problem, ...],
) -> Gravity:
    off_imu = None if expected.imu is None else _degrees(up, expected.imu)
    return Gravity(up, prior, source, margin, _degrees(up, expected.convention), off_imu, problems)


def _degrees(a: F64, b: F64) -> float:
    return float(np.degrees(angle_between(a, b)))


def _none(expected: Expected) -> Problem:
    return _assumption(
        expected,
        f"too few flat places show which way is up: {_axis(expected.convention)} of frame "
        f"'{expected.frame}' is taken as up by convention",
    )


def _doubt(expected: Expected, up: F64, other: F64) -> Problem:
    by = "by convention" if expected.imu is None else f"by {expected.imu_topic}"
    return _assumption(
        expected,
        f"the ground and the walls of the map do not settle which way is up: {_axis(up)} of frame "
        f"'{expected.frame}' is taken as up {by}, but {_axis(other)} fits better",
        expected.imu_topic if expected.imu is not None else "",
    )


def _unsettled(expected: Expected, up: F64, other: F64) -> Problem:
    """The convention fits as well as another direction: such as floor and ceiling of a room."""
    return _assumption(
        expected,
        f"the ground and the walls of the map do not settle which way is up: {_axis(up)} of frame "
        f"'{expected.frame}' is taken as up by convention, and {_axis(other)} fits about as well",
    )


def _tilted(expected: Expected, up: F64) -> Problem:
    """An IMU whose mounting is wrong; the map was levelled by its ground and walls."""
    assert expected.imu is not None
    text = (
        f"{expected.log}: up of {expected.imu_topic} is {_degrees(up, expected.imu):.0f} degrees "
        "off the ground and the walls of the map, which are used: its mounting is wrong, or its "
        "accelerometer."
    )
    return Problem(expected.imu_topic, ProblemKind.GRAVITY, text, lost=False)


def _contradiction(expected: Expected, up: F64) -> Problem:
    assert expected.imu is not None
    off = _degrees(up, expected.imu)
    return _assumption(
        expected,
        f"{expected.imu_topic} contradicts the map: its up is {off:.0f} degrees off; "
        f"{_axis(up)} of frame '{expected.frame}' is taken as up from the ground and the walls of "
        "the map: check the axes and the sign of the accelerometer",
        expected.imu_topic,
    )


def _found(expected: Expected, up: F64, *, is_sure: bool) -> Problem:
    off = _degrees(up, expected.convention)
    text = (
        f"up is {_axis(up)} of frame '{expected.frame}', {off:.0f} degrees off the convention of "
        "frames, as the ground and the walls of the map show"
    )
    if is_sure:
        return Problem("", ProblemKind.GRAVITY, f"{text}.", lost=False)
    return _assumption(expected, f"{text}, but another direction fits nearly as well")


def _assumption(expected: Expected, text: str, topic: str = "") -> Problem:
    remedy = "record an IMU, or " if expected.imu is None else ""
    return Problem(
        topic,
        ProblemKind.GRAVITY,
        f"{expected.log}: {text}; {remedy}name it with --set logs.up=X,Y,Z.",
        lost=False,
        assumed=True,
    )


def _axis(direction: F64) -> str:
    """Such as +z, or (0.50, 0.00, 0.87)."""
    unit = direction / np.linalg.norm(direction)
    axis = int(np.argmax(np.abs(unit)))
    if abs(unit[axis]) > np.cos(np.radians(10.0)):
        return f"{'+' if unit[axis] > 0 else '-'}{'xyz'[axis]}"
    return "(" + ", ".join(f"{x:.2f}" for x in unit) + ")"

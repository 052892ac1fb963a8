"""Whether poses and range data fit each other, stream by stream.

Keyframes that follow each other are registered. Where the motion that the range data show differs
from the one that the poses give, the hypotheses of :mod:`semloc_logs.mapping.fit.model` are tried;
each that explains much is named with its estimate.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.logs.poses.plausibility import implausible
from semloc_logs.logs.session.session import Session
from semloc_logs.mapping.fit.clock_drift import ClockDrift, clock_drift
from semloc_logs.mapping.fit.contradictions import (
    TELLING,
    add_contradictions,
    add_strangers,
    add_unexplained,
)
from semloc_logs.mapping.fit.evident_faults import add_evident_faults
from semloc_logs.mapping.fit.fault_texts import (
    clock_drift_text,
    clock_text,
    mounting_text,
    scale_text,
)
from semloc_logs.mapping.fit.findings import (
    LEAST_PAIRS,
    LEAST_SIGMAS,
    NAMES,
    NEAR_VOXELS,
    NOTED,
    WRONG,
    Finding,
    SessionFit,
    Severity,
    StreamFit,
)
from semloc_logs.mapping.fit.keyframe_pairs import (
    Clouds,
    Registered,
    SensorMounting,
    Start,
    choose,
    motion,
    noise,
    registered,
)
from semloc_logs.mapping.fit.local_drift import local_drift
from semloc_logs.mapping.fit.model import (
    CLOCK,
    LEVER,
    LONGEST_OFFSET,
    PARAMETERS,
    ROTATION,
    SCALE,
    Estimate,
    Fault,
    Pairs,
    PosesAt,
    agree_about_scale,
    difference,
    fit,
    pose_motion,
    scatter,
    starts,
)
from semloc_logs.mapping.fit.other_starts import Doubted
from semloc_logs.mapping.fit.readings import FAR_OFF, LEAST_GAIN, far_reading, near_reading
from semloc_logs.mapping.fit.shared_surfaces import offset_between
from semloc_logs.mapping.fit.way import other_distance, searched
from semloc_logs.mapping.keyframes import Collected

# pairs of a stream: one for so many keyframes, within these bounds; a pair costs about 15 ms
KEYFRAMES_A_PAIR = 8
FEWEST_PAIRS, MOST_PAIRS = 24, 400
# where a fault explains half of what it has to, three times as many pairs tell
ALMOST, MORE_PAIRS = 0.5, 3
# a fault is trusted where the cost falls by a third of what its parameters and their standard
# deviations let expect
AS_EXPECTED = 3.0
# median of the squared distances beyond which registration is tried from other starts
DOUBTFUL = 15.0
HIDDEN = 3.0  # a fault that the drive does not show before it has this effect is hidden
OTHER_AXES = np.radians(45.0)  # a mounting that is turned farther has other axes
OTHER_UNIT = np.log(1.5)  # of the scale; what else differs then follows from it
# clouds in a smaller unit than metres have few points in a cell, so that planes bring few points
# together: they are compared in cells so many times as large
SPARSE, COARSER = 0.15, 3.0
# of the scale, which moves the far end of a submap: odometry of wheels is off by 1 to 2 %
SCALE_NOTED, SCALE_WRONG = 0.03, 0.06


def check_session(session: Session, collected: Collected, voxel: float) -> SessionFit:
    """Checks the poses of a session that was read, and its keyframes against them."""
    track = session.track
    check = SessionFit(session.pose_name, implausible(track), session.is_frozen)
    if not len(track) or check.jump is not None:
        return check
    before: list[tuple[str, Clouds]] = []
    for topic in session.roles.ranging:
        rows = [i for i, h in enumerate(collected.headers) if h.topic == topic]
        clouds = Clouds(
            collected,
            np.array(rows, np.int64),
            voxel,
            session.sweep_span_of(topic),
            session.time_offset_of(topic),
        )
        clouds = replace(clouds, mounted=_mounted(session, clouds.frames()))
        stream = check_stream(topic, clouds, track.at_many, are_fixes=session.are_poses_fixes)
        stream.frames = sorted(clouds.frames())
        add_evident_faults(stream, session, clouds)
        if not stream.findings:
            compare(stream, clouds, before, track.at_many)
        if not stream.is_wrong:
            stream.drift = local_drift(clouds)
        check.streams.append(stream)
    return check


def _mounted(session: Session, frames: Set[str]) -> SensorMounting | None:
    """The mounting of a stream that has one frame, and one pose of it in the base frame."""
    [frame, *others] = sorted(frames) or [""]
    base_T_sensor = session.fixed_mounting(frame)
    return None if others or base_T_sensor is None else SensorMounting(frame, base_T_sensor)


def compare(
    stream: StreamFit, clouds: Clouds, before: list[tuple[str, Clouds]], poses_at: PosesAt
) -> None:
    """Compares a stream that fits the poses with the ones ``before`` it, by topic.

    It joins them where it agrees with all.
    """
    for topic, others in before:
        offset = offset_between(others, clouds, poses_at)
        for direction in (others.view_direction(), clouds.view_direction()):
            offset = offset.without(direction, clouds.voxel)
        if offset:
            text = mounting_text(offset.shift, offset.turn, offset.sigma, clouds)
            stream.findings.append(
                Finding(
                    Severity.WRONG,
                    f"beside {topic}, whose surfaces it sees, {text}, or correct the other one",
                )
            )
            return
    before.append((stream.topic, clouds))


def check_stream(
    topic: str, clouds: Clouds, poses_at: PosesAt, *, are_fixes: bool = False
) -> StreamFit:
    """Checks the keyframes of one stream against the poses.

    ``are_fixes``: the poses are fixes of a receiver, whose scatter is noted but not refused.
    """
    count = min(max(len(clouds.rows) // KEYFRAMES_A_PAIR, FEWEST_PAIRS), MOST_PAIRS)
    numbers = choose(clouds, count)
    bad_fit = Severity.NOTED if are_fixes else Severity.WRONG
    stream = _checked(topic, clouds, poses_at, numbers, bad_fit)
    if stream.is_doubtful and not stream.findings:
        more = choose(clouds, MORE_PAIRS * count)
        if len(more) > len(numbers):
            return _checked(topic, clouds, poses_at, more, bad_fit)
    return stream


def _checked(
    topic: str,
    clouds: Clouds,
    poses_at: PosesAt,
    numbers: Sequence[tuple[int, int]],
    bad_fit: Severity,
) -> StreamFit:
    """The check of chosen pairs; ``bad_fit``: of poses that contradict clouds without a fault."""
    given = registered(clouds, numbers)
    if stream := _in_other_unit(topic, clouds, poses_at, given):
        return stream
    if len(given.pairs) < LEAST_PAIRS:
        return _far_off(topic, clouds, poses_at, numbers, given)
    given = searched(clouds, given)
    others = [registered(clouds, numbers, start) for start in _starts(clouds, poses_at, given)]
    is_doubtful = False
    for registration in sorted(others, key=_share, reverse=True):
        stream = _judged(topic, clouds, poses_at, registration)
        if stream.findings:
            return stream
        is_doubtful |= stream.is_doubtful
    stream = _judged(topic, clouds, poses_at, given)
    stream.is_doubtful |= is_doubtful
    # a sensor that looks one way sees other surfaces soon: registration ends where it sees more
    if not stream.findings and not clouds.sees_one_side():
        best = max([given, *others], key=_share)
        add_contradictions(stream, best, poses_at, clouds, bad_fit)
        if not stream.findings:
            add_strangers(stream, clouds, numbers, given)
    elif not stream.findings:
        add_unexplained(stream, given, poses_at, clouds)
    return stream


def _far_off(
    topic: str,
    clouds: Clouds,
    poses_at: PosesAt,
    numbers: Sequence[tuple[int, int]],
    given: Registered,
) -> StreamFit:
    """The check where by the poses hardly any clouds meet, as where these are in centimetres.

    Clouds that meet well without any motion tell all the same.
    """
    unknown = StreamFit(topic, len(given.pairs))
    if len(numbers) < LEAST_PAIRS:
        return unknown
    unmoved = registered(clouds, numbers, lambda target, source: np.eye(4))
    if len(unmoved.pairs) < LEAST_PAIRS or float(np.median(unmoved.share)) < TELLING:
        return unknown
    stream = _judged(topic, clouds, poses_at, unmoved)
    return stream if stream.findings else unknown


def _in_other_unit(
    topic: str, clouds: Clouds, poses_at: PosesAt, given: Registered
) -> StreamFit | None:
    """The check of sparse clouds in larger cells, where these lie at another distance."""
    is_sparse = not len(given.pairs) or float(np.median(given.share)) < SPARSE
    if not is_sparse or clouds.sees_one_side():
        return None
    coarse = replace(clouds, voxel=COARSER * clouds.voxel)
    numbers = choose(coarse, FEWEST_PAIRS)
    in_cells = registered(coarse, numbers)
    far = other_distance(coarse, in_cells) if len(in_cells.pairs) >= LEAST_PAIRS else None
    if far is None:
        return None
    longer = registered(coarse, numbers, far)
    squares = in_cells.pairs.squares(pose_motion(in_cells.pairs, poses_at, np.zeros(PARAMETERS)))
    for start in Doubted.of(coarse, in_cells, squares).motions():
        if _share(registered(coarse, numbers, start)) > _share(longer):
            return None  # such as other axes
    stream = _judged(topic, coarse, poses_at, longer)
    return stream if stream.findings else None


def _share(registration: Registered) -> float:
    """The points on planes, as shares summed over the pairs."""
    return float(registration.share.sum())


def _starts(clouds: Clouds, poses_at: PosesAt, given: Registered) -> Iterator[Start]:
    """Other motions than ``given`` ones to start registration from, where they fit far better."""
    far = other_distance(clouds, given)
    if far is not None:
        yield far
    squares = given.pairs.squares(pose_motion(given.pairs, poses_at, np.zeros(PARAMETERS)))
    # poses from which registration hardly moves are not far off
    if float(np.nanmedian(squares)) > DOUBTFUL:
        doubted = Doubted.of(clouds, given, squares)
        yield from doubted.motions()
        if other := doubted.other_poses(poses_at):
            yield other


def _judged(topic: str, clouds: Clouds, poses_at: PosesAt, registration: Registered) -> StreamFit:
    """The faults that explain registered pairs."""
    pairs = registration.pairs
    zero = np.zeros(PARAMETERS)
    none = fit(pairs, poses_at, np.zeros(0, np.int64), zero)
    off = difference(pairs.measured, pose_motion(pairs, poses_at, zero))
    stream = StreamFit(
        topic,
        len(pairs),
        float(np.nanmedian(np.linalg.norm(off[:, :3], axis=1))),
        float(np.nanmedian(np.linalg.norm(off[:, 3:], axis=1))),
    )
    if reading := far_reading(pairs, poses_at, none.squares, clouds):
        stream.findings.append(Finding(Severity.WRONG, reading))
        return stream
    explanation = _explained(pairs, poses_at, none)
    if explanation.faults:
        # a registration from there ends at the right motion where others did not
        refined = registered(
            clouds, registration.numbers.tolist(), _start(clouds, poses_at, explanation.estimate)
        )
        pairs = refined.pairs
        none = fit(pairs, poses_at, np.zeros(0, np.int64), zero)
        explanation = _explained(pairs, poses_at, none)
    estimate = explanation.estimate
    faults = explanation.faults
    stream.is_doubtful = explanation.is_doubtful
    if reading := near_reading(pairs, poses_at, none.cost, estimate.cost):
        stream.findings.append(Finding(Severity.WRONG, reading))
        return stream
    rest = float(np.nanmedian(estimate.squares))
    if rest < FAR_OFF or rest < FAR_OFF * noise(clouds, registration):
        drift = clock_drift(pairs, poses_at, estimate)
        if drift is not None and drift.is_sure and _drift_effect(drift, clouds) >= WRONG:
            stream.findings.append(Finding(Severity.WRONG, clock_drift_text(drift)))
            faults = [fault for fault in faults if fault is not Fault.CLOCK]
        _describe(stream, estimate, faults, clouds)
        joint = fit(pairs, poses_at, np.arange(PARAMETERS), estimate.parameters)
        _enter(stream, joint, clouds)
    return stream


def _start(clouds: Clouds, poses_at: PosesAt, estimate: Estimate) -> Start:
    """Registration starts from the motions that the estimate gives; from the poses without one."""
    stamps_ns = clouds.stamps_ns()

    def start(target: int, source: int) -> F64:
        one = Pairs(stamps_ns[[[target, source]]], np.eye(4)[None], np.eye(6)[None])
        predicted = pose_motion(one, poses_at, estimate.parameters)[0]
        is_known = bool(np.isfinite(predicted).all())
        return predicted if is_known else motion(clouds, target, source)

    return start


@dataclass(frozen=True, slots=True)
class _Explanation:
    """The estimate with every fault that explains enough, the one that explains most first.

    ``is_doubtful``: one more almost does.
    """

    estimate: Estimate
    faults: list[Fault]
    is_doubtful: bool


def _explained(pairs: Pairs, poses_at: PosesAt, none: Estimate) -> _Explanation:
    estimate = none
    faults: list[Fault] = []
    explained = 0.0
    possible = [f for f in Fault if f is not Fault.SCALE or agree_about_scale(pairs, poses_at)]
    while len(faults) < len(possible):
        tries = {f: _with(pairs, poses_at, estimate, f) for f in possible if f not in faults}
        fault, better = min(tries.items(), key=lambda item: item[1].cost)
        explained = explained_share(fault, estimate, better)
        if explained < 1.0:
            break
        estimate = better
        faults.append(fault)
    return _Explanation(estimate, faults, ALMOST <= explained < 1.0)


def explained_share(fault: Fault, before: Estimate, after: Estimate) -> float:
    """By how much one more ``fault`` lowers the cost, as a share of what it has to; 1 is enough.

    Beside the noise that pairs are expected to have; or beside the noise that they show, where the
    cost falls as the parameters and their standard deviations have it. A dip of the cost far off
    is narrow: poses that jitter have many.
    """
    gain = before.cost - after.cost
    shown = scatter(after.squares)
    least = LEAST_GAIN + len(fault.columns)
    sigmas = [
        (after.parameters[column] - before.parameters[column]) / max(after.sigma(column), 1e-9)
        for column in fault.columns.tolist()
    ]
    expected = 0.5 * float(np.square(sigmas).sum())
    beside_expected = gain / max(1.0, shown) / least
    return max(beside_expected, gain / shown / max(least, expected / AS_EXPECTED))


def _with(pairs: Pairs, poses_at: PosesAt, estimate: Estimate, fault: Fault) -> Estimate:
    """The estimate with one more fault free."""
    free = np.union1d(estimate.free, fault.columns)
    fits = [
        fit(pairs, poses_at, free, start)
        for start in starts(pairs, poses_at, fault, estimate.parameters)
    ]
    return min(fits, key=lambda e: e.cost)


def _describe(stream: StreamFit, estimate: Estimate, faults: list[Fault], clouds: Clouds) -> None:
    """Enters a finding for each fault that matters."""
    # other axes and units move the points of a sweep the wrong way as they are freed of the motion,
    # which looks like a clock or a lever arm
    turned = float(np.linalg.norm(_significant(estimate, Fault.ROTATION)[ROTATION]))
    if Fault.ROTATION in faults and turned > OTHER_AXES:
        faults = [Fault.ROTATION]
    elif abs(_significant(estimate, Fault.SCALE)[SCALE]) > OTHER_UNIT and Fault.SCALE in faults:
        faults = [Fault.SCALE]
    known = {fault: _significant(estimate, fault) for fault in faults}
    effects = {fault: _effect(known[fault], fault, clouds) for fault in faults}
    named = [fault for fault in faults if effects[fault] >= NOTED]
    texts: dict[str, float] = {}  # a turned and shifted mounting is one
    for fault in named:
        text = _fault_text(estimate, known, fault, stream.topic, clouds)
        texts[text] = max(effects[fault], texts.get(text, 0.0))
    for text, effect in texts.items():
        severity = Severity.WRONG if effect >= WRONG else Severity.NOTED
        stream.findings.append(Finding(severity, text))


def _fault_text(
    estimate: Estimate, known: Mapping[Fault, F64], fault: Fault, topic: str, clouds: Clouds
) -> str:
    """The sentence's end about a fault, of its ``known`` parameters (8,)."""
    if fault is Fault.CLOCK:
        offset = float(known[fault][CLOCK])
        return clock_text(topic, offset, estimate.sigma(CLOCK), clouds)
    if fault is Fault.SCALE:
        return scale_text(float(known[fault][SCALE]), estimate.sigma(SCALE))
    nothing = np.zeros(PARAMETERS)
    shift = known.get(Fault.LEVER, nothing)[LEVER]
    turn = known.get(Fault.ROTATION, nothing)[ROTATION]
    columns = np.r_[LEVER, ROTATION].tolist()
    sigma = np.array([estimate.sigma(column) for column in columns])
    return mounting_text(shift, turn, sigma, clouds)


def _drift_effect(drift: ClockDrift, clouds: Clouds) -> float:
    """What is left at the ends of a drive (voxels) where the stamps are corrected in the mean."""
    left = np.zeros(PARAMETERS)
    left[CLOCK] = 0.5 * drift.change
    return _effect(left, Fault.CLOCK, clouds)


def _enter(stream: StreamFit, joint: Estimate, clouds: Clouds) -> None:
    """Enters the parameters, all estimated together, and the faults that the drive would hide."""
    for column, name in enumerate(NAMES):
        stream.parameters[name] = float(joint.parameters[column]), joint.sigma(column)
    for fault in Fault:
        for column in fault.columns.tolist():
            # nothing that drives on the level shows a height, which moves the whole map alike
            if column == LEVER.stop - 1:
                continue
            least = np.zeros(PARAMETERS)
            least[column] = LEAST_SIGMAS * joint.sigma(column)  # smaller ones are not sure
            if _effect(least, fault, clouds) > HIDDEN:
                stream.hidden.append(list(NAMES)[column])


def _significant(estimate: Estimate, fault: Fault) -> F64:
    """The parameters (8,) of a fault that differ from zero for sure; 0 for all others."""
    known = np.zeros(PARAMETERS)
    for column in fault.columns:
        if abs(estimate.parameters[column]) >= LEAST_SIGMAS * estimate.sigma(column):
            known[column] = estimate.parameters[column]
    if abs(known[CLOCK]) > 0.98 * LONGEST_OFFSET:  # not found within the range of the search
        known[CLOCK] = 0.0
    return known


def _effect(parameters: F64, fault: Fault, clouds: Clouds) -> float:
    """What a fault does to a closure, in voxels (:data:`NOTED`, :data:`WRONG`)."""
    if fault is Fault.CLOCK:
        speed, turn_rate = clouds.rates
        shift = max(speed / clouds.voxel, turn_rate * NEAR_VOXELS)
        return abs(float(parameters[CLOCK])) * shift
    if fault is Fault.ROTATION:
        return float(np.linalg.norm(parameters[ROTATION])) * NEAR_VOXELS
    if fault is Fault.LEVER:
        return float(np.linalg.norm(parameters[LEVER])) / clouds.voxel
    change = abs(float(np.expm1(parameters[SCALE])))
    return WRONG * change / SCALE_WRONG if change >= SCALE_NOTED else 0.0

"""Whether poses and range data fit each other, stream by stream.

Keyframes that follow each other are registered. Where the motion that the range data show differs
from the one that the poses give, the hypotheses of :mod:`semloc_logs.mapping.fit.model` are tried;
each that explains much is named with its estimate.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence, Set

import numpy as np
from numpy.typing import NDArray

from semloc_logs.logs.messages.stamps import time_range
from semloc_logs.logs.poses.plausibility import implausible
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.logs.session.session import Session
from semloc_logs.mapping.fit.fault_texts import fault_text
from semloc_logs.mapping.fit.findings import (
    LEAST_PAIRS,
    LEAST_SIGMAS,
    NAMES,
    Finding,
    SessionFit,
    Severity,
    StreamFit,
)
from semloc_logs.mapping.fit.interpolation import interpolation_errors
from semloc_logs.mapping.fit.keyframe_pairs import (
    LEAST_SHARE,
    Clouds,
    Registered,
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
    MEDIAN_OF_6,
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
from semloc_logs.mapping.fit.way import other_distance, searched
from semloc_logs.mapping.keyframes import Collected

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

# pairs of a stream: one for so many keyframes, within these bounds; a pair costs about 15 ms
KEYFRAMES_A_PAIR = 8
FEWEST_PAIRS, MOST_PAIRS = 24, 400
# a hypothesis explains much: it lowers half of chi squared by :data:`LEAST_GAIN`, and its parameter
# differs from zero by :data:`LEAST_SIGMAS`
AS_EXPECTED = 3.0  # a gain of cost is as expected down to one part of so many
# squared distances in the median beyond which other starts of registration are tried; and up to
# which faults explain the pairs, more with noisy registrations
DOUBTFUL = 15.0
# a pair contradicts its poses when registration brings so many times the points onto planes
CONTRADICTS = 1.15
# registrations with a smaller share of points on planes may have ended anywhere; a sensor with few
# lines has so few on planes everywhere, which tell where it brings far more onto them
TELLING = 0.2
FEW_TELLING, FEW_CONTRADICT = 0.08, 1.5
CONTRADICTION = 50.0  # and its squared distance is larger
# a camera's clouds move otherwise in the median: voxels, and radians
MOST_OFF, MOST_TURNED = 2.5, 0.045
UNEXPLAINED = 30.0  # times the noise of registration, of squared distances in the median
LEAST_CONTRADICTIONS = 2  # one after the other

# clouds usually have so many times the least share of points on planes of the ones beside them; so
# many pairs in a row that have less are more than one damaged cloud
USUALLY_ALIKE, LEAST_STRANGERS = 5.0, 3

# what a closure would suffer, in voxels: noted above the first, wrong above the second
NOTED, WRONG = 0.5, 1.0
LATEST_POSES = 5.0  # s; ones that are computed slowly are recorded within two, most of them
OFTEN = 0.9  # of the keyframes have a smaller error
FARTHEST_MOUNTING = 100.0  # m; ships are longer, but carry no sensors so far from their middle
HIDDEN = 3.0  # a fault that the drive does not show before it has this effect is hidden
OTHER_AXES = np.radians(45.0)  # a mounting that is turned farther has other axes
WRONG_TURN = 0.03  # rad, within a pair: a submap of 20 m would be bent by 15 degrees
LEAST_DRIFT = np.radians(0.3)  # rad/m, worth a word: odometry drifts by a tenth of it
STEADY = 0.9  # of the turns of contradicting pairs, summed up, where poses drift to one side
NEAR_VOXELS = 33.0  # a rotation moves points at this distance (10 m at 0.30 m voxels)
# of the scale, which moves the far end of a submap: odometry of wheels is off by 1 to 2 %
SCALE_NOTED, SCALE_WRONG = 0.03, 0.06


_STUCK_TEXT = (
    "many of its stamps hardly differ although they were recorded at other times; use the times of"
    " recording with --set logs.stamps=log"
)


def check_session(session: Session, collected: Collected, voxel: float) -> SessionFit:
    """Checks the poses of a session that was read, and its keyframes against them."""
    track = session.track
    check = SessionFit(session.pose_name, implausible(track), session.is_frozen)
    if not len(track) or check.jump is not None:
        return check
    for topic in session.roles.ranging:
        rows = [i for i, h in enumerate(collected.headers) if h.topic == topic]
        span = session.sweep_span_of(topic)
        clouds = Clouds(collected, np.array(rows, np.int64), voxel, span)
        stream = check_stream(topic, clouds, track.at_many, are_fixes=session.are_poses_fixes)
        # what follows from these would be named with other causes
        frames = {collected.headers[row].frame_id for row in rows}
        known = _stuck(session, topic) or _mounting_text(session, frames, voxel)
        if known:
            stream.findings = [Finding(Severity.WRONG, known)]
        if not session.are_poses_fixes:
            _add_coarse(stream, track, clouds)
        _add_far_clock(stream, session.shift_of(topic))
        _add_lead(stream, session.lead_of(topic), clouds)
        _add_off_stamp(stream, session.off_stamp_of(topic), clouds)
        if not stream.is_wrong:
            stream.drift = local_drift(clouds)
        check.streams.append(stream)
    return check


def _stuck(session: Session, topic: str) -> str:
    """A clock that stands still, or a sensor that repeats itself; else empty."""
    return _STUCK_TEXT if session.is_stuck(topic) else session.repeats(topic)


def _mounting_text(session: Session, frames: Set[str], voxel: float) -> str:
    """A mounting of ``frames`` that is not in metres, or that changes; else empty."""
    base_T_sensors = session.base_T_sensors()
    for frame in sorted(frames & base_T_sensors.keys()):
        distance = float(np.linalg.norm(base_T_sensors[frame][:3, 3]))
        if distance > FARTHEST_MOUNTING:
            return (
                f"its frame '{frame}' is mounted {distance:.0f} m from '{session.base_frame}': the"
                " transform is not in metres, or of another vehicle; correct it"
            )
        for (parent, child), change in session.mounting_changes(frame).items():
            if change.distance / voxel + change.angle * NEAR_VOXELS >= WRONG:
                return (
                    f"the mounting of '{child}' in '{parent}' is recorded with values that differ"
                    f" by {change.distance:.2f} m and {np.degrees(change.angle):.1f} degrees: it"
                    " was calibrated anew, or has two publishers; cut the log there, or give the"
                    f" right one with --set logs.mountings.{child}=[x,y,z,qx,qy,qz,qw]"
                )
    return ""


def _add_coarse(stream: StreamFit, track: PoseTrack, clouds: Clouds) -> None:
    """Poses that are too far apart: errors between them look like a clock."""
    meters, radians = interpolation_errors(track, clouds.stamps_ns())
    effects = meters / clouds.voxel + radians * NEAR_VOXELS
    if not len(effects) or float(np.quantile(effects, OFTEN)) < WRONG:
        return
    apart = float(np.median(np.diff(track.stamps_ns))) * 1e-9
    text = (
        f"the poses are {apart:.1f} s apart, too far for this drive: between them they are off by"
        f" up to {meters.max():.1f} m and {np.degrees(radians.max()):.0f} degrees; record poses"
        " more often, or use --odometry lidar"
    )
    stream.findings = [Finding(Severity.WRONG, text)]


def _add_far_clock(stream: StreamFit, shift: float) -> None:
    """Stamps that are farther off beside their recording than the search for a clock reaches.

    What the search found is something else then. No sensor is recorded so late, poses hardly are.
    """
    if -LATEST_POSES <= shift <= LONGEST_OFFSET:
        return
    side = "earlier" if shift > 0 else "later"
    text = (
        f"its stamps are {abs(shift):.2f} s {side} beside their recording than the ones of the"
        " poses: the clock of one of both is another; give --set logs.time_offset."
        f"{stream.topic}={shift:+.2f}, or --stamps log"
    )
    stream.findings = [Finding(Severity.WRONG, text)]


def _add_lead(stream: StreamFit, lead: float, clouds: Clouds) -> None:
    """Stamps that are later than their recording are wrong, also where the drive does not show it.

    A steady drive along a street hides a clock.
    """
    if stream.findings or lead * clouds.rates[0] < WRONG * clouds.voxel:
        return
    stream.findings.append(
        Finding(
            Severity.WRONG,
            f"its stamps are up to {lead:.2f} s later than its recording, which the stamps of the"
            " poses are not: its clock is another one, or was set; give --set logs.time_offset."
            f"{stream.topic}={-lead:+.2f} where this holds for the whole log, else cut the log",
        )
    )


def _add_off_stamp(stream: StreamFit, seconds: float, clouds: Clouds) -> None:
    """Times of points and of their header that contradict each other, wherever it matters."""
    if stream.findings or seconds * clouds.rates[0] < WRONG * clouds.voxel:
        return
    stream.findings.append(
        Finding(
            Severity.WRONG,
            f"its points were all measured {seconds:.2f} s or more before or after the stamp of"
            " their sweep: the stamps or the times of the points are wrong; record sweeps with"
            " times that agree",
        )
    )


def check_stream(
    topic: str, clouds: Clouds, poses_at: PosesAt, *, are_fixes: bool = False
) -> StreamFit:
    """Checks the keyframes of one stream against the poses.

    ``are_fixes``: the poses are fixes of a receiver, whose scatter is noted but not refused.
    """
    count = len(clouds.rows) // KEYFRAMES_A_PAIR
    numbers = choose(clouds, min(max(count, FEWEST_PAIRS), MOST_PAIRS))
    given = registered(clouds, numbers)
    if len(given.pairs) < LEAST_PAIRS:
        return _far_off(topic, clouds, poses_at, numbers, given)
    given = searched(clouds, given)
    tried = [given]
    for start in _starts(clouds, poses_at, given):
        tried.append(registered(clouds, numbers, start))
        stream = _judged(topic, clouds, poses_at, tried[-1])
        if stream.findings:
            return stream
    stream = _judged(topic, clouds, poses_at, given)
    # a sensor that looks one way sees other surfaces soon: registration ends where it sees more
    if not stream.findings and not clouds.sees_one_side():
        best = max(tried, key=lambda found: float(found.share.sum()))
        _contradictions(
            stream, best, poses_at, clouds, Severity.NOTED if are_fixes else Severity.WRONG
        )
        if not stream.findings:
            _strangers(stream, clouds, numbers, given)
    elif not stream.findings:
        _unexplained(stream, given, poses_at, clouds)
    return stream


def _strangers(
    stream: StreamFit, clouds: Clouds, numbers: Sequence[tuple[int, int]], given: Registered
) -> None:
    """Names the time where clouds fit none beside them, from any start, although most others do."""
    if float(np.median(given.share)) < USUALLY_ALIKE * LEAST_SHARE:
        return
    fitting = {(target, source) for target, source in given.numbers.tolist()}
    lost = [pair for pair in numbers if pair not in fitting]
    if not lost:
        return
    # of the pairs between the chosen ones, the ones beside these
    everything = choose(clouds, len(clouds.rows))
    place = {pair: number for number, pair in enumerate(everything)}
    beside = {place[pair] + step for pair in lost for step in (-1, 1)}
    untold = [everything[n] for n in sorted(beside) if 0 <= n < len(everything)]
    untold = [pair for pair in untold if pair not in numbers]
    found = registered(clouds, untold).numbers.tolist() if untold else []
    lost += [pair for pair in untold if list(pair) not in found]
    rows = np.array(sorted(place[pair] for pair in lost), np.int64)
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    rows = np.concatenate([run for run in runs if len(run) >= LEAST_STRANGERS] or [rows[:0]])
    if not len(rows):
        return
    stamps_ns = clouds.stamps_ns()[np.array([everything[row] for row in rows])]
    when = time_range(int(stamps_ns.min()), int(stamps_ns.max()))
    stream.findings.append(
        Finding(
            Severity.WRONG,
            f"{len(rows)} pairs of its clouds, one after the other, have no surfaces in common"
            f" ({when}), which the others have: the sensor measured nothing but noise there, or was"
            " covered; cut the log there",
        )
    )


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
    found = registered(clouds, numbers, lambda target, source: np.eye(4))
    if len(found.pairs) < LEAST_PAIRS or float(np.median(found.share)) < TELLING:
        return unknown
    stream = _judged(topic, clouds, poses_at, found)
    return stream if stream.findings else unknown


def _unexplained(stream: StreamFit, found: Registered, poses_at: PosesAt, clouds: Clouds) -> None:
    """Names a camera most of whose pairs move otherwise than the poses, far beyond its noise."""
    squares = found.pairs.squares(pose_motion(found.pairs, poses_at, np.zeros(PARAMETERS)))
    is_off = stream.translation_m > MOST_OFF * clouds.voxel or stream.rotation_rad > MOST_TURNED
    usual = float(np.nanmedian(squares))
    if not is_off or usual < UNEXPLAINED or usual < UNEXPLAINED * noise(clouds, found):
        return
    stream.findings.append(
        Finding(
            Severity.WRONG,
            f"most of its clouds move otherwise than the poses, by {stream.translation_m:.2f} m and"
            f" {np.degrees(stream.rotation_rad):.1f} degrees in the median of"
            f" {len(found.pairs)} pairs, and no offset of a clock or a mounting explains it: its"
            " calibration (CameraInfo, K, baseline, unit of depth) or the poses are wrong",
        )
    )


def _starts(clouds: Clouds, poses_at: PosesAt, given: Registered) -> Iterator[Start]:
    """Other motions than ``given`` ones to start registration from, where they fit far better."""
    far = other_distance(clouds, given)
    if far is not None:
        yield far
    squares = given.pairs.squares(pose_motion(given.pairs, poses_at, np.zeros(PARAMETERS)))
    # poses from which registration hardly moves are not far off
    if float(np.nanmedian(squares)) > DOUBTFUL:
        doubted = Doubted.of(clouds, given, squares)
        for start in (doubted.motion(), doubted.other_poses(poses_at)):
            if start is not None:
                yield start


def _judged(topic: str, clouds: Clouds, poses_at: PosesAt, found: Registered) -> StreamFit:
    """The faults that explain registered pairs."""
    pairs = found.pairs
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
    estimate, faults = _explained(pairs, poses_at, none)
    if faults:
        # a registration from there ends at the right motion where others did not
        refined = registered(clouds, found.numbers.tolist(), _start(clouds, poses_at, estimate))
        pairs = refined.pairs
        none = fit(pairs, poses_at, np.zeros(0, np.int64), zero)
        estimate, faults = _explained(pairs, poses_at, none)
    if reading := near_reading(pairs, poses_at, none.cost, estimate.cost):
        stream.findings.append(Finding(Severity.WRONG, reading))
        return stream
    rest = float(np.nanmedian(estimate.squares))
    if rest < FAR_OFF or rest < FAR_OFF * noise(clouds, found):
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


def _explained(pairs: Pairs, poses_at: PosesAt, none: Estimate) -> tuple[Estimate, list[Fault]]:
    """The estimate with every fault that explains much, the one that explains most first."""
    estimate = none
    faults: list[Fault] = []
    possible = [f for f in Fault if f is not Fault.SCALE or agree_about_scale(pairs, poses_at)]
    while len(faults) < len(possible):
        tries = {f: _with(pairs, poses_at, estimate, f) for f in possible if f not in faults}
        fault, better = min(tries.items(), key=lambda item: item[1].cost)
        if not explains_much(fault, estimate, better):
            break
        estimate = better
        faults.append(fault)
    return estimate, faults


def explains_much(fault: Fault, before: Estimate, after: Estimate) -> bool:
    """Whether one more ``fault`` lowers the cost by much.

    Beside the noise that pairs are expected to have; or beside the noise that they show, where the
    cost falls as the parameters and their standard deviations have it. A dip of the cost far off
    is narrow: poses that jitter have many.
    """
    gain = before.cost - after.cost
    shown = scatter(after.squares)
    least = LEAST_GAIN + len(fault.columns)
    if gain / max(1.0, shown) >= least:
        return True
    sigmas = [
        (after.parameters[column] - before.parameters[column]) / max(after.sigma(column), 1e-9)
        for column in fault.columns.tolist()
    ]
    expected = 0.5 * float(np.square(sigmas).sum())
    return gain / shown >= max(least, expected / AS_EXPECTED)


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
    # other axes move the points of a sweep the wrong way as they are freed of the motion, which
    # looks like a clock or a lever arm
    turned = float(np.linalg.norm(_significant(estimate, Fault.ROTATION)[ROTATION]))
    are_other_axes = Fault.ROTATION in faults and turned > OTHER_AXES
    for fault in [Fault.ROTATION] if are_other_axes else faults:
        known = _significant(estimate, fault)
        effect = _effect(known, fault, clouds)
        if effect >= NOTED:
            severity = Severity.WRONG if effect >= WRONG else Severity.NOTED
            text = fault_text(fault, known, estimate.sigma, stream.topic, clouds)
            stream.findings.append(Finding(severity, text))


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


def _contradictions(
    stream: StreamFit,
    found: Registered,
    poses_at: PosesAt,
    clouds: Clouds,
    severity: Severity,
) -> None:
    """Names the time where clouds move otherwise than the poses, and nothing else explains it."""
    predicted = pose_motion(found.pairs, poses_at, np.zeros(PARAMETERS))
    squares = found.pairs.squares(predicted)
    off = difference(found.pairs.measured, predicted)
    meters = np.linalg.norm(off[:, :3], axis=1)
    radians = np.linalg.norm(off[:, 3:], axis=1)
    with np.errstate(invalid="ignore"):
        gain = found.share / np.maximum(found.given_share, 1e-9)
        is_other = (gain > CONTRADICTS) & (found.share > TELLING)
        is_other |= (gain > FEW_CONTRADICT) & (found.share > FEW_TELLING)
        is_other &= squares > CONTRADICTION
        is_other &= (meters > WRONG * clouds.voxel) | (radians > WRONG_TURN)
    if not is_other.any():
        return
    # where most pairs are off, their median does not show the noise
    usual = float(np.nanmedian(squares)) / MEDIAN_OF_6
    excess = max(1.0, min(usual, noise(clouds, found)))
    rows = np.flatnonzero(is_other & (squares > CONTRADICTION * excess))
    # single ones are registrations that went wrong
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    rows = np.concatenate([run for run in runs if len(run) >= LEAST_CONTRADICTIONS] or [rows[:0]])
    if not len(rows):
        return
    first = int(found.pairs.stamps_ns[rows].min())
    last = int(found.pairs.stamps_ns[rows].max())
    farthest = float(meters[rows].max())
    most_turned = float(np.degrees(radians[rows].max()))
    stream.findings.append(
        Finding(
            severity,
            f"{len(rows)} of {len(found.pairs)} pairs of its clouds move otherwise than the poses,"
            f" by up to {farthest:.1f} m and {most_turned:.0f} degrees ({time_range(first, last)}):"
            f" the poses are wrong there{_drift_text(off[rows], predicted[rows])}; cut the log, or"
            " give others with --poses FILE",
        )
    )


def _drift_text(off: F64, predicted: F64) -> str:
    """How fast poses drift that turn wrongly everywhere and to the same side; else empty."""
    way = np.linalg.norm(predicted[:, :3, 3], axis=1).sum()
    turns = off[:, 3:]
    together = float(np.linalg.norm(turns.sum(0)))
    is_steady = together >= STEADY * float(np.linalg.norm(turns, axis=1).sum())
    if not is_steady or together < LEAST_DRIFT * way:
        return ""
    return f", their rotation drifts by {np.degrees(together) / way:.1f} degrees a metre"

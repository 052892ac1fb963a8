"""Whether a track is one that a vehicle, a robot or a hand can have made."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.logs.messages.stamps import duration, time_range, utc
from semloc_logs.logs.poses.track import PoseTrack

# acceleration (m/s^2) and turn rate (rad/s) that nothing exceeds which carries the sensor; a step
# beyond them by more than the slack (m, rad) is a jump. Braking is below 12 m/s^2, a hand turns
# with up to 10 rad/s. The slack is above what a correction of SLAM or a fix of RTK adds.
ACCELERATION = 15.0
TURN_RATE = 12.0
SLACK = 1.0
TURN_SLACK = 0.5
FASTEST = 120.0  # m/s; trains are slower
NEIGHBOURS = 5  # steps on either side that tell the speed around a step
# two sources in turn: so large a share of the poses is left at once
INTERLEAVED = 0.1
EXACTLY = 0.3  # of the poses that jump are at one pose, to which they jump each time
# a track that begins again: its pose is the identity but for this (m, rad), far from where it was
AT_IDENTITY, TURNED_AT_IDENTITY = 0.1, 0.02
FAR = 2.0
# poses of one publisher before and after another's lie as far apart each time, within this share of
# the jump to the other's
STEADY = 0.15
# poses that are exactly the same for so long (s), at once from or to a speed (m/s) that braking
# within two steps does not explain, were not measured; so many steps tell the speed
FROZEN = 1.0
SLOW = 1.0
AT_SPEED = 3
HELD = 0.5  # of the steps are exactly none, and of the other ones are jumps: poses are repeated
# a step over a gap that is this much of a usual one at most: the stamps have a gap, not the poses
USUAL = 2.0
STILL_TURN = 1e-6
# a vehicle at more than this speed (m/s) before and after a gap of so many seconds at most, which
# turned nowhere, has not gone less than this share of the way
FASTER = 2.0
LONGEST_STOP = 5.0
SHORT = 0.1


@dataclass(frozen=True, slots=True)
class Jump:
    """Steps of a track that nothing can make: their ``stamps_ns``, and the sentence's end."""

    stamps_ns: tuple[int, ...]
    text: str


def implausible(track: PoseTrack) -> Jump | None:
    """What is impossible about a track; None where nothing is."""
    stamps_ns = track.stamps_ns
    if len(stamps_ns) < 3:
        return None
    poses = track.poses
    seconds = np.diff(stamps_ns) * 1e-9
    way = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turn = _turns(poses)

    speed = way / seconds
    around = _around(speed)
    excess = way - around * seconds - ACCELERATION * seconds**2
    turned = turn - _around(turn / seconds) * seconds - TURN_RATE * seconds
    jumps = (excess > SLACK) | (turned > TURN_SLACK)
    jumps &= seconds * 1e9 <= track.gap_limit_ns()
    restarts = _restarts(poses, jumps | (seconds * 1e9 > track.gap_limit_ns()))

    to_and_fro = _to_and_fro(poses, way, seconds)
    if to_and_fro.sum() >= max(3, INTERLEAVED * len(jumps)):
        return _in_turn(stamps_ns, to_and_fro, poses)
    if restarts.any():
        step = int(np.flatnonzero(restarts)[0])
        silent_ns = int(stamps_ns[step + 1] - stamps_ns[step])
        gap = (
            f" after {duration(silent_ns)} without any" if silent_ns > track.gap_limit_ns() else ""
        )
        text = (
            f"the poses start again at the identity at {utc(int(stamps_ns[step + 1]))}{gap},"
            f" {np.linalg.norm(poses[step, :3, 3]):.1f} m from where they were: the odometry was"
            " reset, or its clock was set; cut the log there into two sessions"
        )
        return Jump(tuple(stamps_ns[1:][restarts].tolist()), text)
    if jumps.any():
        held = _held(stamps_ns, jumps, way, turn)
        return held or _jumped(track, jumps, way, turn)
    if frozen := _frozen(stamps_ns, way, turn, seconds):
        return frozen
    if lost := _lost_in_gap(track, way, turn, seconds):
        return lost
    usual = float(np.median(speed[way > 0])) if (way > 0).any() else 0.0
    if usual > FASTEST:
        text = (
            f"the poses move at {usual:.0f} m/s: they are not in metres, or their stamps are wrong"
        )
        return Jump((int(stamps_ns[0]),), text)
    return None


def _turns(poses: F64) -> F64:
    """Angle (n - 1,) of each step, radians."""
    return _angles(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3])


def _angles(rotations: F64) -> F64:
    """Angles (n,) of rotations (n, 3, 3), radians."""
    cosine = 0.5 * (np.trace(rotations, axis1=1, axis2=2) - 1.0)
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _around(values: F64) -> F64:
    """For each value the larger of the medians of the values before and after it."""
    n = len(values)
    padded = np.full(n + 2 * NEIGHBOURS, np.nan)
    padded[NEIGHBOURS : NEIGHBOURS + n] = values
    windows = np.lib.stride_tricks.sliding_window_view(padded, NEIGHBOURS)
    medians = np.full(len(windows), np.nan)
    is_known = np.isfinite(windows).any(1)
    medians[is_known] = np.nanmedian(windows[is_known], axis=1)
    return np.asarray(np.fmax(medians[:n], medians[NEIGHBOURS + 1 : NEIGHBOURS + 1 + n]))


def _restarts(poses: F64, breaks: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Steps (n - 1,) after which the pose is the identity, from farther away."""
    offsets = np.linalg.norm(poses[:, :3, 3], axis=1)
    at_identity = (offsets < AT_IDENTITY) & (_angles(poses[:, :3, :3]) < TURNED_AT_IDENTITY)
    return np.asarray(breaks & at_identity[1:] & (offsets[:-1] > FAR))


def _to_and_fro(poses: F64, way: F64, seconds: F64) -> NDArray[np.bool_]:
    """Poses (n - 2,), without the first and the last, that are reached and left again at once."""
    chord = np.linalg.norm(poses[2:, :3, 3] - poses[:-2, :3, 3], axis=1)
    detour = way[:-1] + way[1:] - chord
    return np.asarray(detour > SLACK + ACCELERATION * (seconds[:-1] + seconds[1:]) ** 2)


def _in_turn(stamps_ns: NDArray[np.int64], to_and_fro: NDArray[np.bool_], poses: F64) -> Jump:
    """Poses that jump to and fro. Between jumps of one of two publishers the other one drives on
    steadily; noise does not. A clock that was set back mixes the poses of a short stretch with
    later ones.
    """
    if unfilled := _at_one_pose(stamps_ns, to_and_fro, poses):
        return unfilled
    if set_back := _mixed_by_clock(stamps_ns, to_and_fro, poses):
        return set_back
    chords = np.linalg.norm(poses[2:, :3, 3] - poses[:-2, :3, 3], axis=1)[to_and_fro]
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)[:-1][to_and_fro]
    distance = float(np.median(steps))
    is_steady = float(np.median(np.abs(chords - np.median(chords)))) < STEADY * distance
    cause = (
        "two publishers are mixed in one topic; record them on topics of their own"
        if is_steady
        else "they are too noisy to build a map with, or several publishers are mixed in one topic;"
        " give others with --poses FILE, or use --odometry lidar"
    )
    text = (
        f"{int(to_and_fro.sum())} of its {len(stamps_ns)} poses jump to and fro, by"
        f" {distance:.1f} m in the median: {cause}"
    )
    return Jump(tuple(stamps_ns[1:-1][to_and_fro].tolist()), text)


def _at_one_pose(
    stamps_ns: NDArray[np.int64], to_and_fro: NDArray[np.bool_], poses: F64
) -> Jump | None:
    """Poses that jump to exactly one pose each time, such as the identity, which was never filled
    in.
    """
    rows = np.flatnonzero(to_and_fro) + 1
    values, counts = np.unique(poses[rows].reshape(len(rows), -1), axis=0, return_counts=True)
    most = int(np.argmax(counts))
    at_value = (poses.reshape(len(poses), -1) == values[most]).all(1)
    # a pose between two such ones jumps as well
    beside = np.r_[at_value[1:], False] | np.r_[False, at_value[:-1]]
    if counts[most] < max(3, EXACTLY * len(rows)) or not (at_value | beside)[rows].all():
        return None
    is_identity = np.array_equal(values[most].reshape(4, 4), np.eye(4))
    what = "the identity" if is_identity else "one pose"
    distance = float(np.median(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)[rows]))
    text = (
        f"{int(at_value.sum())} of its {len(stamps_ns)} poses are exactly {what}, {distance:.1f} m"
        " from the ones beside them in the median: their publisher sends it where it does not know"
        " the pose; leave these out, or use --odometry lidar"
    )
    return Jump(tuple(stamps_ns[at_value].tolist()), text)


def _mixed_by_clock(
    stamps_ns: NDArray[np.int64], to_and_fro: NDArray[np.bool_], poses: F64
) -> Jump | None:
    """A stretch in which two drives alternate, the second of which begins where the first ends."""
    rows = np.flatnonzero(to_and_fro) + 1
    first = int(rows[0])
    last = int(rows[-1])
    rest = np.r_[poses[:first, :3, 3], np.full((1, 3), np.nan), poses[last + 1 :, :3, 3]]
    steps = np.linalg.norm(np.diff(rest, axis=0), axis=1)
    if np.isfinite(steps).sum() < NEIGHBOURS:
        return None
    usual = float(np.nanmedian(steps))
    begins = poses[max(first - 1, 0) : first + 2, :3, 3]
    ends = poses[last - 1 : last + 2, :3, 3]
    apart = np.linalg.norm(begins[:, None] - ends[None], axis=-1)
    if apart.min() > USUAL * usual + SLACK or apart.max() < SLACK + apart.min():
        return None
    seconds = float(stamps_ns[last] - stamps_ns[first]) * 1e-9
    text = (
        f"from {time_range(int(stamps_ns[first]), int(stamps_ns[last]))} poses of two stretches of"
        f" the drive alternate, the second of which begins where the first ends: the clock was set"
        f" back by about {seconds:.1f} s; cut the log there in the order of its messages"
    )
    return Jump(tuple(stamps_ns[rows].tolist()), text)


def _frozen(stamps_ns: NDArray[np.int64], way: F64, turn: F64, seconds: F64) -> Jump | None:
    """Poses that stop at once and stay exactly the same for a while, as when odometry hangs."""
    is_still = (way == 0.0) & (turn < STILL_TURN)
    edges = np.flatnonzero(np.diff(np.r_[False, is_still, False].astype(np.int8)))
    for first, last in edges.reshape(-1, 2).tolist():  # steps [first, last) stand still
        if (stamps_ns[last] - stamps_ns[first]) * 1e-9 < FROZEN:
            continue
        for steps in (slice(max(first - AT_SPEED, 0), first), slice(last, last + AT_SPEED)):
            if len(way[steps]) < AT_SPEED:
                continue
            speed = float(np.median(way[steps] / seconds[steps]))
            if speed > ACCELERATION * 2.0 * float(np.median(seconds[steps])) + SLOW:
                text = (
                    f"the poses are exactly the same from"
                    f" {time_range(int(stamps_ns[first]), int(stamps_ns[last]))}, at once from or"
                    f" to a speed of {speed:.1f} m/s: the odometry froze; cut the log there, give"
                    " poses with --poses FILE, or use --odometry lidar"
                )
                return Jump((int(stamps_ns[first]),), text)
    return None


def _lost_in_gap(track: PoseTrack, way: F64, turn: F64, seconds: F64) -> Jump | None:
    """Poses that go on after a gap where they were before it, though at speed on both sides."""
    limit = track.gap_limit_ns() * 1e-9
    for step in np.flatnonzero((seconds > limit) & (seconds < LONGEST_STOP)).tolist():
        before = slice(max(step - AT_SPEED, 0), step)
        after = slice(step + 1, step + 1 + AT_SPEED)
        if len(way[before]) < AT_SPEED or len(way[after]) < AT_SPEED:
            continue
        speed = min(float(np.median(way[side] / seconds[side])) for side in (before, after))
        if speed > FASTER and way[step] < SHORT * speed * seconds[step] and turn[step] < TURN_SLACK:
            stamps_ns = track.stamps_ns
            usual = max(float(np.median(way[side])) for side in (before, after))
            # odometry that is lost for a while hardly goes on by just one of its steps
            is_clock = 0.0 < way[step] <= USUAL * usual and way[step] * USUAL >= usual
            cause = (
                "their clock was set forward, or the odometry lost the way between"
                if is_clock
                else "the odometry lost the way between"
            )
            text = (
                f"the poses have a gap of {seconds[step]:.2f} s from {utc(int(stamps_ns[step]))}"
                f" and go on {way[step]:.1f} m from where they were, although at {speed:.1f} m/s"
                f" before and after: {cause}; cut the log there into two sessions"
            )
            return Jump((int(stamps_ns[step + 1]),), text)
    return None


def _held(
    stamps_ns: NDArray[np.int64], jumps: NDArray[np.bool_], way: F64, turn: F64
) -> Jump | None:
    """Poses that are repeated exactly until the next one is known, which is far away by then."""
    is_same = (way == 0.0) & (turn < STILL_TURN)
    changes = np.flatnonzero(~is_same)
    if float(is_same.mean()) < HELD or float(jumps[changes].mean()) < HELD:
        return None
    period = float(np.median(np.diff(stamps_ns[1:][changes]))) * 1e-9
    text = (
        f"the poses change only every {period:.2f} s, by {np.median(way[changes]):.1f} m, and are"
        " exactly the same in between: their publisher repeats the last known one; record poses"
        " when they are computed, or give others with --poses FILE"
    )
    return Jump(tuple(stamps_ns[1:][jumps].tolist()), text)


def _jumped(track: PoseTrack, jumps: NDArray[np.bool_], way: F64, turn: F64) -> Jump:
    stamps_ns = track.stamps_ns
    rows = np.flatnonzero(jumps)
    worst = int(rows[np.argmax(way[rows])])
    if set_back := track.set_back.get(int(stamps_ns[worst])):
        text = (
            f"the poses jump by {way[worst]:.1f} m at {utc(int(stamps_ns[worst + 1]))}, after"
            f" {set_back.count} of them whose stamps go back in time by"
            f" {set_back.longest_ns * 1e-9:.2f} s: the clock of their stamps was set back; cut the"
            " log there"
        )
        return Jump(tuple(stamps_ns[1:][jumps].tolist()), text)
    seconds = (stamps_ns[worst + 1] - stamps_ns[worst]) * 1e-9
    count = "once" if len(rows) == 1 else f"{len(rows)} times"
    degrees = np.degrees(turn[worst])
    when = utc(int(stamps_ns[worst + 1]))
    text = (
        f"the poses jump {count}, by {way[worst]:.1f} m and {degrees:.0f} degrees in"
        f" {seconds:.2f} s at {when}: no vehicle can move like this; cut the log there, or give"
        " poses with --poses FILE"
    )
    return Jump(tuple(stamps_ns[1:][jumps].tolist()), text)

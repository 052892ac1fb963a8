"""What a whole pass over a session says in sentences: what was lost, and what was assumed."""

from __future__ import annotations

from dataclasses import dataclass

from semloc_logs.logs.session.one_pass import CloudPass
from semloc_logs.logs.session.tally import never_moves, no_poses, refused, smeared


@dataclass(frozen=True, slots=True)
class Conclusion:
    """Sentences about data that was ``lost``, and ``notes`` on what was assumed."""

    lost: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def conclude(done: CloudPass, session: str, pose_topic: str | None) -> Conclusion:
    """The sentences on a pass that is over; ``session`` and ``pose_topic`` are what they call it
    and its poses.
    """
    where = done.where
    made = done.made
    track = where.track
    source = where.source
    lost = done.tally.sentences((track.start_ns, track.end_ns))
    notes = done.tally.remarks()
    if made.copies is not None:
        notes += made.copies.sentences()
    if track.invalid:
        lost.append(f"{track.invalid} poses are no rigid transforms and were left out.")
    if source is not None:
        lost += source.problems
        notes += source.notes
    name = source.name if source else pose_topic or "TF"
    # every publisher of TF may repeat what others said: nothing is lost by that
    (notes if name == "TF" and not track.backwards + track.ahead else lost).extend(
        refused(name, track)
    )
    if made.standstill.shift and not track.moves:
        lost.append(smeared(name, made.standstill.shift))
    else:
        notes += never_moves(name, track)
    if where.base is not None and where.base.pose_frame is None:
        notes.append(no_poses(session))
    return Conclusion(tuple(lost), tuple(notes))

"""Problems that are known once a whole pass over a session is over."""

from __future__ import annotations

import numpy as np

from semloc_logs.logs.poses.standstill import STILL
from semloc_logs.logs.problems import Problem
from semloc_logs.logs.roles import Roles
from semloc_logs.logs.session.one_pass import CloudPass
from semloc_logs.logs.session.pose_problems import (
    clouds_in_fixed_frame,
    froze,
    invalid_poses,
    looks_up,
    never_moves,
    no_poses,
    optical_base,
    refused_poses,
    smeared,
    too_far,
)
from semloc_logs.logs.session.stamp_offsets import stamp_problems


def conclude(done: CloudPass, roles: Roles) -> list[Problem]:
    """The problems of a pass that is over."""
    poses = done.poses
    track = poses.track
    builder = done.builder
    name = poses.source.name if poses.source else roles.pose or "TF"

    done.tally.explain(track)
    problems = stamp_problems(done.stamp_offsets, roles, poses, done.relay.topics)
    problems += done.tally.problems(track, poses.base.name if poses.base else "")
    problems += [
        clouds_in_fixed_frame(topic, frame, name) for topic, frame in sorted(builder.fixed.items())
    ]
    if builder.duplicates is not None:
        problems += builder.duplicates.problems()
    problems += [too_far(*item) for item in sorted(builder.too_far.items())]
    problems += [looks_up(*item) for item in sorted(builder.looks_up.items())]
    problems += [optical_base(*item) for item in sorted(builder.is_base.items())]
    problems += poses.problems
    problems += invalid_poses(name, track)
    if poses.source is not None:
        problems += poses.source.problems
    # every publisher of TF may repeat the transforms of others: nothing is lost by that
    is_lost = name != "TF" or track.backwards + track.ahead > 0
    problems += refused_poses(name, track, lost=is_lost)

    frozen = builder.standstill.worst
    if frozen is not None and np.sort(track.extents())[1] < STILL:
        problems.append(smeared(name, frozen.shift, track))
    elif frozen is not None:
        problems.append(froze(name, frozen.shift, frozen.start_ns, frozen.end_ns))
    else:
        problems += never_moves(name, track)
    if poses.base is not None and poses.base.pose_frame is None:
        problems.append(no_poses())
    return problems

"""Which frame of a log is the vehicle: the base frame, and how it hangs on the pose stream and the sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semloc_logs.frames import F64
from semloc_logs.logs.transforms import TransformTree, frame_name

BASE_LINK = "base_link"


@dataclass(frozen=True)
class BaseFrame:
    """``name`` of the base frame; ``pose_frame`` whose pose the stream gives (None without poses).

    ``assumed`` is the one sensor frame that nothing connects with the base and that is therefore taken to be the base itself.
    ``notes`` say in sentences what was assumed.
    """

    name: str
    pose_frame: str | None
    assumed: str | None = None
    notes: tuple[str, ...] = ()

    def base_T(self, tree: TransformTree, frame_id: str, stamp_ns: int) -> F64 | None:
        """``base_T_frame`` (4, 4) at a time; None when nothing says where that frame is."""
        found = tree.lookup(self.name, frame_id, stamp_ns)
        if found is None and self.assumed is not None and frame_name(frame_id) == self.assumed:
            return np.eye(4)
        return found


def choose_base_frame(tree: TransformTree, sensors: Sequence[str], pose_child: str | None, pose_topic: str | None) -> BaseFrame:
    """The base frame as documented: ``base_link`` where TF connects it with a sensor and the pose; else the frame that the pose is of;
    the sensor's own frame where the pose does not say (``pose_child`` ""), or there is none (None).

    ``sensors``: frame ids of the range sensors, the most important first.
    """
    sensors = [frame_name(s) for s in sensors]
    reachable = any(tree.connected(BASE_LINK, s) for s in sensors) or (not sensors and BASE_LINK in tree.frames)
    first = sensors[0] if sensors else (BASE_LINK if reachable else "")
    if pose_child is None:
        return BaseFrame(BASE_LINK if reachable else first, None)
    child = frame_name(pose_child)
    if not child:
        notes = []
        if reachable and first != BASE_LINK:
            notes.append(
                f"{pose_topic} does not name the frame that it is the pose of: it is taken as that of the sensor frame '{first}'; "
                f"record nav_msgs/Odometry with child_frame_id if it is another."
            )
        return BaseFrame(first, first, notes=tuple(notes))
    name = BASE_LINK if reachable and tree.connected(BASE_LINK, child) else child
    if not sensors or any(tree.connected(name, s) for s in sensors):
        return BaseFrame(name, child)
    note = (
        f"No transform connects the sensor frame '{first}' with '{child}', the frame of {pose_topic}: they are taken as one; "
        f"record /tf_static if the sensor sits elsewhere."
    )
    return BaseFrame(child, child, assumed=first, notes=(note,))

"""How the logs of a session are read, by its settings."""

from __future__ import annotations

from collections.abc import Sequence

from semloc_logs.errors import LogError
from semloc_logs.logs.log import Clock, Reading, Stream
from semloc_logs.logs.roles import Roles
from semloc_logs.settings import Logs


def reading_of(settings: Logs, roles: Roles, streams: Sequence[Stream], name: str) -> Reading:
    """The clock and the offset of each topic, and the streams that no role uses.

    LogError for the offset of a topic that the session ``name`` does not have.
    """
    topics = sorted({s.topic for s in streams})
    spelled = {topic.strip("/"): topic for topic in topics}
    offset_ns = {}
    for wanted, seconds in settings.time_offset.items():
        topic = wanted if wanted in topics else spelled.get(wanted.strip("/"))
        if topic is None:
            raise LogError(
                f"{name}: logs.time_offset names {wanted}, which the log does not have; its topics "
                f"are {', '.join(topics)}."
            )
        offset_ns[topic] = round(seconds * 1e9)
    return Reading(Clock(settings.stamps), offset_ns, roles.left_out)

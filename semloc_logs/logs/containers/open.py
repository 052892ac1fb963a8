"""Opens the log at a path, by its content rather than its suffix."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from semloc_logs.errors import LogError
from semloc_logs.logs.containers import rosbag1
from semloc_logs.logs.containers.mcap import McapLog
from semloc_logs.logs.containers.mcap_records import MAGIC
from semloc_logs.logs.containers.memory import DEFAULT, Memory
from semloc_logs.logs.containers.rosbag1 import Rosbag1Log
from semloc_logs.logs.containers.rosbag2 import Rosbag2Log
from semloc_logs.logs.containers.sqlite import SqliteLog
from semloc_logs.logs.log import Log
from semloc_logs.logs.remote import log_path

if TYPE_CHECKING:
    from semloc_logs.logs.containers.map_stations import Stations

_SQLITE = b"SQLite format 3\0"


def open_log(
    path: str | Path, memory: int = DEFAULT, along: Callable[[], Stations] | None = None
) -> Log:
    """The log at ``path``, which may be an address: an MCAP file, a ROS 1 bag, a ROS 2 bag
    directory or one of its files; or a map of points, seen ``along`` a trajectory.

    At most ``memory`` bytes of it are in memory at once (``logs.memory``). LogError describes the
    file where it is not a log, or its damage.
    """
    path = log_path(path)
    limit = Memory(memory)
    head = b""
    try:
        is_folder = path.is_dir()
        if not is_folder:
            with path.open("rb") as file:
                head = file.read(512)
    except FileNotFoundError as error:
        raise LogError(f"{path} does not exist.") from error
    except (OSError, ValueError) as error:
        raise LogError(
            f"{path} cannot be opened: {getattr(error, 'strerror', None) or error}."
        ) from error
    if is_folder:
        return Rosbag2Log(path, limit)
    if path.name == "metadata.yaml":
        return Rosbag2Log(path.parent, limit)
    if head.startswith(MAGIC):
        return McapLog(path, limit)
    if head.startswith(b"#ROSBAG V"):
        return Rosbag1Log(path, limit)
    if head.startswith(_SQLITE):
        return SqliteLog(path, limit)
    # compiled code, which other logs need not wait for
    from semloc_logs.logs.containers.point_files import is_point_file
    from semloc_logs.logs.containers.point_map import PointMapLog

    if is_point_file(head):
        return PointMapLog(path, limit, along)
    raise LogError(f"{path} {_description(head)}")


def _description(head: bytes) -> str:
    if not head:
        return "is empty; record or copy it again."
    if head.startswith(b"version https://git-lfs"):
        return "is a Git LFS pointer, not the log itself; fetch it with 'git lfs pull'."
    if head.startswith(b"\x28\xb5\x2f\xfd"):
        return (
            "is zstd-compressed; decompress it with 'unzstd', or give the folder of its ROS 2 bag."
        )
    if head.startswith((b"\x1f\x8b", b"PK\x03\x04", b"BZh", b"\xfd7zXZ")):
        return "is an archive; unpack it first."
    if MAGIC.startswith(head) or rosbag1.MAGIC.startswith(head):
        return "is cut off within its first bytes; record or copy it again."
    return (
        "is not a log: it starts neither like an MCAP file nor like a ROS 1 bag nor like a ROS 2 "
        "sqlite3 bag, nor like a map of points (PCD, PLY, LAS)."
    )

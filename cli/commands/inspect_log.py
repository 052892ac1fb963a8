"""semloc inspect."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..console import console
from ..options import (
    Command,
    console_options,
    given_settings_options,
    json_option,
    logs_argument,
    stamps_option,
    topic_option,
)

if TYPE_CHECKING:
    from semloc_logs.settings import Settings


@click.command("inspect", cls=Command)
@logs_argument
@topic_option
@stamps_option
@click.option(
    "--full",
    is_flag=True,
    help="Read all messages. Without it a log of more than 64 MB is read by its index, with a"
    " sample of its poses.",
)
@click.option(
    "--check",
    is_flag=True,
    help="Read the keyframes and check whether the poses fit them: clock offsets, mountings, scale,"
    " jumps. Takes about as long as half of 'semloc fuse'.",
)
@json_option
@given_settings_options
@console_options
def command(
    logs: tuple[Path, ...],
    topics: dict[str, str],
    full: bool,
    check: bool,
    as_json: bool,
    settings: Settings,
) -> int:
    """What a log holds, whether it can be used, and with which command.

    Streams with their roles and rates, sensors, poses, frames, problems and their remedies, and a
    verdict. LOG is an .mcap, .bag or .db3 file, a ROS 2 bag folder or its metadata.yaml, or a map
    of points (.pcd, .ply, .las, .laz). --json prints an array with one object for each LOG.
    Settings of reading, such as logs.time_offset, hold as for 'semloc fuse'. Exit code 3: a part of
    a log cannot be read, or an assumption was needed.

    \b
    Example:  semloc inspect drive.mcap
              semloc inspect drive.mcap --json | jq '.[].problems'
              semloc inspect drive.mcap --check --set logs.time_offset./lidar/points=0.4
    """
    from semloc_logs.errors import LogError, SemlocError
    from semloc_logs.logs.annotation.annotate import recover
    from semloc_logs.logs.inspection.inspect import inspect_log, refused_log

    inspected: list[dict[str, Any]] = []
    contents: list[dict[str, Any]] = []
    failed: list[SemlocError] = []
    for log in logs:
        try:
            if recover(log):
                console.note(f"{log}: an interrupted 'semloc annotate --in-place' was repaired")
            content: dict[str, Any] = inspect_log(log, topics, full=full, logs=settings.logs)
            inspected.append(_checked(log, content, settings, topics) if check else content)
            contents.append(inspected[-1])
        except SemlocError as problem:
            failed.append(problem)
            contents.append(refused_log(log, str(problem)))
    if as_json:
        console.result_json(contents)
    if failed and not inspected:
        kinds = {type(problem) for problem in failed}
        kind = kinds.pop() if len(kinds) == 1 else LogError
        raise kind(" ".join(str(p) for p in failed))
    if not as_json:
        from semloc_logs.logs.inspection.inspect_text import inspect_text

        console.result("\n\n".join(map(inspect_text, inspected)))
    for error in failed:
        console.warn(str(error))
    for content in inspected:
        for sentence in content["skipped"]:
            path = content["path"]
            named = sentence.startswith(Path(path).name)  # else it begins with the topic
            console.warn(sentence if named else f"{path}: {sentence}")
    return 3 if failed or any(content["skipped"] for content in inspected) else 0


def _checked(
    log: Path, content: dict[str, Any], settings: Settings, topics: dict[str, str]
) -> dict[str, Any]:
    """The content with the check of poses against range data, where the log can be mapped.

    It is made with the voxel size that suits the log, unless one is given.
    """
    from semloc_logs.stages.log_check import check_log, with_fit

    voxel_size = content["voxel_size"]
    if voxel_size is None or not content["poses"]["count"]:
        return content
    if "voxel_size" not in settings.fusion.model_fields_set:
        fusion = settings.fusion.model_copy(update={"voxel_size": voxel_size})
        settings = settings.model_copy(update={"fusion": fusion})
    return with_fit(content, check_log(log, settings, topics))

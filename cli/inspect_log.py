"""semloc inspect."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .console import console
from .options import Command, console_options, json_option, logs_argument, topic_option


@click.command("inspect", cls=Command)
@logs_argument
@topic_option
@json_option
@console_options
def command(logs: tuple[Path, ...], topics: dict[str, str], as_json: bool) -> int:
    """What is in a log: streams with their roles, calibration, pose coverage, time range, and what
    stands in the way of using it.

    LOG is an .mcap, .bag or .db3 file, a ROS 2 bag folder or its metadata.yaml. Exit code 3 says
    that some of the log cannot be read.

    \b
    Example:  semloc inspect drive.mcap --json | jq .problems
    """
    from semloc_logs.errors import LogError, SemlocError
    from semloc_logs.logs.annotation.annotate import recover
    from semloc_logs.logs.session.inspect import inspect_log

    found: list[dict[str, Any]] = []
    failed: list[SemlocError] = []
    for log in logs:
        try:
            if recover(log):
                console.note(f"{log}: an interrupted 'semloc annotate --in-place' was repaired")
            found.append(inspect_log(log, topics))
        except SemlocError as problem:
            failed.append(problem)
    if failed and not found:
        raise failed[0] if len(failed) == 1 else LogError(" ".join(str(p) for p in failed))
    if as_json:
        console.result_json(found if len(logs) > 1 else found[0])
    else:
        for content in found:
            _show(content)
    for refused in failed:
        console.warn(str(refused))
    for content in found:
        for sentence in content["skipped"]:
            path = content["path"]
            named = sentence.startswith(Path(path).name)  # else it begins with the topic
            console.warn(sentence if named else f"{path}: {sentence}")
    return 3 if failed or any(content["skipped"] for content in found) else 0


def _show(content: dict[str, Any]) -> None:
    console.result(
        f"{content['path']}: {content['format']}, {content['encoding'] or 'no messages'},"
        f" {content['duration_s']} s"
    )
    console.table(
        "",
        ("topic", "type", "role", "messages#"),
        [(s["topic"], s["type"], s["role"], s["count"]) for s in content["streams"]],
    )
    if content["base_frame"]:
        console.result(
            f"Base frame {content['base_frame']!r}, poses in {content['session_frame']!r}"
        )
    for name, value in content["poses"].items():
        if name == "count" or value not in (None, [], {}, 0):
            console.result(f"  poses, {name}: {value}")
    for topic, sensor in content["sensors"].items():
        facts = ", ".join(f"{k} {v}" for k, v in sensor.items() if k != "base_T_sensor")
        console.result(
            f"  {topic}:"
            f" {facts}{'' if sensor['base_T_sensor'] else ', no transform to the base frame'}"
        )
    for sentence in content["problems"]:
        console.result(f"- {sentence}")
    console.result("")

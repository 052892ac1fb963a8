"""semloc sessions."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from ..completion import actions, session_names
from ..console import console
from ..inputs import checked_name
from ..options import Command, console_options, json_option, work_option
from ..results import show_sessions

ACTIONS = {"show": 1, "rename": 2, "remove": 1}  # and the number of names


@click.command(cls=Command)
@click.argument(
    "action",
    metavar="[show|rename|remove]",
    required=False,
    shell_complete=actions(*ACTIONS),
)
@click.argument("names", metavar="[NAME [NEW_NAME]]", nargs=-1, shell_complete=session_names)
@work_option
@json_option
@console_options
def command(action: str | None, names: tuple[str, ...], work: Path, as_json: bool) -> int:
    """Sessions of a workspace, in the order of their recording: all of them, or one in full; give
    one another name, or remove it with its closures.

    \b
    Example:  semloc sessions rename drive monday -w work
    """
    if action is not None and action not in ACTIONS:
        raise click.UsageError(f"No such action '{action}': there are {', '.join(ACTIONS)}.")
    if action is not None and len(names) != ACTIONS[action]:
        usage = "NAME NEW_NAME" if action == "rename" else "NAME"
        raise click.UsageError(f"Give semloc sessions {action} {usage}.")
    from semloc_logs.stages.stored_sessions import list_sessions, remove_session, rename_session
    from semloc_logs.workspace import Workspace

    workspace = Workspace(work)
    with console.progress():
        if action == "rename":
            rename_session(workspace, names[0], checked_name(names[1]))
        elif action == "remove":
            remove_session(workspace, names[0])
    shown = names if action == "show" else names[1:] if action == "rename" else ()
    if action == "remove" and not workspace.sessions():
        console.result(f"{work} holds no sessions any more")
        return 0
    summaries = list_sessions(workspace, shown)
    if as_json:
        console.result_json([asdict(s) for s in summaries])
        return 0
    if action == "show":
        for name, value in asdict(summaries[0]).items():
            value = ", ".join(value) if isinstance(value, tuple) else value
            console.result(f"{name.replace('_', ' '):14} {value}")
        return 0
    show_sessions(summaries)
    return 0

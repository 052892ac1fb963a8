"""What the shell completes beside commands and options: sessions, keys of settings, roles.

``eval "$(_SEMLOC_COMPLETE=bash_source semloc)"`` switches it on.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click


def session_names(ctx: click.Context, _: click.Parameter, incomplete: str) -> list[str]:
    """Names of the sessions of the workspace that -w gives, else of ``work``."""
    from semloc_logs.workspace import Workspace

    workspace = Workspace(Path(ctx.params.get("work") or "work"))
    given = ctx.params.get("sessions") or ctx.params.get("names") or ()
    names = [folder.name for folder in workspace.sessions() if folder.name not in given]
    return [name for name in names if name.startswith(incomplete)]


def setting_keys(_: click.Context, __: click.Parameter, incomplete: str) -> list[str]:
    """Keys of --set with their ``=``; behind it the values of a setting that has a few."""
    from semloc_logs.settings import choices

    key, equals, value = incomplete.partition("=")
    known = choices()
    if equals:
        return [f"{key}={v}" for v in known.get(key, ()) if v.startswith(value)]
    return [f"{k}=" for k in known if k.startswith(key)]


def role_names(_: click.Context, __: click.Parameter, incomplete: str) -> list[str]:
    """Roles of --topic with their ``=``."""
    from semloc_logs.logs.role_types import ROLES

    return [f"{role}=" for role in ROLES if role.startswith(incomplete)]


def actions(*names: str) -> Any:
    """Of an argument with a few fixed words, which are not a click.Choice."""

    def complete(_: click.Context, __: click.Parameter, incomplete: str) -> list[str]:
        return [name for name in names if name.startswith(incomplete)]

    return complete

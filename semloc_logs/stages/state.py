"""The settings that a workspace keeps in workspace.json, from its first command on.

Its tables depend on them: later commands take them, and a value that contradicts is refused, unless
the tables are to be made again.
"""

from __future__ import annotations

from typing import Any

from semloc_logs.errors import SettingsError, WorkspaceError
from semloc_logs.settings import TABLE_SECTIONS, Resolved, Settings, validated
from semloc_logs.tables.metadata import origin
from semloc_logs.tables.table import read_json, write_json
from semloc_logs.workspace import Workspace

# decides about alignments that are there already, which takes seconds: each close may choose
OF_DECISION = frozenset({"closures.min_probability", "closures.misfits"})
OF_MAPS = ("fusion", "labels")  # sections that maps depend on


def settle(
    work: Workspace, given: Settings, *, writes: bool = False, overwrite: bool = False
) -> Settings:
    """The settings of a command in ``work``: those it keeps, and the ``given`` ones.

    ``writes``: the command makes tables, and may choose what the decision alone depends on. Raises
    SettingsError, with both values, where a given one contradicts, unless ``overwrite``.
    """
    kept = read_kept(work)
    if kept is None:
        return given
    tree = kept.model_dump(mode="json", exclude_unset=True)
    for key, value in given.given().items():
        section, name = key.split(".", 1)
        tree.setdefault(section, {})[name] = value
    settled = validated(tree)
    free = OF_DECISION if writes else frozenset()
    before = _by_key(kept.resolved())
    after = _by_key(settled.resolved())
    bound = _bound_sections(work)
    contradicting = [
        key
        for key in given.given()
        if key.split(".")[0] in bound
        and key in before
        and key not in free
        and before[key] != after[key]
    ]
    if contradicting and not overwrite:
        key = contradicting[0]
        remedy = (
            "or add --overwrite to make its tables again" if writes else "as its tables have it"
        )
        raise SettingsError(
            f"{work.path} was made with {key}={before[key]}, and {key}={after[key]} is given:"
            f" leave it out, {remedy}."
        )
    return settled


def read_kept(work: Workspace) -> Settings | None:
    """The settings that a workspace keeps; None before its first command."""
    if not work.settings.exists():
        return None
    try:
        return validated(read_json(work.settings)["given"])
    except (SettingsError, KeyError):
        raise WorkspaceError(
            f"{work.settings} is of another version of semloc: use that version, or delete the"
            " file and give the settings again."
        ) from None


def keep(work: Workspace, settings: Resolved, *, overwrite: bool = False) -> None:
    """Write workspace.json, where it does not hold the same already.

    ``given`` are the settings that differ from the defaults, for later commands; ``settings`` are
    all of them. The settings of maps stay as the first session has them, unless ``overwrite``.
    """
    content: dict[str, Any] = {
        **origin(),
        "given": settings.differences(),
        "settings": settings.tables(*TABLE_SECTIONS),
    }
    if not overwrite and work.settings.exists() and work.sessions():
        before = read_json(work.settings)
        for part in ("given", "settings"):
            for section in OF_MAPS:
                content[part].pop(section, None)
                if section in before[part]:
                    content[part][section] = before[part][section]
    if not work.settings.exists() or read_json(work.settings) != content:
        write_json(work.settings, content)


def _bound_sections(work: Workspace) -> set[str]:
    """The sections that tables of several sessions depend on already.

    Maps alone are not compared with each other: until words are made, each may have its own.
    """
    bound: set[str] = set()
    if any(folder.words_json.exists() for folder in work.sessions()):
        bound |= {*OF_MAPS, "descriptor"}
    if work.closures.exists() or work.aligned_pairs():
        bound |= {"query", "closures"}
    return bound


def _by_key(settings: Resolved) -> dict[str, Any]:
    return {
        f"{section}.{name}": value
        for section, values in settings.tables(*TABLE_SECTIONS).items()
        for name, value in values.items()
    }

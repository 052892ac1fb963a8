"""The errors of the package: each is one sentence with the fault, its place and the remedy.

The place is a file, a topic, an offset or a time.
Only :mod:`semloc_logs.cli` turns them into exit codes.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class SemlocError(Exception):
    """Root of all expected errors; ``str(error)`` is a complete sentence for the user."""


class LogError(SemlocError):
    """A log cannot be read or written: missing, truncated, corrupt, or not a log at all."""


class RemoteError(SemlocError):
    """A server gives no answer, or cannot do what reading or writing needs.

    What could not be read is not damage: nothing is skipped for it.
    """


class RoleError(SemlocError):
    """The streams of a log leave open which topic has which role.

    The sentence lists the options that settle it.
    """


class TopicError(RoleError):
    """``--topic`` names a topic that the log does not have or that cannot play the role (wrong
    usage).
    """


class SettingsError(SemlocError):
    """A setting is unknown or has an impossible value (wrong usage)."""


class WorkspaceError(SemlocError):
    """A workspace lacks input of a stage, or another version or other settings wrote it."""


class TemporaryError(WorkspaceError):
    """Not the fault of the input: another writer, a full disk, too little memory.

    The same command may succeed later.
    """


class ContractError(SemlocError):
    """A table or message does not have the columns that its contract in ``schemas/`` promises."""


class TruthError(SemlocError):
    """A truth file of ``semloc evaluate`` is missing or does not say what it should."""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """A sentence with the known word that is spelled most like ``word``; empty if none is."""
    similar = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f" Did you mean '{similar[0]}'?" if similar else ""

"""The errors of the package: each is one sentence with the fault, its place and the remedy.

The place is a file, a topic, an offset or a time.
Only :mod:`semloc_logs.cli` turns them into exit codes.
"""


class SemlocError(Exception):
    """Root of all expected errors; ``str(error)`` is a complete sentence for the user."""


class LogError(SemlocError):
    """A log cannot be read or written: missing, truncated, corrupt, or not a log at all."""


class RoleError(SemlocError):
    """The streams of a log leave open which topic has which role.

    The sentence lists the options that settle it.
    """


class SettingsError(SemlocError):
    """A setting is unknown or has an impossible value (wrong usage)."""


class WorkspaceError(SemlocError):
    """A workspace lacks input of a stage, or another version or other settings wrote it."""


class ContractError(SemlocError):
    """A table or message does not have the columns that its contract in ``schemas/`` promises."""


class TruthError(SemlocError):
    """A truth file of ``semloc evaluate`` is missing or does not say what it should."""

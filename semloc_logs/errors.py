"""Every error of the package: one sentence that says what, where (file, topic, offset or time) and
what to do.

Only :mod:`semloc_logs.cli` turns them into exit codes.
"""


class SemlocError(Exception):
    """Root of all expected errors; ``str(error)`` is a complete sentence for the user."""


class LogError(SemlocError):
    """A log cannot be read or written: missing, truncated, corrupt, or not a log at all."""


class RoleError(SemlocError):
    """The streams of a log do not say which topic plays which role; the sentence lists the flags
    that solve it.
    """


class SettingsError(SemlocError):
    """A setting is unknown or has an impossible value (wrong usage)."""


class WorkspaceError(SemlocError):
    """A workspace lacks what a stage needs, or holds what another version or other settings wrote."""


class ContractError(SemlocError):
    """A table or message does not have the columns that its contract in ``schemas/`` promises."""


class TruthError(SemlocError):
    """A truth file of ``semloc evaluate`` is missing or does not say what it should."""

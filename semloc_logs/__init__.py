"""semloc_logs: where has a drive been before? Semantic loop closures from recorded drive logs.

log -> frames -> labels -> voxels -> subvolumes -> words -> hypotheses -> closures -> log
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from semloc_logs.api import Closure, Closures, Session, Workspace, evaluate, open_log
    from semloc_logs.errors import SemlocError
    from semloc_logs.settings import Settings

__all__ = [
    "Closure",
    "Closures",
    "SemlocError",
    "Session",
    "Settings",
    "Workspace",
    "__version__",
    "evaluate",
    "open_log",
]

try:
    __version__ = version("semloc_logs")
except PackageNotFoundError:
    __version__ = "0+unknown"

if find_spec("semloc_logs.schemas") is None:
    raise ImportError(
        "semloc_logs was imported from a bare checkout: install it first"
        " (make install, or pip install -e .)"
    )


def __getattr__(name: str) -> Any:
    """The public names, loaded when they are first used: importing the package is cheap."""
    if name == "Settings":
        return import_module("semloc_logs.settings").Settings
    if name == "SemlocError":
        return import_module("semloc_logs.errors").SemlocError
    if name in __all__:
        return getattr(import_module("semloc_logs.api"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

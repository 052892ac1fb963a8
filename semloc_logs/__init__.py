"""semloc_logs: where has a drive been before? Semantic loop closures from recorded drive logs.

log -> frames -> labels -> voxels -> subvolumes -> words -> hypotheses -> closures -> log
"""

from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

try:
    __version__ = version("semloc_logs")
except PackageNotFoundError:
    __version__ = "0+unknown"

if find_spec("semloc_logs.schemas") is None:
    raise ImportError(
        "semloc_logs was imported from a bare checkout: install it first (make install, or pip install -e .)"
    )

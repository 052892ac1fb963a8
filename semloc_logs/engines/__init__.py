"""Where tasks run: in this process or in several. A stage is given its engine."""

from semloc_logs.engines.base import Engine, Serial
from semloc_logs.engines.choice import ENGINES, make_engine

__all__ = ["ENGINES", "Engine", "Serial", "make_engine"]

"""Where tasks run: in this process or in several. A stage is given its engine."""

from semloc_logs.engines.choice import ENGINES, make_engine
from semloc_logs.engines.engine import Engine, Serial

__all__ = ["ENGINES", "Engine", "Serial", "make_engine"]

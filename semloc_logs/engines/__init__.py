"""Where tasks run: in this process or in several; a stage receives an engine and never makes one."""

from semloc_logs.engines.base import Engine, Serial
from semloc_logs.engines.choice import ENGINES, make_engine

__all__ = ["ENGINES", "Engine", "Serial", "make_engine"]

"""For all tests: the installed package instead of the checkout, and the real logs in a folder
beside the checkout.
"""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import settings

ROOT = Path(__file__).resolve().parents[1]
# small arrays: a second thread costs more than it brings, and much more on a busy machine
os.environ.setdefault("OMP_NUM_THREADS", "1")
# the first call of a compiled function compiles it, and other jobs may keep the machine busy
settings.register_profile("semloc", deadline=None)
settings.load_profile("semloc")
# `python -m pytest` in the repository root would find the checkout's semloc_logs, which has no cli
# and no schemas inside
sys.path[:] = [p for p in sys.path if p and Path(p).resolve() != ROOT]


@pytest.fixture(scope="session")
def repository() -> Path:
    """The repository's root."""
    return ROOT


@pytest.fixture(scope="session")
def shared() -> Callable[[str], Path]:
    """``shared(name)`` is a real log, trajectory or folder of them beside the repository; the test
    is skipped where it is missing.
    """

    def find(name: str) -> Path:
        path = ROOT.parent / "shared" / name
        if not path.exists():
            pytest.skip(f"shared/{name} beside the repository is missing")
        return path

    return find


# modules such as tests/lossy_disk.py are imported as tests.lossy_disk; the tests have no package
tests = ModuleType("tests")
tests.__path__ = [str(ROOT / "tests")]
sys.modules.setdefault("tests", tests)

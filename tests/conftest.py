"""For all tests: the installed package instead of the checkout, and the real logs in a folder
beside the checkout.
"""

import importlib.util
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]
# small arrays: a second thread costs more than it brings, and much more on a busy machine
os.environ.setdefault("OMP_NUM_THREADS", "1")
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


def _load_helper(name: str) -> None:
    """Make ``tests/NAME.py`` importable as ``tests.NAME``; the tests have no package."""
    spec = importlib.util.spec_from_file_location(f"tests.{name}", ROOT / "tests" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules.setdefault("tests", ModuleType("tests"))
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)


_load_helper("lossy_disk")
_load_helper("servers")

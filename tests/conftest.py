"""For all tests: the installed package instead of the checkout, and the folder of real logs beside
the checkout.
"""

import os
import sys
from pathlib import Path

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
def shared() -> Path:
    """The folder of real logs, trajectories and odd files; the test is skipped where there is none."""
    folder = ROOT.parent / "shared"
    if not folder.is_dir():
        pytest.skip("there is no folder shared/ with real logs beside the repository")
    return folder

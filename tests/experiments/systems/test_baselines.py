from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from semloc_logs.experiments.systems.catalogue import (
    BASELINES,
    Entry,
    NotInstalledError,
    make_system,
)


@pytest.mark.parametrize("entry", BASELINES, ids=lambda entry: entry.name)
def test_every_entry_makes_the_system_of_its_name(
    entry: Entry, options: Any, tmp_path: Path
) -> None:
    folder = tmp_path / entry.name
    folder.mkdir()
    try:
        system = make_system(entry, replace(options, folder=folder))
    except NotInstalledError as problem:
        assert entry.extra
        pytest.skip(str(problem))
    assert system.name == entry.name

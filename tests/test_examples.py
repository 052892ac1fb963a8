"""The notebook in ``examples/`` is stored without outputs and runs from top to bottom."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import pytest

NOTEBOOK = Path(__file__).resolve().parents[1] / "examples/closures.ipynb"


def _cells() -> list[dict[str, Any]]:
    content = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert content["nbformat"] == 4
    return [cell for cell in content["cells"] if cell["cell_type"] == "code"]


def test_no_outputs_are_stored() -> None:
    cells = _cells()
    assert len(cells) > 5
    assert not [cell for cell in cells if cell["outputs"] or cell["execution_count"] is not None]


@pytest.fixture
def names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    """The names that the notebook leaves behind after all of its cells have run."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    backend = matplotlib.get_backend()
    plt.switch_backend("agg")
    scope: dict[str, Any] = {"__name__": "__main__"}
    for cell in _cells():
        exec(compile("".join(cell["source"]), cell["id"], "exec"), scope)
    yield scope
    plt.close("all")
    plt.switch_backend(backend)
    shutil.rmtree(scope["folder"])


def test_the_notebook_finds_the_drives_in_each_other(names: dict[str, Any]) -> None:
    closures = names["closures"]
    # the later session is localised in the earlier one
    assert {closure.query_session for closure in closures} == {"session_1"}
    assert names["table"].height == len(closures) >= 4

    evaluation = names["evaluation"]
    assert (evaluation.correct, evaluation.false) == (len(closures), 0)

    lines = [line for line in names["axes"].get_lines() if line.get_color() == "red"]
    in_first = [closure for closure in closures if closure.target_session == "session_0"]
    assert len(lines) == len(in_first) > 0

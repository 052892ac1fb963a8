"""Names of sessions become names of folders."""

from pathlib import Path

import pytest

from semloc_logs.errors import WorkspaceError
from semloc_logs.workspace import Workspace

BAD = [
    "",
    ".",
    "..",
    ".hidden",
    "a/b",
    "../a",
    "/etc",
    "a\\b",
    "a\0b",
    "a\nb",
    "\x1b[2J",
    "a\udcff",
]
GOOD = ["monday", "a b", "-x", "2026-01-01T00:00:00", "a..b", "東京 1", "ö", "x" * 200, "a."]


@pytest.mark.parametrize("name", BAD)
def test_a_name_that_leads_elsewhere_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(WorkspaceError, match="A session cannot be called"):
        Workspace(tmp_path).session(name)


@pytest.mark.parametrize("name", GOOD)
def test_other_names_are_folders_of_the_workspace(tmp_path: Path, name: str) -> None:
    folder = Workspace(tmp_path).session(name)
    assert folder.name == name
    assert folder.path.parent == tmp_path / "sessions"

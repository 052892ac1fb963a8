"""Versions of what a benchmark keeps."""

from pathlib import Path

import pytest

import semloc_logs
from semloc_logs.benchmarks.localisation.localisation import LOCALISATION
from semloc_logs.benchmarks.versions import code_version, files_version, room_files

PACKAGE = Path(semloc_logs.__file__).parent


@pytest.mark.parametrize("room", [*LOCALISATION, "simulation"])
def test_a_version_is_of_every_module_of_a_room_at_any_depth(room: str) -> None:
    files = set(room_files([room]))
    assert files >= set((PACKAGE / room).rglob("*.py")) > set()


def test_another_content_or_order_is_another_version(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("one")
    (tmp_path / "b").write_text("two")
    paths = [tmp_path / "a", tmp_path / "b"]
    version = files_version(paths)
    assert files_version(paths) == version
    assert files_version(paths[::-1]) != version
    (tmp_path / "b").write_text("three")
    assert files_version(paths) != version
    assert code_version(["words", "voxels"]) != code_version(["voxels"])

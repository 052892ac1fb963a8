"""Names of sessions, and fingerprints of what they depend on."""

from __future__ import annotations

from pathlib import Path

import pytest

import semloc_logs
from semloc_logs.stages.inputs import fingerprint_of, recorded_fingerprint, session_name
from semloc_logs.tables.table import write_json


def test_a_session_is_called_after_its_file_or_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "2026.05"
    folder.mkdir()
    (folder / "metadata.yaml").touch()
    assert session_name(tmp_path / "monday.v2.bag") == "monday.v2"
    assert session_name(folder) == "2026.05"
    assert session_name(folder / "metadata.yaml") == "2026.05"
    monkeypatch.chdir(folder)
    assert session_name(Path()) == "2026.05"
    assert session_name(Path("metadata.yaml")) == "2026.05"


def test_a_fingerprint_is_of_the_version_and_of_each_part(monkeypatch: pytest.MonkeyPatch) -> None:
    prints = [fingerprint_of(parts) for parts in (("ab", "c"), ("a", "bc"), ("abc",), ())]
    monkeypatch.setattr(semloc_logs, "__version__", "0.0.0")
    prints.append(fingerprint_of(("ab", "c")))
    assert len(set(prints)) == 5
    assert {len(one) for one in prints} == {16}


def test_what_is_not_done_has_no_fingerprint(tmp_path: Path) -> None:
    path = tmp_path / "words.json"
    assert recorded_fingerprint(path) is None
    path.write_text('{"fingerp')
    assert recorded_fingerprint(path) is None
    write_json(path, {"words": 3})
    assert recorded_fingerprint(path) is None
    write_json(path, {"fingerprint": "0123"})
    assert recorded_fingerprint(path) == "0123"

"""The page as text: one file, nothing loaded, names from logs never markup."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from semloc_logs.errors import WorkspaceError
from semloc_logs.report_page.closure_pictures import chosen
from semloc_logs.report_page.content import _template
from semloc_logs.report_page.packed import packed, unpacked
from semloc_logs.report_page.page import page, script_json
from semloc_logs.settings import Settings
from semloc_logs.simulation.output.workspace_tables import TablesPlan, write_tables
from semloc_logs.stages.report_page import write_report
from semloc_logs.workspace import Workspace


class Elements(HTMLParser):
    """Tags with their attributes, and the content of scripts and styles."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.contents: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.tags and self.tags[-1][0] in ("script", "style"):
            self.contents.append(data)

    def attributes(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


def test_nothing_is_loaded_and_no_handler_is_inline(report: Path) -> None:
    elements = Elements(report.read_text(encoding="utf-8"))
    for tag, attributes in elements.tags:
        assert "src" not in attributes, tag
        assert str(attributes.get("href", "#")).startswith("#"), tag
        assert not [name for name in attributes if name.startswith("on")], tag
        assert tag not in ("link", "iframe", "object", "embed", "base", "img")


def test_the_policy_allows_the_own_script_and_style_only(report: Path) -> None:
    text = report.read_text(encoding="utf-8")
    elements = Elements(text)
    policy = next(
        str(m["content"])
        for m in elements.attributes("meta")
        if m.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy
    assert "connect-src" not in policy
    for tag in ("script", "style"):
        content = re.search(f"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
        assert content
        digest = base64.b64encode(hashlib.sha256(content[1].encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in policy


def test_names_from_logs_are_not_markup(report: Path) -> None:
    text = report.read_text(encoding="utf-8")
    assert "<img" not in text
    assert "alert(2)</script>" not in text
    scripts = Elements(text).attributes("script")
    executed = [s for s in scripts if "type" not in s]
    assert len(executed) == 1
    assert "streets &amp; &lt;b&gt;lanes&lt;b&gt;" in text


def test_the_data_hold_all_tables(report: Path, tables: Workspace) -> None:
    text = report.read_text(encoding="utf-8")
    data_element = re.search(r'id="data">(.*?)</script>', text, re.DOTALL)
    assert data_element
    data = json.loads(data_element[1])
    assert sorted(s["name"] for s in data["sessions"]) == sorted(f.name for f in tables.sessions())
    assert data["closures"]["count"] == 30
    assert len(unpacked(data["closures"]["xy"])) == 4 * 30
    assert np.isfinite(unpacked(data["closures"]["evidence"])).all()
    assert len(data["groups"]) == 2
    # the first drives of both roads have no earlier drive to be found in
    queries = {int(s) for s in unpacked(data["rejected"]["sessions"])[::2]}
    assert queries == {1, 2, 3}


def test_two_reports_are_identical(report: Path, tables: Workspace, tmp_path: Path) -> None:
    again = write_report(tables, Settings().resolved(), tmp_path / "again.html")
    assert again.read_bytes() == report.read_bytes()


def test_slim_has_no_pictures(report: Path, tables: Workspace, tmp_path: Path) -> None:
    slim = write_report(tables, Settings().resolved(), tmp_path / "slim.html", slim=True)
    assert 'id="sheet-0"' in report.read_text(encoding="utf-8")
    assert "text/plain" not in slim.read_text(encoding="utf-8")


def test_without_closing_there_is_a_sentence(tmp_path: Path) -> None:
    work = Workspace(tmp_path / "work")
    write_tables(work, TablesPlan(sessions=1, closures=0, road=30))
    work.closures.unlink()
    sentence = rf"closures\.parquet does not exist: run 'semloc close -w {work.path}' first\."
    with pytest.raises(WorkspaceError, match=sentence):
        write_report(work, Settings().resolved())


def test_json_cannot_end_its_element() -> None:
    values = {"topic": "</script><script>\u2028&", "name": "Straße"}
    text = script_json(values)
    assert not set("<>&\u2028") & set(text)
    assert "Straße" in text
    assert json.loads(text) == values


def test_a_slot_in_a_name_stays_a_name() -> None:
    content = {"sessions": [{"name": "{{script}}"}], "workspace": "{{data}}"}
    text = page(content, {})
    assert "Sessions: {{script}}." in text
    assert "<title>Loop closures of {{data}}</title>" in text


def test_arrays_come_back() -> None:
    values = np.array([[1.5, -2.25], [np.inf, 0.0]])
    np.testing.assert_array_equal(unpacked(packed(values)), values.ravel())
    assert unpacked(packed([1, 70_000], "i4")).tolist() == [1, 70_000]
    assert unpacked(packed([], "u2")).tolist() == []


def test_reasons_are_few_sentences_with_many_figures() -> None:
    a = _template("probability 0.123 below 0.99: only 12 % of the points lie on a surface")
    b = _template("probability 0.456 below 0.99: only 9 % of the points lie on a surface")
    assert a[0] == b[0] == "probability {3} below {2}: only {0} % of the points lie on a surface"
    assert a[1] == [0.123, 0.99, 12.0]


def test_pictures_are_of_the_least_probable_closures_of_each_pair() -> None:
    pairs = ["ab", "ab", "ab", "ac", "bc"]
    probabilities = [0.999, 0.99, 0.995, 0.9999, 0.991]
    rows = [
        {"query_session": pair[0], "target_session": pair[1], "probability": probability}
        for pair, probability in zip(pairs, probabilities, strict=True)
    ]
    assert chosen(rows, 3) == [1, 3, 4]
    assert chosen(rows, 4) == [1, 2, 3, 4]
    assert chosen(rows, 9) == [0, 1, 2, 3, 4]

"""Which logs a command gets: names, patterns, standard input, manifests."""

from __future__ import annotations

import io
from pathlib import Path

import click
import pytest

from semloc_logs.cli.inputs import LogChoice, session_inputs


def sessions(*logs: object, manifest: Path | None = None) -> dict[str, list[str]]:
    choice = LogChoice(tuple(map(str, logs)), manifest)
    return {s.name: [str(log) for log in s.logs] for s in session_inputs(choice.each())}


def test_a_log_is_called_after_its_file_or_as_it_is_named(tmp_path: Path) -> None:
    assert sessions("x/a.mcap", "second=y/a.mcap") == {"a": ["x/a.mcap"], "second": ["y/a.mcap"]}
    odd = tmp_path / "k=v.mcap"
    odd.touch()
    assert sessions(odd) == {"k=v": [str(odd)]}, "the text is a path because the file exists"
    assert sessions("dir/k=v.mcap") == {"k=v": ["dir/k=v.mcap"]}, "nor is a folder"


@pytest.mark.parametrize("name", ["", ".hidden"])
def test_a_name_is_that_of_a_folder(name: str) -> None:
    with pytest.raises(click.UsageError, match="cannot be called"):
        sessions(f"{name or '.'}=a.mcap")


def test_two_logs_of_one_name_are_told_how_to_be_named() -> None:
    with pytest.raises(click.UsageError, match=r"would both be session 'a': .*a_2=y/a\.mcap"):
        sessions("x/a.mcap", "y/a.mcap")


def test_a_pattern_stands_for_the_files_it_matches(tmp_path: Path) -> None:
    for name in "bca":
        (tmp_path / f"{name}.mcap").touch()
    assert list(sessions(tmp_path / "*.mcap")) == ["a", "b", "c"]
    with pytest.raises(click.UsageError, match="matches no file"):
        sessions(tmp_path / "*.bag")
    with pytest.raises(click.UsageError, match="names 3 logs"):
        sessions(f"name={tmp_path}/*.mcap")


def test_lines_of_standard_input(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("x/a.mcap\n\nsecond=y/a.mcap\n"))
    assert list(sessions("-")) == ["a", "second"]


def test_no_logs_at_all() -> None:
    with pytest.raises(click.UsageError, match="No LOG is given"):
        sessions()


CSV = """name, logs, poses, topics
monday, m_0.mcap;m_1.mcap, poses/m.tum, lidar=/points;pose=/odom
, tuesday.bag, ,
"""
JSON = """{"name": "monday", "logs": ["m_0.mcap", "m_1.mcap"], "poses": "poses/m.tum",\
 "topics": {"lidar": "/points", "pose": "/odom"}}

{"logs": "tuesday.bag"}
"""


@pytest.mark.parametrize("text", [CSV, JSON])
def test_a_manifest_has_logs_poses_and_topics(tmp_path: Path, text: str) -> None:
    manifest = tmp_path / "list"
    manifest.write_text(text)
    monday, tuesday = session_inputs(LogChoice((), manifest).each(), {"imu": "/imu"})
    assert (monday.name, tuesday.name) == ("monday", "tuesday")
    assert monday.logs == (tmp_path / "m_0.mcap", tmp_path / "m_1.mcap")
    assert monday.topics == {"imu": "/imu", "lidar": "/points", "pose": "/odom"}
    assert monday.poses is not None
    assert monday.poses.path == tmp_path / "poses/m.tum"
    assert (tuesday.logs, tuesday.topics, tuesday.poses) == (
        (tmp_path / "tuesday.bag",),
        {"imu": "/imu"},
        None,
    )


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("name,log\nx,a.mcap\n", "line 2: unknown column 'log'; there are name, logs"),
        ("name,logs\nx,\n", "line 2: it names no logs"),
        ('{"logs": "a.mcap"}\n{logs}\n', "line 2: not a JSON object"),
        ("logs,topics\na.mcap,points\n", "line 2: topics are of the form"),
    ],
)
def test_a_fault_of_a_manifest_is_named_with_its_line(
    tmp_path: Path, text: str, fault: str
) -> None:
    manifest = tmp_path / "list.csv"
    manifest.write_text(text)
    with pytest.raises(click.UsageError, match=fault):
        sessions(manifest=manifest)


def test_fuse_makes_one_session_of_its_logs_and_each_of_a_manifest(tmp_path: Path) -> None:
    manifest = tmp_path / "list.csv"
    manifest.write_text("logs\na.mcap\nb.mcap\n")
    choice = LogChoice(("m_0.mcap", "m_1.mcap"), manifest)
    assert [e.name for e in choice.joined("monday")] == ["monday", None, None]
    assert [len(e.logs) for e in choice.joined("monday")] == [2, 1, 1]
    assert LogChoice(("x=m_0.mcap", "m_1.mcap"), None).joined(None)[0].name == "x"
    with pytest.raises(click.UsageError, match="cannot be called x and y"):
        LogChoice(("x=m_0.mcap", "y=m_1.mcap"), None).joined(None)

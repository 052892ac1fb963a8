"""CPU time of kept files is told apart, and stays known; blocks here work for a known time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from semloc_logs.experiments.answers import Learner, Run, answer_scenario, read_answers
from semloc_logs.experiments.kept_files import cpu_seconds, kept_file, measured, not_counted
from semloc_logs.experiments.scenarios import time_scenario
from semloc_logs.experiments.summary_table import Row
from semloc_logs.experiments.system import Query, RankedPose, View
from semloc_logs.experiments.views import ViewStore

LITTLE = 0.05  # s, for what the test itself takes


def work(cpu_s: float) -> None:
    end = cpu_seconds() + cpu_s
    while cpu_seconds() < end:
        sum(range(1000))


def worked(cpu_s: float) -> Callable[[Path], None]:
    """Makes a file in the given time."""

    def make(path: Path) -> None:
        work(cpu_s)
        path.write_text("made")

    return make


def test_a_kept_file_is_made_once_and_its_time_stays_known(tmp_path: Path) -> None:
    for k in range(2):
        with measured() as spent:
            work(0.2)
            path = kept_file(tmp_path / "words" / "a", worked(0.4 if k == 0 else 100.0))
        assert path.read_text() == "made"
        assert spent.cpu_s == pytest.approx(0.2, abs=LITTLE)
        assert spent.kept_s == pytest.approx({"words/a": 0.4}, abs=LITTLE)


def test_a_file_of_another_file_counts_its_own_part(tmp_path: Path) -> None:
    def words(path: Path) -> None:
        kept_file(tmp_path / "words" / "network", worked(0.4))
        with not_counted():
            work(0.3)
        work(0.2)
        path.write_text("made")

    with measured() as spent:
        kept_file(tmp_path / "words" / "words", words)
        work(0.1)
    assert spent.cpu_s == pytest.approx(0.1, abs=LITTLE)
    expected = {"words/network": 0.4, "words/words": 0.2}
    assert spent.kept_s == pytest.approx(expected, abs=LITTLE)


def test_a_file_that_could_not_be_made_is_made_the_next_time(tmp_path: Path) -> None:
    def failing(path: Path) -> None:
        path.write_text("half")
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        kept_file(tmp_path / "a", failing)
    assert kept_file(tmp_path / "a", worked(0.0)).read_text() == "made"


@pytest.mark.parametrize("content", [None, b"", b"0.4 s", b"\xff\xfe", b"nan"])
def test_a_time_that_cannot_be_read_is_unknown(tmp_path: Path, content: bytes | None) -> None:
    path = kept_file(tmp_path / "words" / "a", worked(0.0))
    seconds = path.with_name("a.cpu_s")
    assert sorted(path.parent.iterdir()) == [path, seconds]
    if content is None:
        seconds.unlink()
    else:
        seconds.write_bytes(content)
    with measured() as spent:
        kept_file(path, worked(100.0))
    assert spent.kept_s == {"words/a": 0.0}


def test_hours_of_a_row_have_what_others_have_kept_once(
    make_store: Callable[..., ViewStore], tmp_path: Path
) -> None:
    """Two systems share a file that took 0.4 s; each of them meets it with two databases."""

    class Sharing:
        name = "sharing"

        def fit(self, database: Sequence[View]) -> None:
            work(0.1)
            kept_file(tmp_path / "systems" / "network", worked(0.4))

        def localise(self, query: Query) -> list[RankedPose]:
            return [RankedPose(np.eye(4), 1.0)]

    line = [(float(x), 0.0, 0.0) for x in range(3)]
    store = make_store(map=line, other=line, drive=line[:1])
    for name in ("one", "two"):
        row = Row(name, name)
        for database in ("map", "other"):
            scenario = time_scenario(store, f"{database}>drive", database, "drive")
            run = Run(name, "lidar", 1, "v1")
            answer_scenario(run, scenario, Learner(store, Sharing), tmp_path / "answers")
            row.answers["lidar", scenario.name] = read_answers(run, scenario, tmp_path / "answers")
        assert row.kept_s == pytest.approx(0.4, abs=LITTLE)
        assert row.fit_s == pytest.approx(0.2, abs=2 * LITTLE)
        assert 3600 * row.cpu_hours == pytest.approx(0.6, abs=3 * LITTLE)

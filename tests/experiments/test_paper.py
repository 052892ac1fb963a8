"""The whole run, on views in memory and systems of a few lines: one knows where queries are, one
fails, one lacks a library, one needs pictures.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from semloc_logs.errors import SettingsError
from semloc_logs.experiments import paper
from semloc_logs.experiments.paper import PaperFiles, PaperRequest, run_paper, run_systems
from semloc_logs.experiments.scenarios import Scenario, heading_scenario, time_scenario
from semloc_logs.experiments.system import Query, RankedPose, View
from semloc_logs.experiments.system_version import module_version
from semloc_logs.experiments.systems import catalogue
from semloc_logs.experiments.systems.catalogue import MODULES, Entry, SystemOptions
from semloc_logs.experiments.views import ViewStore
from semloc_logs.settings import load

Make = Callable[..., ViewStore]
EAST = [(float(x), 0.0, 0.0) for x in range(100)]
WEST = [(float(x), 3.5, 180.0) for x in range(99, -1, -1)]
SNOW = [(float(x), 0.5, 0.0) for x in range(20, 60)]

calls: list[str] = []


class Nearest:
    """Finds the view whose only point is nearest to the query's."""

    name = "nearest"

    def __init__(self, options: SystemOptions) -> None:
        self.folder = options.folder

    def fit(self, database: Sequence[View]) -> None:
        calls.append(f"fit {len(database)}")
        self.views = list(database)

    def localise(self, query: Query) -> list[RankedPose]:
        assert 1 <= len(query.views) <= 5
        place = query.views[-1].points[0]
        away = [float(np.linalg.norm(v.points[0] - place)) for v in self.views]
        order = np.argsort(away, kind="stable")[:5]
        return [RankedPose(self.views[k].world_T_base, -away[k]) for k in order]


class Failing(Nearest):
    """Fails at its first query."""

    def localise(self, query: Query) -> list[RankedPose]:
        raise ZeroDivisionError("nothing to divide by")


def lacks_library(_: SystemOptions) -> Nearest:
    import a_library_that_nobody_has  # type: ignore[import-not-found]  # noqa: F401

    raise AssertionError


ENTRIES = (
    Entry("nearest", "Nearest", "toys:Nearest", remark="It knows the truth."),
    Entry("nearest-acc", "Nearest (acc.)", "toys:Nearest", frames=5),
    Entry("failing", "Failing", "toys:Failing"),
    Entry("missing", "Missing", "toys:lacks_library", extra="baselines"),
    Entry("pictures", "Pictures", "toys:Nearest", needs_pictures=True),
)


@pytest.fixture
def run(
    make_store: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., PaperFiles]:
    module = ModuleType(f"{MODULES}.toys")
    for item in (Nearest, Failing, lacks_library):
        setattr(module, item.__name__, item)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(paper, "module_version", lambda name: "v1")
    calls.clear()

    store = make_store(map=EAST, back=WEST, snow=SNOW)
    scenarios: list[Scenario] = [
        heading_scenario(store, 180.0, ["map"], ["back"]),
        time_scenario(store, "summer>snow", "map", "snow"),
    ]

    def run_once(*, only_tables: bool = False, first: int = 0, quick: bool = False) -> PaperFiles:
        request = PaperRequest(load().resolved(), tmp_path, only_tables=only_tables, quick=quick)
        return run_systems(request, ENTRIES, {"lidar": store}, {"lidar": scenarios[first:]})

    return run_once


def test_the_table_has_a_row_for_every_system(run: Callable[[], PaperFiles]) -> None:
    files = run()
    text = files.table.read_text()
    # 3.5 m beside the mapped lane: within 5 m, not within 1 m; in snow 0.5 m
    rows = [line for line in text.splitlines() if line.startswith("| Nearest |")]
    assert rows[0].split("|")[2].strip().startswith("0.00")
    assert rows[2].split("|")[2].strip().startswith("1.00")
    # in snow there are two passages only
    assert rows[0].split("|")[3].strip() == "40 of 40"
    assert [cell.strip() for cell in rows[4].split("|")[2:4]] == ["3.50", "0.50"]
    assert "| queries | 100 | 40 |" in text
    assert "Every scenario" not in text
    assert "A quick run" not in text
    assert "- Failing, lidar: it failed: ZeroDivisionError: nothing to divide by" in text
    assert (
        "- Missing, lidar: Missing needs a_library_that_nobody_has, which is not installed: "
        "pip install 'semloc_logs[baselines]'." in text
    )
    assert (
        "- Pictures, lidar: it works on pictures, and the logs have no calibrated camera." in text
    )
    assert "- Nearest: It knows the truth." in text
    assert "| acc. above single | our pipeline | lidar | 90 |  | not measured |" in text


def test_a_table_of_few_passages_counts_and_decides_nothing(
    run: Callable[..., PaperFiles],
) -> None:
    files = run(first=1, quick=True)  # in snow alone
    text = files.table.read_text()
    assert "A quick run: networks" in text
    assert "Every scenario has fewer than 5 passages" in text
    assert "| Nearest | 40 of 40 |" in text
    assert "Orderings" not in text
    assert json.loads(files.json.read_text())["findings"]


def test_every_measure_is_in_the_json(run: Callable[[], PaperFiles]) -> None:
    content = json.loads(run().json.read_text())
    nearest = content["systems"][0]
    assert nearest["name"] == "nearest"
    figures = nearest["scenarios"]["lidar 180"]
    assert (figures["queries"], figures["passages"]) == (100, 5)
    assert figures["within 5 m"]["rank 1"]["value"] == 1.0
    assert figures["within 1 m"]["rank 100"]["value"] == 0.0
    assert figures["within 5 m"]["median error"] == 3.5
    assert len(figures["within 5 m"]["rank-recall"]) == 100
    assert figures["localised within"]["3 m"] == 0.0
    assert figures["localised within"]["4 m"] == 1.0
    assert figures["precision-recall"]["average_precision"] == pytest.approx(1.0)
    assert figures["precision-recall"]["recall"][-1] == 1.0
    assert figures["KITTI loops"] == {
        "loops": 100,
        "average_precision": 1.0,
        "best_f1": 1.0,
        "recall_at_full_precision": 1.0,
    }
    # 3.5 m and 180 degrees off: a loop, but not a registration, nor a pair within 3 m
    assert figures["registration"]["success"]["value"] == 0.0
    assert figures["SSC pairs"]["positives"] == 0
    assert figures["abstaining"]["coverage"]["value"] == 1.0
    snow = nearest["scenarios"]["lidar summer>snow"]
    assert snow["registration"]["success"]["value"] == 1.0
    assert snow["registration"]["translation_m"] == pytest.approx(0.5)
    assert snow["SSC pairs"]["best_f1"] == pytest.approx(1.0)
    assert content["scenarios"][0]["databases"] == [100]


def test_the_figure_is_drawn(run: Callable[[], PaperFiles]) -> None:
    files = run()
    (path,) = files.figures
    image = cv2.imread(str(path))
    assert image is not None
    assert image.shape[0] > 600
    # curves of both systems that ran
    colours = {tuple(c) for c in image.reshape(-1, 3)[::7].tolist()}
    assert len(colours) > 10


def test_a_second_run_asks_no_system_again(run: Callable[[], PaperFiles]) -> None:
    run()
    assert calls
    # the failing one has no answers, and is fitted again; it failed at its first scenario
    calls.clear()
    run()
    assert calls == ["fit 100"]


def test_the_tables_of_what_is_there_need_no_system(
    run: Callable[..., PaperFiles],
) -> None:
    assert "| Nearest |  |  |" in run(only_tables=True).table.read_text()
    assert calls == []
    run()
    calls.clear()
    text = run(only_tables=True).table.read_text()
    assert "| Nearest | 1.00" in text
    assert calls == []


def test_unknown_names_are_refused(tmp_path: Path) -> None:
    settings = load().resolved()
    with pytest.raises(SettingsError, match="Unknown system 'sfit'"):
        run_paper(PaperRequest(settings, tmp_path, systems=["sfit"]))
    with pytest.raises(SettingsError, match="Unknown sensor 'radar'"):
        run_paper(PaperRequest(settings, tmp_path, sensors=["radar"]))
    with pytest.raises(SettingsError, match="logs and --truth FILE, or neither"):
        run_paper(PaperRequest(settings, tmp_path, logs=[tmp_path / "a.mcap"]))


def test_every_entry_leads_to_a_module() -> None:
    known = catalogue.entries()
    assert len({entry.name for entry in known}) == len(known)
    for entry in known:
        assert len(module_version(f"{MODULES}.{entry.made_by.partition(':')[0]}")) == 12


def test_the_version_of_a_module_changes_with_the_modules_that_it_imports() -> None:
    system = module_version("semloc_logs.experiments.system")
    views = module_version("semloc_logs.experiments.views")
    assert system != views
    # packages count with what they import
    settings = module_version("semloc_logs.settings")
    assert settings not in (module_version("semloc_logs.settings.sections"), module_version("x"))
    # of an entry that is added only its own row is new
    listed = module_version("semloc_logs.experiments.systems.catalogue")
    assert listed == module_version("semloc_logs.nothing")
    assert module_version("semloc_logs.experiments.absent") == module_version("semloc_logs.nothing")

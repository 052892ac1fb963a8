"""A recording for Rerun, read back with its own command line."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semloc_logs.errors import SemlocError
from semloc_logs.exports import export
from semloc_logs.settings import load
from semloc_logs.stages.optimise import optimise
from semloc_logs.tables import contracts
from semloc_logs.tables.table import write_table


def _chunks(path: Path) -> dict[str, dict[str, Any]]:
    """The columns of each entity of a recording, by the reader of rerun."""
    reader = pytest.importorskip("rerun.chunk").RrdReader(str(path))
    assert len(reader.recordings()) == len(reader.blueprints()) == 1
    columns_of: dict[str, dict[str, Any]] = {}
    for chunk in reader.stream().to_chunks():
        columns_of.setdefault(chunk.entity_path, {}).update(chunk.to_record_batch().to_pydict())
    return columns_of


def _verify(path: Path) -> None:
    command = [sys.executable, "-m", "rerun", "rrd", "verify", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr


def _close(drives: Any, square_of: Any) -> None:
    drives.add("a", square_of(1), 0.0, 1.0)
    drives.add("b", square_of(1), 0.01, 1.0)
    drives.close([("b", k, "a", k, None) for k in range(20, 400, 40)])
    voxels = {
        "ix": [0, 200],
        "iy": [0, 100],
        "iz": [0, 0],
        "label": [2, 8],
        "occupancy": [1.0, 1.0],
        "hits": [1, 1],
    }
    table = contracts.table("voxels", voxels)
    for name in ("a", "b"):
        folder = drives.work.session(name).voxels / "tile=0_0"
        write_table(folder / "part-0.parquet", table, {})


@pytest.mark.parametrize("is_optimised", [False, True])
def test_the_recording_has_maps_drives_and_closures(
    drives: Any, square_of: Any, tmp_path: Path, is_optimised: bool
) -> None:
    pytest.importorskip("rerun")
    _close(drives, square_of)
    if is_optimised:
        pytest.importorskip("gtsam")
        optimise(drives.work, load().resolved())
    (path,) = export(drives.work, [], "rrd", tmp_path)
    assert path.name == "drives.rrd"
    _verify(path)
    chunks = _chunks(path)
    assert {f"/{kind}/{name}" for kind in ("maps", "drives") for name in "ab"} < set(chunks)
    assert len(chunks["/maps/a"]["Points3D:positions"][0]) == 2
    np.testing.assert_allclose(chunks["/maps/a"]["Points3D:positions"][0][0], [0.15] * 3, atol=1e-3)
    assert len(chunks["/closures"]["LineStrips3D:strips"][0]) == 10
    assert len(chunks["/probability/b"]["Scalars:scalars"]) == 10

    # both vehicles on the same road where closures say so
    places = {
        name: np.array(chunks[f"/drives/{name}/vehicle"]["Transform3D:translation"])[:, 0]
        for name in "ab"
    }
    if is_optimised:
        assert np.linalg.norm(places["a"] - places["b"], axis=1)[20:380].max() < 0.5
    else:
        assert np.linalg.norm(places["a"] - places["b"], axis=1).min() < 0.1
        np.testing.assert_allclose(places["a"], drives.true["a"][:, :3, 3], atol=1e-3)


def test_drives_of_several_days_run_side_by_side(
    drives: Any, square_of: Any, tmp_path: Path
) -> None:
    pytest.importorskip("rerun")
    _close(drives, square_of)
    (path,) = export(drives.work, [], "rrd", tmp_path)
    chunks = _chunks(path)
    for name in "ab":
        vehicle = chunks[f"/drives/{name}/vehicle"]
        assert [t.total_seconds() for t in vehicle["drive"]] == list(range(401))
        seconds = np.array(vehicle["time"], "datetime64[s]").astype(int)
        assert seconds.tolist() == list(range(drives.start_s[name], drives.start_s[name] + 401))


def test_without_rerun_a_sentence_names_the_extra(
    drives: Any, square_of: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _close(drives, square_of)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(SemlocError, match=r"semloc_logs\[rerun\]"):
        export(drives.work, [], "rrd", tmp_path)
    assert not list(tmp_path.glob("*.rrd"))

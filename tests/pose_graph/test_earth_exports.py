"""Drives, closures and points on the earth, against coordinates computed elsewhere."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semloc_logs.errors import WorkspaceError
from semloc_logs.exports import Selection, export
from semloc_logs.logs.poses.navsat import LocalFrame
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.numerics.utm import UtmZone
from semloc_logs.settings import load
from semloc_logs.stages.optimise import optimise
from semloc_logs.tables import contracts
from semloc_logs.tables.table import write_table

SETTINGS = load().resolved()
ENU_T_COMMON = yaw_transform(1.0, (20.0, 30.0, 2.0))


def test_utm_of_a_published_point() -> None:
    """The CN Tower, as Wikipedia has it: 17N 630084 4833438."""
    latitude = 43 + 38 / 60 + 33.24 / 3600
    longitude = -(79 + 23 / 60 + 13.7 / 3600)
    zone = UtmZone.of(latitude, longitude)
    assert (zone.number, zone.is_south, zone.epsg) == (17, False, 32617)
    projected = zone.project(np.array([[latitude, longitude, 76.0]]))
    np.testing.assert_allclose(projected, [[630084, 4833438, 76]], atol=1.0)


def test_utm_on_the_central_meridian_is_the_scaled_arc() -> None:
    """A quarter of the meridian of WGS 84 is 10,001,965.729 m long."""
    zone = UtmZone(33, False)
    projected = zone.project(np.array([[90.0, 15.0, 0.0], [0.0, 15.0, 0.0]]))
    np.testing.assert_allclose(projected[:, 0], 500_000.0, atol=1e-6)
    np.testing.assert_allclose(projected[:, 1], [0.9996 * 10_001_965.729, 0.0], atol=2e-3)
    south = UtmZone.of(-33.9, 151.2)
    assert (south.number, south.epsg) == (56, 32756)
    assert south.project(np.array([[-1e-9, 151.2, 0.0]]))[0, 1] == pytest.approx(1e7, abs=1e-3)


@pytest.mark.parametrize("place", [(47.37, 8.54, 410.0), (-33.9, 151.2, -3.0), (0.0, 180.0, 9e3)])
def test_geodetic_coordinates_come_back(place: tuple[float, float, float]) -> None:
    local = LocalFrame(47.0, 8.0, 100.0)
    back = local.geodetic(local.position(*place)[None])[0]
    np.testing.assert_allclose(back, place, atol=1e-8)


@pytest.fixture
def located(drives: Any, square_of: Any) -> Any:
    """Drive a with fixes, b connected with it, c alone and without fixes."""
    pytest.importorskip("gtsam")
    for name in ("a", "b", "c"):
        drives.add(name, square_of(1), 0.0, 1.0)
    drives.locate("a", ENU_T_COMMON)
    drives.close([("b", k, "a", k, None) for k in range(20, 400, 40)])
    optimise(drives.work, SETTINGS)
    return drives


def test_drives_and_closures_as_geojson(located: Any, tmp_path: Path, datum: Any) -> None:
    (path,) = export(located.work, [], "geojson", tmp_path)
    content = json.loads(path.read_text())
    assert content["type"] == "FeatureCollection"
    drives = {
        f["properties"]["session"]: f
        for f in content["features"]
        if f["properties"]["kind"] == "drive"
    }
    assert set(drives) == {"a", "b"}
    local = LocalFrame(*datum)
    for name, feature in drives.items():
        assert feature["geometry"]["type"] == "LineString"
        places = np.array(feature["geometry"]["coordinates"])
        assert len(places) == 401
        positions = np.array([local.position(lat, lon, height) for lon, lat, height in places])
        truth = (ENU_T_COMMON @ located.true[name])[:, :3, 3]
        assert np.linalg.norm(positions - truth, axis=1).max() < 1.0
    closures = [f for f in content["features"] if f["properties"]["kind"] == "closure"]
    assert len(closures) == 10
    assert all(f["properties"]["kept"] for f in closures)
    first = closures[0]["geometry"]["coordinates"]
    np.testing.assert_allclose(first[0], drives["b"]["geometry"]["coordinates"][20])


def test_without_poses_on_the_earth_the_fixes_are_drawn(
    drives: Any, square_of: Any, tmp_path: Path
) -> None:
    drives.add("a", square_of(1), 0.0, 1.0)
    drives.add("b", square_of(1), 0.0, 1.0)
    with pytest.raises(WorkspaceError, match="satellite fixes"):
        export(drives.work, [], "geojson", tmp_path)
    drives.locate("a", ENU_T_COMMON)
    (path,) = export(drives.work, [], "geojson", tmp_path)
    (feature,) = json.loads(path.read_text())["features"]
    assert feature["properties"]["positions"] == "satellite fixes"
    assert len(feature["geometry"]["coordinates"]) == 81


def test_las_in_utm_has_its_coordinate_system(located: Any, tmp_path: Path, datum: Any) -> None:
    laspy = pytest.importorskip("laspy")
    voxels = {
        "ix": [0, 200],
        "iy": [0, 100],
        "iz": [0, 0],
        "label": [2, 8],
        "occupancy": [1.0, 1.0],
        "hits": [1, 1],
    }
    table = contracts.table("voxels", voxels)
    write_table(located.work.session("a").voxels / "tile=0_0/part-0.parquet", table, {})
    (path,) = export(located.work, ["a"], "las", tmp_path, Selection(frame="utm"))
    las = laspy.read(path)
    (record,) = las.header.vlrs.get("WktCoordinateSystemVlr")
    assert record.string.startswith('PROJCS["WGS 84 / UTM zone 32N"')
    assert 'AUTHORITY["EPSG","32632"]' in record.string
    assert las.header.global_encoding.wkt
    centres = (np.array([[0, 0, 0], [200, 100, 0]]) + 0.5) * 0.3
    enu = centres @ ENU_T_COMMON[:3, :3].T + ENU_T_COMMON[:3, 3]
    expected = UtmZone(32, False).project(LocalFrame(*datum).geodetic(enu))
    np.testing.assert_allclose(las.xyz, expected, atol=0.5)  # fixes are as good

    (path,) = export(located.work, ["a"], "xyz", tmp_path, Selection(frame="common"))
    assert np.abs(np.loadtxt(path)[:, :3]).max() < 1000.0
    with pytest.raises(WorkspaceError, match="not placed on the earth"):
        export(located.work, ["c"], "las", tmp_path, Selection(frame="utm"))

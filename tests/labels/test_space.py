from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import DTypeLike

from semloc_logs.errors import SettingsError
from semloc_logs.labels.space import BUILDING, GROUND, POLE, SKY, UNLABELLED, VEGETATION, cityscapes, guess_space, spaces, to_cityscapes

INTEGERS = [np.uint8, np.int16, np.uint32, np.int64]


def test_cityscapes_has_its_19_classes_in_order() -> None:
    space = cityscapes()
    names = (
        "road sidewalk building wall fence pole traffic_light traffic_sign vegetation terrain sky "
        "person rider car truck bus train motorcycle bicycle"
    )
    assert space.names == tuple(n.replace("_", " ") for n in names.split())
    assert space.names[SKY] == "sky"
    assert [space.names[i] for i in (BUILDING, POLE, VEGETATION)] == ["building", "pole", "vegetation"]
    assert np.flatnonzero(space.dynamic).tolist() == list(range(11, 19))
    assert len({tuple(c) for c in space.colours.tolist()}) == 19


def test_the_coarse_set() -> None:
    space = cityscapes()
    assert space.coarse_names == ("ground", "construction", "pole", "vegetation", "vehicle", "other")
    by_name = {space.names[i]: space.coarse_names[space.coarse[i]] for i in range(19)}
    assert {by_name[space.names[i]] for i in GROUND} == {"ground"}
    assert (by_name["fence"], by_name["traffic sign"], by_name["car"], by_name["rider"]) == ("construction", "pole", "vehicle", "other")
    assert (space.coarse[19:] == UNLABELLED).all()


@pytest.mark.parametrize("kind", INTEGERS)
def test_cityscapes_ids_stay_and_others_are_unlabelled(kind: DTypeLike) -> None:
    ids = np.array([0, 13, 18, 19, 100], kind)
    assert to_cityscapes(ids, "cityscapes").tolist() == [0, 13, 18, 255, 255]


@pytest.mark.parametrize("kind", INTEGERS)
def test_semantickitti_ids_with_and_without_instances(kind: DTypeLike) -> None:
    ids = np.array([0, 10, 40, 48, 50, 71, 80, 99], kind)
    expected = [255, 13, 0, 1, 2, 8, 5, 255]
    assert to_cityscapes(ids, "semantickitti").tolist() == expected
    assert to_cityscapes(ids.reshape(2, 4), "semantickitti").tolist() == [expected[:4], expected[4:]]
    if np.iinfo(kind).max > 2**20:
        assert to_cityscapes(ids + np.array(7 << 16, kind), "semantickitti").tolist() == expected
    assert to_cityscapes(ids[:0], "semantickitti").tolist() == []


def test_an_unknown_space_is_refused_by_name() -> None:
    with pytest.raises(SettingsError, match="marskitti"):
        to_cityscapes(np.zeros(1, np.uint32), "marskitti")
    assert spaces() == sorted(spaces())
    assert {"cityscapes", "semantickitti"} <= set(spaces())


@pytest.mark.parametrize("kind", INTEGERS)
def test_guessing_the_space(kind: DTypeLike) -> None:
    assert guess_space(np.array([0, 8, 18], kind)) == "cityscapes"
    assert guess_space(np.array([0, 8, 50], kind)) == "semantickitti"
    if np.iinfo(kind).max > 2**17:
        assert guess_space(np.array([10 + (1 << 16), 13], kind)) == "semantickitti"  # an instance in the upper half
    if np.iinfo(kind).max >= 255:
        assert guess_space(np.array([2, 255], kind)) == "cityscapes"

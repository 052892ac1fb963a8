from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import DTypeLike

from semloc_logs.errors import SettingsError
from semloc_logs.labels.space import (
    BUILDING,
    GROUND,
    POLE,
    SKY,
    UNLABELLED,
    UNPAINTED,
    VEGETATION,
    cityscapes,
    guess_palette,
    guess_space,
    plain,
    read_space,
    space_of_names,
    spaces,
    to_cityscapes,
    trains_by_name,
)

INTEGERS = [np.uint8, np.int16, np.uint32, np.int64]


def test_cityscapes_has_its_19_classes_in_order() -> None:
    space = cityscapes()
    names = (
        "road sidewalk building wall fence pole traffic_light traffic_sign vegetation terrain sky "
        "person rider car truck bus train motorcycle bicycle"
    )
    assert space.names == tuple(n.replace("_", " ") for n in names.split())
    assert space.names[SKY] == "sky"
    assert [space.names[i] for i in (BUILDING, POLE, VEGETATION)] == [
        "building",
        "pole",
        "vegetation",
    ]
    assert np.flatnonzero(space.dynamic).tolist() == list(range(11, 19))
    assert len({tuple(c) for c in space.colours.tolist()}) == 19


def test_the_coarse_set() -> None:
    space = cityscapes()
    assert space.coarse_names == (
        "ground",
        "construction",
        "pole",
        "vegetation",
        "vehicle",
        "other",
    )
    by_name = {space.names[i]: space.coarse_names[space.coarse[i]] for i in range(19)}
    assert {by_name[space.names[i]] for i in GROUND} == {"ground"}
    assert (by_name["fence"], by_name["traffic sign"], by_name["car"], by_name["rider"]) == (
        "construction",
        "pole",
        "vehicle",
        "other",
    )
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
    assert to_cityscapes(ids.reshape(2, 4), "semantickitti").tolist() == [
        expected[:4],
        expected[4:],
    ]
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
        # an instance in the upper half
        assert guess_space(np.array([10 + (1 << 16), 13], kind)) == "semantickitti"
    if np.iinfo(kind).max >= 255:
        assert guess_space(np.array([2, 255], kind)) == "cityscapes"


@pytest.mark.parametrize("name", spaces())
def test_every_shipped_space_is_sound(name: str) -> None:
    space = read_space(name)
    own = cityscapes()
    assert space.name == name
    assert len(set(space.names.values())) == len(space.names) > 10
    assert set(space.targets) == set(space.names)
    assert set(space.targets.values()) <= {*range(19), UNLABELLED}
    assert {i for i, t in space.targets.items() if t < 19 and own.dynamic[t]} <= space.dynamic
    by_colour: dict[tuple[int, int, int], set[int]] = {}
    for i, colour in space.colours.items():
        by_colour.setdefault(colour, set()).add(space.targets[i])
    assert all(len(targets) == 1 for targets in by_colour.values()), {
        c: t for c, t in by_colour.items() if len(t) > 1
    }
    train_ids, strange = space.train_ids_of_colours(
        np.array([c[0] << 16 | c[1] << 8 | c[2] for c in space.colours.values()], np.uint32)
    )
    assert train_ids.tolist() == [space.targets[i] for i in space.colours]
    assert not strange


@pytest.mark.parametrize(
    ("name", "count", "known"),
    [
        ("cityscapes", 19, {0: ("road", 0), 13: ("car", 13), 18: ("bicycle", 18)}),
        (
            "cityscapes_ids",
            34,
            {
                0: ("unlabeled", 255),
                7: ("road", 0),
                23: ("sky", 10),
                26: ("car", 13),
                33: ("bicycle", 18),
            },
        ),
        (
            "kitti360",
            45,
            {7: ("road", 0), 34: ("garage", 2), 37: ("smallpole", 5), 44: ("unknown object", 255)},
        ),
        (
            "semantickitti",
            34,
            {10: ("car", 13), 40: ("road", 0), 81: ("traffic-sign", 7), 252: ("moving-car", 13)},
        ),
        (
            "mapillary",
            66,
            {
                13: ("road", 0),
                27: ("sky", 10),
                45: ("pole", 5),
                55: ("car", 13),
                65: ("unlabeled", 255),
            },
        ),
        (
            "ade20k",
            150,
            {
                0: ("wall", 3),
                2: ("sky", 10),
                6: ("road", 0),
                20: ("car", 13),
                127: ("bicycle", 18),
                149: ("flag", 255),
            },
        ),
        (
            "nuscenes_lidarseg",
            32,
            {
                17: ("vehicle.car", 13),
                24: ("flat.driveable_surface", 0),
                30: ("static.vegetation", 8),
            },
        ),
        (
            "nuscenes_challenge",
            17,
            {4: ("car", 13), 11: ("driveable_surface", 0), 16: ("vegetation", 8)},
        ),
    ],
)
def test_well_known_classes(name: str, count: int, known: dict[int, tuple[str, int]]) -> None:
    space = read_space(name)
    assert len(space.names) == count
    assert {i: (space.names[i], space.targets[i]) for i in known} == known


def test_colours_that_the_palette_does_not_have_are_counted() -> None:
    road = 128 << 16 | 64 << 8 | 128
    car = 142
    strange = 0x010203
    ids, unknown = read_space("cityscapes").train_ids_of_colours(
        np.array([[road, car, strange], [strange, 0, UNPAINTED]], np.uint32)
    )
    assert ids.tolist() == [[0, 13, 255], [255, 255, 255]]
    assert unknown == {strange: 2}


def test_guessing_palettes_and_full_ids() -> None:
    assert guess_palette({128 << 16 | 64 << 8 | 128: 5, 0: 100}) == "cityscapes"
    assert guess_palette({0: 7}) is None
    assert guess_palette({0x010203: 5}) is None
    semantickitti = {
        c[0] << 16 | c[1] << 8 | c[2]: 1 for c in read_space("semantickitti").colours.values()
    }
    assert guess_palette(semantickitti) == "semantickitti"
    assert guess_space(np.array([7, 8, 11, 21, 22, 23, 26])) == "cityscapes_ids"
    assert guess_space(np.array([0, 10, 30, 31])) == "semantickitti"


def test_a_space_of_the_user(tmp_path: Path) -> None:
    file = tmp_path / "ours.yaml"
    classes = (
        "1: {name: asphalt}, 2: {name: truss, to: pole, colour: [1, 2, 3]}, 3: gizmo, "
        "7: {name: deer, to: null, dynamic: true}"
    )
    file.write_text(f"classes: {{{classes}}}")
    space = read_space(str(file))
    assert space.train_ids(np.array([0, 1, 2, 3, 7, 99])).tolist() == [255, 0, 5, 255, 255, 255]
    assert space.colours == {2: (1, 2, 3)}
    assert space.dynamic == {7}
    assert space.unknown == ("gizmo",)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("classes: {1: {name: a, to: rod}}", "maps 1 to 'rod'"),
        ("classes: {1: {name: a, to: 19}}", "maps 1 to '19'"),
        ("classes: {1: {name: a, to: true}}", "maps 1 to 'True'"),
        ("classes: {70000: {name: a}}", "the id 70000"),
        ("classes: {-1: {name: a}}", "the id -1"),
        ("classes: {1: {name: a, colour: [1, 2]}}", "gives 1 the colour"),
        ("classes: {1: {name: a, colour: [1, 2, 256]}}", "gives 1 the colour"),
        ("classes: [a, b]", "no 'classes'"),
        ("classes: {a: {name: b}}", "no 'classes'"),
        ("5", "no 'classes'"),
        ("{", "cannot be read as YAML"),
        ("[" * 5000, "cannot be read as YAML"),
        ("classes: {1: 2001-99-99}", "cannot be read as YAML"),
        ("classes: !!timestamp soon", "cannot be read as YAML"),
        (f"classes: {{{'9' * 5000}: a}}", "cannot be read as YAML"),
        ("a: &a [x, x]\nclasses: {1: {name: *a}}", "aliases are not supported"),
        ("classes: {1: a}\nmask: 100000000000000000000", "has the mask"),
        ("classes: {1: a}\nmask: -1", "has the mask"),
        ("#" * (1 << 20) + "#", "larger than a megabyte"),
    ],
)
def test_a_space_that_makes_no_sense_is_refused(tmp_path: Path, text: str, match: str) -> None:
    file = tmp_path / "odd.yaml"
    file.write_text(text)
    with pytest.raises(SettingsError, match=match):
        read_space(str(file))
    with pytest.raises(SettingsError, match="cannot be read"):
        read_space(str(tmp_path / "none.yaml"))


def test_classes_by_name() -> None:
    names = [
        "Road",
        "traffic_light",
        "Lane Marking - General",
        "construction--flat--road",
        "vehicle.car",
        "BACKGROUND",
        "unlabeled",
        "frob",
        "",
    ]
    space = space_of_names(dict(enumerate(names)), "/label_info")
    assert [space.targets[i] for i in range(len(names))] == [0, 6, 0, 0, 13, 255, 255, 255, 255]
    assert space.unknown == ("frob",)
    assert {trains_by_name()[plain(n)] for n in cityscapes().names} == set(range(19))


def test_names_of_ids_that_no_label_can_have_are_left_out() -> None:
    space = space_of_names({-1: "road", 3: "car", 1 << 40: "pole"}, "/label_info")
    assert space.targets == {3: 13}
    assert space.unknown == ("road", "pole")
    assert space.train_ids(np.array([0, 3, 4, 1 << 31])).tolist() == [255, 13, 255, 255]

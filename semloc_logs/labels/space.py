"""Label spaces: ids and colours of a log -> Cityscapes train ids, and their coarse common set."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from semloc_logs.arrays import U8, U32
from semloc_logs.errors import SettingsError
from semloc_logs.schemas import names, read_text
from semloc_logs.settings import read_yaml

UNLABELLED = 255
UNPAINTED = 0xFFFFFFFF  # instead of an id: nothing was seen there
SKY = 10
ROAD, SIDEWALK, BUILDING, POLE, VEGETATION, TERRAIN = 0, 1, 2, 5, 8, 9
GROUND = (ROAD, SIDEWALK, TERRAIN)
# poles, traffic lights and signs, people, vehicles: not larger than some metres
THINGS = (POLE, 6, 7, *range(11, 19))
KNOWS_CLASSES = ("log", "onnx")  # label sources with classes that the semantic network understands
_HIGHEST_ID = 0xFFFF


@dataclass(frozen=True, slots=True)
class Cityscapes:
    """The label space of every map: names and RGB colours by train id.

    ``dynamic`` marks the classes that move; ``coarse`` is the index of each class in the coarse
    set.
    """

    names: tuple[str, ...]
    colours: U8
    dynamic: NDArray[np.bool_]
    coarse: U8  # (256,), 255 where unlabelled
    coarse_names: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class LabelSpace:
    """The meaning of a log's ids.

    ``names`` and ``targets`` (Cityscapes train ids, 255 unlabelled) by id, RGB ``colours`` where
    they are known, ``dynamic`` ids. An id is the recorded number under ``mask``. ``unknown`` are
    names without a class of Cityscapes.
    """

    name: str
    names: Mapping[int, str]
    targets: Mapping[int, int]
    colours: Mapping[int, tuple[int, int, int]] = field(default_factory=dict)
    dynamic: frozenset[int] = frozenset()
    mask: int = 0xFFFFFFFF
    unknown: tuple[str, ...] = ()

    def train_ids(self, ids: NDArray[np.integer]) -> U8:
        """Train ids of recorded ``ids`` of any shape; 255 where the space does not map them."""
        known = np.asarray(ids, np.int64) & self.mask
        table = np.full(max(self.targets, default=0) + 2, UNLABELLED, np.uint8)
        for i, target in self.targets.items():
            table[i] = target
        out: U8 = table[np.minimum(known, len(table) - 1)]
        return out

    def train_ids_of_colours(self, packed: U32) -> tuple[U8, dict[int, int]]:
        """Train ids of ``packed`` colours, and how often which colour is missing in the palette.

        Colours are packed as by :func:`semloc_logs.logs.sensors.depth.label_ids`. Black means
        unlabelled where a palette does not use it.
        """
        palette = {0: UNLABELLED} | {
            c[0] << 16 | c[1] << 8 | c[2]: self.targets[i]
            for i, c in reversed(list(self.colours.items()))
        }
        keys = np.array(sorted(palette), np.uint32)
        targets = np.array([palette[int(k)] for k in keys], np.uint8)
        flat = np.asarray(packed, np.uint32).reshape(-1)
        place = np.minimum(np.searchsorted(keys, flat), len(keys) - 1)
        known = keys[place] == flat
        strange, counts = np.unique(flat[~known & (flat != UNPAINTED)], return_counts=True)
        out = np.where(known, targets[place], UNLABELLED).astype(np.uint8)
        return out.reshape(np.shape(packed)), dict(
            zip(strange.tolist(), counts.tolist(), strict=True)
        )


@cache
def cityscapes() -> Cityscapes:
    """The shipped description of the 19 classes."""
    content = yaml.safe_load(read_text("label_spaces/cityscapes.yaml"))
    rows = [content["classes"][i] for i in range(len(content["classes"]))]
    coarse = np.full(256, UNLABELLED, np.uint8)
    coarse[: len(rows)] = [content["coarse"].index(r["coarse"]) for r in rows]
    return Cityscapes(
        tuple(r["name"] for r in rows),
        np.array([r["colour"] for r in rows], np.uint8),
        np.array([r.get("dynamic", False) for r in rows]),
        coarse,
        tuple(content["coarse"]),
    )


def spaces() -> list[str]:
    """Names of the label spaces that are shipped."""
    return list(names("label_spaces", ".yaml"))


def is_file_name(name: str) -> bool:
    """Whether ``name`` names a YAML file, not a shipped space."""
    return Path(name).suffix.lower() in (".yaml", ".yml")


def read_space(name: str) -> LabelSpace:
    """The shipped space ``name``, or the space of the YAML file ``name``.

    SettingsError for an unknown name and for a file that does not hold a space.
    """
    if name in spaces():
        return _shipped(name)
    if not is_file_name(name):
        raise SettingsError(
            f"Unknown label space '{name}': there are {', '.join(spaces())}; or name a YAML file."
        )
    return _parse(read_yaml(Path(name), "Label space"), name, trains_by_name())


@cache
def _shipped(name: str) -> LabelSpace:
    own = {n: i for i, n in enumerate(cityscapes().names)}
    return _parse(yaml.safe_load(read_text(f"label_spaces/{name}.yaml")), name, own)


def _parse(content: Any, where: str, by_name: Mapping[str, int]) -> LabelSpace:
    """A space from its YAML form; a class without ``to`` is mapped by its name."""
    try:
        classes = content["classes"]
        mask = int(content.get("mask", 0xFFFFFFFF))
        rows = {
            int(i): row if isinstance(row, dict) else {"name": row} for i, row in classes.items()
        }
    except (TypeError, KeyError, ValueError, AttributeError, OverflowError):
        raise SettingsError(
            f"Label space {where} has no 'classes' of the form 'ID: {{name: NAME, to: "
            f"CITYSCAPES_CLASS}}'."
        ) from None
    if not 0 <= mask <= 0xFFFFFFFF:
        raise SettingsError(
            f"Label space {where} has the mask {mask:#x}: it has to be within 32 bits."
        )
    class_names = dict[int, str]()
    targets = dict[int, int]()
    colours = dict[int, tuple[int, int, int]]()
    unknown = list[str]()
    for i, row in rows.items():
        if not 0 <= i <= _HIGHEST_ID:
            raise SettingsError(f"Label space {where} has the id {i}: ids are 0 to {_HIGHEST_ID}.")
        class_names[i] = str(row.get("name", i))
        target = _target(row["to"], where, i) if "to" in row else by_name.get(plain(class_names[i]))
        targets[i] = UNLABELLED if target is None else target
        if target is None:
            unknown.append(class_names[i])
        if row.get("colour") is not None:
            colours[i] = _colour(row["colour"], where, i)
    dynamic = frozenset(
        i
        for i, row in rows.items()
        if row.get("dynamic") or (targets[i] < 19 and cityscapes().dynamic[targets[i]])
    )
    return LabelSpace(
        str(content.get("name", where)),
        class_names,
        targets,
        colours,
        dynamic,
        mask,
        tuple(unknown),
    )


def _target(value: Any, where: str, i: int) -> int:
    if value is None or value == UNLABELLED:
        return UNLABELLED
    own = cityscapes().names
    if value in own:
        return own.index(value)
    if type(value) is int and 0 <= value < len(own):
        return value
    raise SettingsError(
        f"Label space {where} maps {i} to {str(value)[:40]!r}, not a class of Cityscapes: "
        f"{', '.join(own)}, or null."
    )


def _colour(value: Any, where: str, i: int) -> tuple[int, int, int]:
    if (
        isinstance(value, list)
        and len(value) == 3
        and all(type(v) is int and 0 <= v <= 255 for v in value)
    ):
        return value[0], value[1], value[2]
    raise SettingsError(
        f"Label space {where} gives {i} the colour {str(value)[:40]!r}: it has to be [red, green, "
        "blue], each 0 to 255."
    )


# -- by name


def plain(name: str) -> str:
    """A class name without what writers disagree on: lower case, words with one space between."""
    return " ".join(re.findall(r"[a-z0-9]+", name.lower()))


@cache
def trains_by_name() -> Mapping[str, int]:
    """Train ids by :func:`plain` name.

    The classes, their synonyms (schemas/label_names.yaml), the names of the shipped spaces.
    """
    own = cityscapes().names
    known = {plain(n): i for i, n in enumerate(own)}
    for name, others in yaml.safe_load(read_text("label_names.yaml")).items():
        for other in (name, *others):
            known.setdefault(plain(other), own.index(name) if name in own else UNLABELLED)
    shipped = [
        (plain(n), s.targets[i]) for s in map(_shipped, spaces()) for i, n in s.names.items()
    ]
    # a space that knows the class before one that leaves it out
    for n, target in sorted(shipped, key=lambda row: row[1] == UNLABELLED):
        known.setdefault(n, target)
    return known


def space_of_names(classes: Mapping[int, str], name: str) -> LabelSpace:
    """The space of a list of class names.

    Of a path such as ``construction--flat--road`` the last part that is known counts. Ids below 0
    or above 65535, which only a damaged log gives, have no meaning and are among the unknown.
    """
    targets = dict[int, int]()
    unknown = list[str]()
    for i, given in classes.items():
        if not 0 <= i <= _HIGHEST_ID:
            unknown.append(given)
            continue
        parts = [given, *reversed(re.split(r"--|[./:]", given))]
        target = next((t for p in parts if (t := trains_by_name().get(plain(p))) is not None), None)
        targets[i] = UNLABELLED if target is None else target
        if target is None and plain(given):
            unknown.append(given)
    dynamic = frozenset(i for i, t in targets.items() if t < 19 and cityscapes().dynamic[t])
    return LabelSpace(name, dict(classes), targets, {}, dynamic, unknown=tuple(unknown))


# -- of a log that does not name its space


def to_cityscapes(ids: NDArray[np.integer], space: str) -> U8:
    """Train ids (n,) of the ids of a log; 255 where the space does not map them.

    SettingsError for an unknown space.
    """
    return read_space(space).train_ids(ids)


def guess_space(ids: NDArray[np.integer]) -> str:
    """The label space that a log's ids look like.

    SemanticKITTI has ids above 18 and instances, Cityscapes none but 255.
    """
    every = np.unique(np.asarray(ids, np.int64))
    low = set((every & 0xFFFF).tolist()) - {UNLABELLED}
    instances = bool((every > 0xFFFF).any())
    if not instances and max(low, default=0) <= 18:
        return "cityscapes"
    # the full ids of Cityscapes end at 33, and most of the ids that occur on a street are not ids
    # of SemanticKITTI
    full = not instances and max(low) <= 33 and len(low - set(_shipped("semantickitti").names)) > 1
    return "cityscapes_ids" if full else "semantickitti"


def guess_palette(colours: Mapping[int, int]) -> str | None:
    """The shipped space whose palette knows most pixels of ``colours`` (packed colour -> count).

    None if none knows half of them.
    """
    total = sum(n for colour, n in colours.items() if colour)
    ranked = sorted(
        spaces(),
        key=lambda name: (-_pixels_known(name, colours), not name.startswith("cityscapes"), name),
    )
    return ranked[0] if total and 2 * _pixels_known(ranked[0], colours) >= total else None


def _pixels_known(name: str, colours: Mapping[int, int]) -> int:
    palette: Iterable[tuple[int, int, int]] = _shipped(name).colours.values()
    return sum(colours.get(c[0] << 16 | c[1] << 8 | c[2], 0) for c in set(palette) if any(c))

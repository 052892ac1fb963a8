"""Label spaces: ids of a log -> Cityscapes train ids, and their coarse common set."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import yaml
from numpy.typing import NDArray

from semloc_logs.errors import SettingsError
from semloc_logs.schemas import names, read_text

UNLABELLED = 255
SKY = 10
ROAD, SIDEWALK, BUILDING, POLE, VEGETATION, TERRAIN = 0, 1, 2, 5, 8, 9
GROUND = (ROAD, SIDEWALK, TERRAIN)

U8 = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Cityscapes:
    """The label space of every map: names and RGB colours by train id, which are dynamic, and the coarse set (id -> index)."""

    names: tuple[str, ...]
    colours: U8
    dynamic: NDArray[np.bool_]
    coarse: U8  # (256,), 255 where unlabelled
    coarse_names: tuple[str, ...]


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
    """Names of the label spaces that can be read."""
    return list(names("label_spaces", ".yaml"))


def to_cityscapes(ids: NDArray[np.integer], space: str) -> U8:
    """Train ids (n,) of the ids of a log; 255 where the space does not map them. Raises SettingsError for an unknown space."""
    if space not in spaces():
        raise SettingsError(f"Unknown label space '{space}': there are {', '.join(spaces())}.")
    if space == "cityscapes":
        known = np.asarray(ids)
        return np.where((known >= 0) & (known < len(cityscapes().names)), known, UNLABELLED).astype(np.uint8)
    content = yaml.safe_load(read_text(f"label_spaces/{space}.yaml"))
    values, inverse = np.unique(np.asarray(ids, np.int64) & content.get("mask", 0xFFFFFFFF), return_inverse=True)
    table = np.array([content["to_cityscapes"].get(int(v), UNLABELLED) for v in values], np.uint8)
    return table[inverse].reshape(np.shape(ids))


def guess_space(ids: NDArray[np.integer]) -> str:
    """The label space that a log's ids look like: SemanticKITTI has ids above 18 and instances, Cityscapes none but 255."""
    every = np.unique(np.asarray(ids, np.int64))
    low, instances = every & 0xFFFF, bool((every > 0xFFFF).any())
    return "semantickitti" if instances or bool(((low > 18) & (low != UNLABELLED)).any()) else "cityscapes"

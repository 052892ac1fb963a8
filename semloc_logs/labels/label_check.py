"""Whether recorded ids are classes: numbers of clusters and instances look like ids of classes.

Three checks, of a few pairs of keyframes: the label space knows the ids; a place has the same id
in one sweep as in the next; the classes of the ground lie on the ground that the geometry shows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import I64, U8
from semloc_logs.labels.from_geometry import LEAST_ON_GROUND, ON_GROUND, VOXEL
from semloc_logs.labels.space import GROUND, UNLABELLED
from semloc_logs.labels.sweep_ground import ground_surface

# share of the points whose ids a space has: every shipped space describes all ids of its data set
LEAST_KNOWN = 0.9
# a space that the log itself gives may leave out ids of what does not matter, but not most points
LEAST_OF_LOG = 0.5
# agreement of two sweeps beyond chance (Cohen's kappa): simulated drives with 15 to 30 % of wrong
# labels have 0.37 to 0.63, numbers that are given anew in each sweep 0
LEAST_AGREEMENT = 0.15
# share of the ground that is labelled as ground, and of a ground class that lies near the ground
LEAST_GROUND = 0.3
LEAST_ON_ITS_GROUND = 0.2
# where most points are labelled, one class for all of them tells nothing if so much of it lies on
# the ground, and so much above it
LEAST_LABELLED, LEAST_APART = 0.5, 0.1
# m at street scale: slopes, kerbs and the errors of the ground's estimate are lower
NEAR_GROUND = 0.5
_FEWEST = 300  # points, or cells, that a share is taken of
_SINGLE_CLASS = 0.95  # agreement by chance beyond which there is nothing to compare
_CELL_BITS = 20  # of a cell's number along each axis


class LabelCheck:
    """Collects the labels of a topic, keyframe by keyframe; ``scale``: voxel size over 0.30 m."""

    def __init__(self, scale: float) -> None:
        self._scale = scale
        self._of_class = np.zeros((256, 2), np.int64)  # points by class: far from and near ground
        self._ground = np.zeros(2, np.int64)  # labelled points of the ground: other, ground class
        self._cells: dict[int, int] | None = None
        self._pairs: list[tuple[int, int]] = []

    def add(
        self,
        points: NDArray[np.floating],
        origin: NDArray[np.floating],
        ids: NDArray[np.integer],
        classes: U8,
        *,
        follows: bool,
    ) -> None:
        """Level ``points`` (n, 3) in the map, seen from ``origin`` (3,); recorded ``ids`` (n,).

        ``classes`` (n,): train ids of the ids. ``follows``: the keyframe before was taken nearby.
        """
        p = np.asarray(points, np.float64)
        ground = ground_surface(p, np.asarray(origin, np.float64), self._scale)
        height = np.abs(p[:, 2] - ground.height_at(p[:, :2]))
        is_labelled = classes != UNLABELLED
        is_near = height < NEAR_GROUND * self._scale
        np.add.at(self._of_class, (classes, is_near.astype(np.int64)), 1)

        is_low = height < max(ON_GROUND * self._scale, LEAST_ON_GROUND)
        on_ground = np.isin(classes[is_low & is_labelled], GROUND)
        self._ground += [int((~on_ground).sum()), int(on_ground.sum())]

        standing = is_labelled & ~is_near
        cells = _majority(p[standing] / (VOXEL * self._scale), np.asarray(ids)[standing])
        if follows and self._cells is not None:
            both = self._cells.keys() & cells.keys()
            self._pairs += [(self._cells[cell], cells[cell]) for cell in sorted(both)]
        self._cells = cells

    def doubt(self) -> str:
        """Why the ids are not classes, as the end of a sentence; "" where nothing tells so."""
        agreement = self.agreement()
        if agreement is not None and agreement < LEAST_AGREEMENT:
            return (
                f"the same place has other ids from sweep to sweep (agreement beyond chance "
                f"{max(agreement, 0.0):.2f}), as numbers of clusters or instances do"
            )
        other, same = self._ground.tolist()
        if other + same >= _FEWEST and same < LEAST_GROUND * (other + same):
            return (
                f"as classes they do not fit the geometry: {same / (other + same):.0%} of the "
                f"labelled ground has the class of a ground"
            )
        total = int(self._of_class[:UNLABELLED].sum())
        if total >= max(_FEWEST, LEAST_LABELLED * int(self._of_class.sum())):
            single = self._of_class[int(np.argmax(self._of_class[:UNLABELLED].sum(1)))]
            if single.sum() > _SINGLE_CLASS * total and single.min() > LEAST_APART * single.sum():
                return (
                    f"{single.sum() / total:.0%} of the labelled points have one class, on the "
                    f"ground and above it alike"
                )
        for label in GROUND:
            far, near_ground = self._of_class[label].tolist()
            is_much = far + near_ground >= max(_FEWEST, 0.02 * total)
            if is_much and near_ground < LEAST_ON_ITS_GROUND * (far + near_ground):
                return (
                    f"as classes they do not fit the geometry: {far / (far + near_ground):.0%} of "
                    f"the points of a ground class lie away from the ground"
                )
        return ""

    def agreement(self) -> float | None:
        """Cohen's kappa of the ids of places in two sweeps; None where it has no meaning."""
        if len(self._pairs) < _FEWEST:
            return None
        pairs = np.array(self._pairs, np.int64)
        _, numbers = np.unique(pairs, return_inverse=True)
        numbers = numbers.reshape(pairs.shape)
        first, second = (np.bincount(numbers[:, k], minlength=numbers.max() + 1) for k in (0, 1))
        chance = float((first / len(pairs)) @ (second / len(pairs)))
        if chance > _SINGLE_CLASS:
            return None
        return (float((pairs[:, 0] == pairs[:, 1]).mean()) - chance) / (1.0 - chance)


def _majority(scaled: NDArray[np.float64], ids: NDArray[np.integer]) -> dict[int, int]:
    """The most frequent id by cell of points (n, 3), given in cells."""
    ijk = np.floor(scaled).astype(np.int64) & ((1 << _CELL_BITS) - 1)
    cell: I64 = (ijk[:, 0] << 2 * _CELL_BITS) | (ijk[:, 1] << _CELL_BITS) | ijk[:, 2]
    pairs, counts = np.unique(
        np.stack([cell, ids.astype(np.int64)], axis=1), axis=0, return_counts=True
    )
    order = np.argsort(counts, kind="stable")  # the most frequent one of a cell is entered last
    return dict(zip(pairs[order, 0].tolist(), pairs[order, 1].tolist(), strict=True))

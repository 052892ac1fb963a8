"""Subvolumes to look at, as in figure 3 of the paper: rows of input, output and truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semloc_logs.arrays import U8
from semloc_logs.pictures.boxes import draw_boxes
from semloc_logs.pictures.colours import class_legend
from semloc_logs.pictures.sheet import Lettering, Panel, Sheet
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE


def draw_completions(path: Path, variant: str, given: U8, predicted: U8, truth: U8) -> None:
    """PNG with a row for each subvolume: voxel states (n, 32, 32, 32) of input, output and truth.

    Voxels that the truth did not observe are left out of the output too: they cannot be compared.
    """
    shown = np.where(truth == UNOBSERVED_STATE, UNOBSERVED_STATE, predicted)
    names = ("input", f"output, {variant}", "truth")
    rows = [
        [
            Panel(draw_boxes(state[k]), name if k == 0 else "")
            for name, state in zip(names, (given, shown, truth), strict=True)
        ]
        for k in range(len(truth))
    ]
    states = np.concatenate([given, shown, truth])
    occupied = states[(states != FREE_STATE) & (states != UNOBSERVED_STATE)]
    lettering = Lettering("Completion of subvolumes", legend=class_legend(occupied))
    Sheet(rows, lettering).save(path)

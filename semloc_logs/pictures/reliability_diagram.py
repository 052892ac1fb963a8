"""The reliability diagram of a calibration: how often alignments are right against how probable
they were said to be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from semloc_logs.tables.atomic_files import replacing_file

SIZE, MARGIN = 720, 80  # px
COLOURS = ((120, 120, 120), (214, 120, 20), (20, 90, 200))  # RGB
INK = (40, 40, 40)
GRID = (225, 225, 225)
LETTERS = cv2.FONT_HERSHEY_SIMPLEX
TICKS = (0.001, 0.01, 0.1, 0.5, 0.9, 0.99, 0.999)


def _pixel(p: float) -> float:
    """Share of the axis in [0, 1] at a probability: log-odds from 0.0005 to 0.9995."""
    end = np.log(0.9995 / 0.0005)
    p = float(np.clip(p, 0.0005, 0.9995))
    return float((np.log(p / (1 - p)) + end) / (2 * end))


def draw_reliability(path: Path, curves: Mapping[str, Sequence[Mapping[str, float]]]) -> None:
    """PNG with one line for each of the ``curves``, of bins with ``said``, ``right`` and
    ``alignments``; axes are log-odds.

    The vertical strokes are one standard deviation of a binomial share (Agresti and Coull, 1998,
    with two added to either side).
    """
    image = np.full((SIZE + 2 * MARGIN, SIZE + 2 * MARGIN, 3), 255, np.uint8)

    def at(said: float, right: float) -> tuple[int, int]:
        return MARGIN + round(SIZE * _pixel(said)), MARGIN + round(SIZE * (1 - _pixel(right)))

    for tick in TICKS:
        cv2.line(image, at(tick, 0), at(tick, 1), GRID, 1)
        cv2.line(image, at(0, tick), at(1, tick), GRID, 1)
        x, y = at(tick, tick)
        cv2.putText(
            image, f"{tick:g}", (x - 20, MARGIN + SIZE + 25), LETTERS, 0.5, INK, 1, cv2.LINE_AA
        )
        cv2.putText(image, f"{tick:g}", (MARGIN - 55, y + 5), LETTERS, 0.5, INK, 1, cv2.LINE_AA)
    cv2.line(image, at(0, 0), at(1, 1), INK, 1, cv2.LINE_AA)
    for number, ((name, bins), colour) in enumerate(zip(curves.items(), COLOURS, strict=False)):
        points = [at(b["said"], b["right"]) for b in bins]
        cv2.polylines(
            image, [np.array(points, np.int32).reshape(-1, 1, 2)], False, colour, 2, cv2.LINE_AA
        )
        for b, point in zip(bins, points, strict=True):
            n = b["alignments"] + 4
            share = (b["right"] * b["alignments"] + 2) / n
            spread = float(np.sqrt(share * (1 - share) / n))
            cv2.line(
                image,
                at(b["said"], share - spread),
                at(b["said"], share + spread),
                colour,
                1,
                cv2.LINE_AA,
            )
            cv2.circle(image, point, 5, colour, -1, cv2.LINE_AA)
            cv2.putText(
                image,
                f"{b['alignments']:.0f}",
                (point[0] + 8, point[1] + 14),
                LETTERS,
                0.4,
                colour,
                1,
                cv2.LINE_AA,
            )
        cv2.putText(
            image,
            name,
            (MARGIN + 15, MARGIN + 25 + 25 * number),
            LETTERS,
            0.65,
            colour,
            2,
            cv2.LINE_AA,
        )
    cv2.putText(
        image,
        "probability said",
        (MARGIN + SIZE // 2 - 70, SIZE + 2 * MARGIN - 20),
        LETTERS,
        0.65,
        INK,
        1,
        cv2.LINE_AA,
    )
    cv2.putText(
        image,
        "share right; numbers: alignments",
        (15, MARGIN - 30),
        LETTERS,
        0.65,
        INK,
        1,
        cv2.LINE_AA,
    )
    with replacing_file(path) as temporary:
        temporary.write_bytes(
            cv2.imencode(".png", np.ascontiguousarray(image[:, :, ::-1]))[1].tobytes()
        )

"""What is drawn and written onto a picture of a map: the drive, a scale bar, axes, a title and a
legend.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

NARROWEST = 900  # pixels, so that title and legend fit
FONT = cv2.FONT_HERSHEY_SIMPLEX
INK = (35, 35, 40)
SOFT = (95, 95, 105)
WHITE = (255, 255, 255)

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
Colour = Sequence[int]


class Sheet:
    """A picture of a map with room around it. All sizes follow the width, so that a large picture
    has large letters.
    """

    def __init__(self, picture: U8) -> None:
        height, width = picture.shape[:2]
        self._scale: float = max(1.0, max(height, width) / 1400)
        self._pad = self._px(24)
        left = max(0, self._px(NARROWEST) - width) // 2 + self._pad
        self._left = left
        self.image = np.full((height + self._px(96), width + 2 * left, 3), 255, np.uint8)
        self._top = self._px(96)
        self.image[self._top :, left : left + width] = picture

    def _px(self, size: float) -> int:
        return round(size * self._scale)

    def _write(
        self, text: str, at: tuple[int, int], size: float, colour: Colour = INK, weight: int = 1
    ) -> int:
        """Text with its base line at ``at``; returns its width."""
        scale = size * self._scale
        thick = max(1, round(weight * self._scale))
        cv2.putText(self.image, text, at, FONT, scale, tuple(colour), thick, cv2.LINE_AA)
        return self._width(text, size, weight)

    def _width(self, text: str, size: float, weight: int = 1) -> int:
        return int(
            cv2.getTextSize(text, FONT, size * self._scale, max(1, round(weight * self._scale)))[0][
                0
            ]
        )

    def drive(self, line: F64, colour: Colour, start: Colour) -> None:
        """The drive (n, 2) in pixels of the picture, arrows along it, and where it starts and ends."""
        if not len(line):
            return
        line = line + np.array([self._left, self._top])
        fixed = np.round(line * 16).astype(np.int32).reshape(-1, 1, 2)
        for width, shade in ((6, WHITE), (3, colour)):
            cv2.polylines(self.image, [fixed], False, tuple(shade), self._px(width), cv2.LINE_AA, 4)
        self._arrows(line, colour)
        if np.linalg.norm(line[-1] - line[0]) > self._px(30):
            self._marker(line[-1], colour, "end")
        self._marker(line[0], start, "start")

    def _arrows(self, line: F64, colour: Colour) -> None:
        along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
        every = self._px(130)
        size = self._px(9)
        for at in np.arange(every / 2, along[-1], every):
            here, before = (
                np.array([np.interp(s, along, line[:, k]) for k in (0, 1)])
                for s in (at, max(0.0, at - size))
            )
            if (length := float(np.linalg.norm(here - before))) < 1e-6:
                continue
            ahead = (here - before) / length * size
            side = np.array([-ahead[1], ahead[0]]) * 0.75
            shape = np.round(
                np.stack([here + ahead, here - ahead * 0.6 + side, here - ahead * 0.6 - side]) * 16
            ).astype(np.int32)
            cv2.fillPoly(self.image, [shape], tuple(colour), cv2.LINE_AA, 4)
            cv2.polylines(
                self.image,
                [shape.reshape(-1, 1, 2)],
                True,
                WHITE,
                max(1, self._px(1)),
                cv2.LINE_AA,
                4,
            )

    def _marker(self, at: F64, colour: Colour, text: str) -> None:
        centre = (round(at[0]), round(at[1]))
        radius = self._px(8)
        cv2.circle(self.image, centre, radius + self._px(2), WHITE, -1, cv2.LINE_AA)
        cv2.circle(self.image, centre, radius, tuple(colour), -1, cv2.LINE_AA)
        corner = (centre[0] + radius + self._px(5), centre[1] + self._px(5))
        low = (corner[0] - self._px(3), corner[1] - self._px(15))
        cv2.rectangle(
            self.image,
            low,
            (corner[0] + self._width(text, 0.55) + self._px(3), corner[1] + self._px(6)),
            WHITE,
            -1,
        )
        self._write(text, corner, 0.55, colour)

    def finish(
        self, title: str, facts: Sequence[str], legend: Sequence[tuple[str, Colour]], metres: float
    ) -> U8:
        """The whole sheet, RGB; a pixel of the picture is ``metres`` wide."""
        self._write(_plain(title), (self._pad, self._px(44)), 0.95, INK, 2)
        self._write("  |  ".join(_plain(f) for f in facts), (self._pad, self._px(76)), 0.5, SOFT)
        room = self.image.shape[1] - 2 * self._pad
        rows: list[list[tuple[str, Colour]]] = [[]]
        used = 0
        for name, colour in legend:
            need = self._width(name, 0.5) + self._px(52)
            if rows[-1] and used + need > room:
                rows.append([])
                used = 0
            rows[-1].append((name, colour))
            used += need
        top = self.image.shape[0]
        self.image = np.concatenate(
            [
                self.image,
                np.full((self._px(82 + 30 * len(rows)), self.image.shape[1], 3), 255, np.uint8),
            ]
        )
        self._scale_bar(metres, top + self._px(30))
        self._axes(top + self._px(46))
        for k, row in enumerate(rows):
            x = self._pad
            y = top + self._px(76 + 30 * k)
            for name, colour in row:
                cv2.rectangle(
                    self.image,
                    (x, y),
                    (x + self._px(20), y + self._px(16)),
                    tuple(int(c) for c in colour),
                    -1,
                )
                cv2.rectangle(self.image, (x, y), (x + self._px(20), y + self._px(16)), SOFT, 1)
                x += self._px(52) + self._write(name, (x + self._px(28), y + self._px(14)), 0.5)
        return self.image

    def _scale_bar(self, metres: float, y: int) -> None:
        wanted = self._px(260) * metres
        length = max(m * 10.0**e for e in range(-3, 7) for m in (1, 2, 5) if m * 10.0**e <= wanted)
        x = self._pad
        width = round(length / metres)
        high = self._px(7)
        for k in range(4):
            a = x + width * k // 4
            b = x + width * (k + 1) // 4
            cv2.rectangle(self.image, (a, y), (b, y + high), INK if k % 2 == 0 else WHITE, -1)
        cv2.rectangle(self.image, (x, y), (x + width, y + high), INK, max(1, self._px(1)))
        self._write("0", (x, y - self._px(6)), 0.5)
        text = f"{length:g} m" if length < 1000 else f"{length / 1000:g} km"
        self._write(
            text,
            (
                x
                + width
                - self._width(f"{length:g}" if length < 1000 else f"{length / 1000:g}", 0.5),
                y - self._px(6),
            ),
            0.5,
        )

    def _axes(self, y: int) -> None:
        """x to the right, y up: the map frame has no north."""
        x = self.image.shape[1] - self._pad - self._px(70)
        length = self._px(34)
        for dx, dy, name in ((1, 0, "x"), (0, -1, "y")):
            tip = (x + dx * length, y + dy * length)
            cv2.arrowedLine(
                self.image, (x, y), tip, INK, max(1, self._px(1.6)), cv2.LINE_AA, 0, 0.28
            )
            self._write(
                name,
                (
                    tip[0] + (self._px(6) if dx else -self._px(16)),
                    tip[1] + (self._px(5) if dx else self._px(8)),
                ),
                0.5,
            )


def _plain(text: str) -> str:
    """What the font has letters for."""
    return "".join(c if " " <= c <= "~" else "?" for c in text)

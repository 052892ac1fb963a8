"""Local features of pictures with the settings of supplement 1: SIFT, DSP-SIFT, MSER, dense SIFT.

Detectors and descriptors are OpenCV's. Descriptors are RootSIFT (Arandjelovic and Zisserman, CVPR
2012): the Euclidean distance of their roots is the Hellinger distance. They are upright, as the
input is level.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32, U8

LAYERS = 3  # scales in an octave
PEAK = 0.02  # OpenCV divides it by the layers
EDGE = 10.0
FIRST_SIGMA = 1.6
FIRST_OCTAVE, OCTAVES = -1, 4  # the first octave holds the picture at twice its size
DOMAINS = np.linspace(1 / 6, 3, 10)  # pooling scales of DSP-SIFT (Dong and Soatto, CVPR 2015)
MOST_FEATURES = 4000  # of a picture: the strongest; of regions, which have no strength, any
# the paper's step of 2, areas and variation are the defaults of a function that gives the step in
# percent of the range: 5 of 255 levels
MSER_STEP, MSER_AREA, MSER_VARIATION = 5, (30, 14000), 0.25
# nested regions differ by this share of their area at least: with OpenCV's 0.2 a street picture has
# a tenth of the regions, too few for 15 inliers
MSER_DIVERSITY = 0.05
DENSE_STEP = 8  # pixels between the places of dense features
DENSE_BINS = (4.0, 6.0, 8.0, 10.0)  # pixels: widths of their spatial bins (Torii et al. 2015)
BIN_OF_SIZE = 1.5  # width of a spatial bin in units of a keypoint's size


class Features(NamedTuple):
    """``xy`` (n, 2) pixels and RootSIFT ``descriptor`` (n, 128) in 1/255 of the unit vector."""

    xy: F32
    descriptor: U8

    def vectors(self) -> F32:
        """Unit descriptors (n, 128)."""
        return unit_descriptors(self.descriptor)


def unit_descriptors(descriptor: U8) -> F32:
    """Descriptors (n, 128) in bytes as unit vectors; of nothing zeros."""
    out = descriptor.astype(np.float32)
    return np.asarray(out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9))


def sift(image: U8) -> Features:
    """SIFT at its own points."""
    grey = _grey(image)
    return _described(grey, sift_points(grey))


def dsp_sift(image: U8) -> Features:
    """SIFT points, their descriptors pooled over domains of different size."""
    grey = _grey(image)
    return _pooled(grey, sift_points(grey))


def mser_dsp_sift(image: U8) -> Features:
    """Maximally stable regions as circles of their area, with DSP-SIFT. The diameter of the circle
    is the size of the point.
    """
    grey = _grey(image)
    detector = cv2.MSER.create(
        delta=MSER_STEP,
        min_area=MSER_AREA[0],
        max_area=MSER_AREA[1],
        max_variation=MSER_VARIATION,
        min_diversity=MSER_DIVERSITY,
    )
    regions, _ = detector.detectRegions(grey)
    points = []
    for region in regions:
        x, y = np.mean(region, axis=0).tolist()
        points.append(keypoint(x, y, 2 * float(np.sqrt(len(region) / np.pi))))
    distinct = _distinct(points)
    kept = np.random.default_rng(0).permutation(len(distinct))[:MOST_FEATURES]
    return _pooled(grey, [distinct[k] for k in np.sort(kept)])


def dense_sift(image: U8, step: int = DENSE_STEP) -> Features:
    """SIFT on a grid at four scales, upright."""
    grey = _grey(image)
    height, width = grey.shape
    border = int(2 * DENSE_BINS[-1])
    if min(height, width) <= 2 * border:
        border = 0
    x, y = np.meshgrid(
        np.arange(border, width - border, step), np.arange(border, height - border, step)
    )
    points = [
        keypoint(float(u), float(v), size / BIN_OF_SIZE)
        for size in DENSE_BINS
        for u, v in zip(x.ravel(), y.ravel(), strict=True)
    ]
    return _described(grey, points)


def sift_points(grey: U8) -> list[cv2.KeyPoint]:
    """Points of SIFT in the octaves of the settings, upright, the strongest."""
    key_points = _sift().detect(grey, None)
    key_points = [p for p in key_points if FIRST_OCTAVE <= _octave(p) < FIRST_OCTAVE + OCTAVES]
    for p in key_points:
        p.angle = 0.0
    # a point with several orientations was found several times
    key_points.sort(key=lambda p: (-p.response, p.pt, p.size))
    return _distinct(key_points)[:MOST_FEATURES]


def keypoint(x: float, y: float, size: float) -> cv2.KeyPoint:
    """An upright point of ``size`` pixels, in the level of the pyramid that has its blur."""
    level = round(LAYERS * np.log2(max(size, 1e-6) / (2 * FIRST_SIGMA)))
    octave = (level - 1) // LAYERS
    layer = level - LAYERS * octave
    if octave < FIRST_OCTAVE:
        octave = FIRST_OCTAVE
        layer = 0
    packed = (octave & 255) | (layer << 8)
    return cv2.KeyPoint(x, y, size, 0.0, 0.0, packed)


def root_sift(descriptor: NDArray[np.floating]) -> U8:
    """RootSIFT (n, 128) in bytes of SIFT (n, 128)."""
    total = np.maximum(descriptor.sum(1, keepdims=True), 1e-9)
    return np.asarray(np.round(255 * np.sqrt(descriptor / total)), np.uint8)


def _grey(image: U8) -> U8:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image)


def _sift() -> cv2.SIFT:
    return cv2.SIFT.create(
        nOctaveLayers=LAYERS, contrastThreshold=PEAK, edgeThreshold=EDGE, sigma=FIRST_SIGMA
    )


def _octave(p: cv2.KeyPoint) -> int:
    octave = p.octave & 255
    return int(octave - 256 if octave > 127 else octave)


def _distinct(points: Sequence[cv2.KeyPoint]) -> list[cv2.KeyPoint]:
    """The first of the points of one place and size."""
    return list({(p.pt, p.size): p for p in reversed(points)}.values())[::-1]


def _raw(grey: U8, points: Sequence[cv2.KeyPoint]) -> F32:
    """SIFT (n, 128) of points."""
    if not points:
        return np.zeros((0, 128), np.float32)
    _, descriptor = _sift().compute(grey, points)
    return np.asarray(descriptor, np.float32)


def _places(points: Sequence[cv2.KeyPoint]) -> F32:
    return np.array([p.pt for p in points], np.float32).reshape(-1, 2)


def _described(grey: U8, points: Sequence[cv2.KeyPoint]) -> Features:
    return Features(_places(points), root_sift(_raw(grey, points)))


def _pooled(grey: U8, points: Sequence[cv2.KeyPoint]) -> Features:
    """Descriptors that are the mean over the domain sizes."""
    scaled = [keypoint(p.pt[0], p.pt[1], p.size * float(s)) for s in DOMAINS for p in points]
    descriptor = _raw(grey, scaled).reshape(len(DOMAINS), len(points), 128)
    return Features(_places(points), root_sift(descriptor.mean(0)))

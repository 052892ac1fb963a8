"""SIFT, DSP-SIFT and MSER + DSP-SIFT of section 4.4, each with a vocabulary of its own."""

from __future__ import annotations

from semloc_logs.experiments.systems.catalogue import SystemOptions
from semloc_logs.experiments.systems.pictures.local_features import dsp_sift, mser_dsp_sift, sift
from semloc_logs.experiments.systems.pictures.picture_matching import (
    PictureSystem,
    WordRetrieval,
    features_folder,
)


def make_sift(options: SystemOptions) -> PictureSystem:
    """SIFT."""
    return PictureSystem("sift", sift, WordRetrieval(), features_folder(options))


def make_dsp_sift(options: SystemOptions) -> PictureSystem:
    """SIFT points with descriptors pooled over domain sizes."""
    return PictureSystem("dsp-sift", dsp_sift, WordRetrieval(), features_folder(options))


def make_mser(options: SystemOptions) -> PictureSystem:
    """Maximally stable extremal regions with DSP-SIFT."""
    return PictureSystem("mser", mser_dsp_sift, WordRetrieval(), features_folder(options))

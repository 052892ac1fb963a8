"""The rows of our own systems: the paper's plain method, the pipeline of today, and ablations."""

from __future__ import annotations

from pathlib import Path

from semloc_logs.errors import SettingsError
from semloc_logs.experiments.system import System
from semloc_logs.experiments.systems.ablations import ablated, with_settings
from semloc_logs.experiments.systems.catalogue import SystemOptions
from semloc_logs.experiments.systems.ours import Ours
from semloc_logs.experiments.systems.plain import METHOD, Plain, Variant
from semloc_logs.settings import Resolved, load

_VARIANTS: dict[str, Variant] = {
    "paper-semantic": "semantic",
    "paper-geometric": "geometric",
    "paper-acc": "semantic",
}
_ROWS = {  # names of rows -> names of ablations
    "ours-no-classes": "ours, words without classes",
    "ours-every-heading": "ours, every heading described",
    "ours-alone": "ours, query subvolumes alone",
    "ours-stride-4": "ours, subvolumes every 4 voxels",
    "ours-one-neighbour": "ours, one neighbour",
    "ours-no-free-space": "ours, free space ignored",
    "ours-not-refined": "ours, not refined",
    "ours-no-contrast": "ours, no contrastive term",
    "ours-64": "ours, N = 64",
    "ours-512": "ours, N = 512",
}


def make_ours(options: SystemOptions) -> System:
    """The pipeline of today."""
    return Ours(options.name, options.settings)


def make_ablation(options: SystemOptions) -> System:
    """The pipeline without one of its parts; networks of its own lie in WEIGHTS/NAME/."""
    folder = (options.weights or Path("weights")) / options.name
    return ablated(_ROWS[options.name], options.settings, folder)


def make_plain(options: SystemOptions) -> System:
    """The paper's method; its networks lie in WEIGHTS/paper/. SettingsError where they do not."""
    variant = _VARIANTS[options.name]
    return Plain(variant, _plain_settings(options, variant), name=options.name)


def _plain_settings(options: SystemOptions, variant: Variant) -> Resolved:
    """The paper's settings with its networks."""
    folder = (options.weights or Path("weights")) / METHOD
    weights = folder / f"{variant}.safetensors"
    words = folder / f"{variant}_words.safetensors"
    for path in (weights, words):
        if not path.exists():
            raise SettingsError(
                f"{path} is missing: train it with 'semloc train --method paper --variant"
                f" {variant} -o {folder}', then 'semloc vocabulary --method paper --variant"
                f" {variant} -o {words} --set descriptor.weights={weights}', and give --weights"
                f" {folder.parent}."
            )
    settings = load(method=METHOD).resolved()
    return with_settings(settings, {"descriptor.weights": weights, "descriptor.vocabulary": words})

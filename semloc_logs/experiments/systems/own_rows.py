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


def make_ours(options: SystemOptions) -> System:
    """The pipeline of today."""
    return Ours(options.name, options.settings)


def make_ablation(options: SystemOptions) -> System:
    """The pipeline without one of its parts; networks of its own lie in WEIGHTS/NAME/."""
    folder = (options.weights or Path("weights")) / options.name
    return ablated(options.name, options.settings, folder)


def make_plain(options: SystemOptions) -> System:
    """The paper's method, with the networks in WEIGHTS/paper/ or, without any weights, the shipped
    ones. SettingsError where one of the files is missing.
    """
    variant = _VARIANTS[options.name]
    kept = options.folder.parent / f"{METHOD}-{variant}"  # also for acc.
    return Plain(variant, _plain_settings(options, variant), name=options.name, kept=kept)


def _plain_settings(options: SystemOptions, variant: Variant) -> Resolved:
    """The paper's settings with its networks."""
    settings = load(method=METHOD).resolved()
    folder = (options.weights or Path("weights")) / METHOD
    if options.weights is None and not folder.exists():
        return settings
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
    return with_settings(settings, {"descriptor.weights": weights, "descriptor.vocabulary": words})

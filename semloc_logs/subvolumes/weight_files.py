"""Weights of the network as files: bf16 tensors with a model card, in safetensors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from importlib.resources import as_file, files
from pathlib import Path
from typing import TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import nn

from semloc_logs.errors import SettingsError
from semloc_logs.subvolumes.network import Network
from semloc_logs.tables.atomic_files import replacing_file

Loaded = TypeVar("Loaded", bound=nn.Module)


def save_weights(path: Path, model: Network, card: dict[str, str]) -> None:
    """The network in bf16 with a model card in the file's metadata."""
    tensors = {
        k: v.to("cpu", torch.bfloat16).contiguous()
        for k, v in model.state_dict().items()
        if v.is_floating_point()
    }
    with replacing_file(path) as temporary:
        save_file(tensors, temporary, metadata={**card, "variant": model.encoder.variant})


@contextmanager
def weights_file(name: str, weights: Path | None = None) -> Iterator[Path]:
    """The file of ``weights``, or of the shipped ones with this name."""
    shipped = files("semloc_logs.subvolumes") / "weights" / f"{name}.safetensors"
    with nullcontext(weights) if weights is not None else as_file(shipped) as path:
        yield path


def samples_of(name: str, weights: Path | None = None) -> str | None:
    """How many subvolumes the training of weights has seen, by their card."""
    with weights_file(name, weights) as path, safe_open(path, "pt") as file:
        samples: str | None = (file.metadata() or {}).get("samples")
    return samples


def load_weights(
    build: Callable[[str, int], Loaded], part: str, variant: str, weights: Path | None = None
) -> Loaded:
    """The network that ``build(variant, latent)`` makes, with shipped weights or weights of a file.

    ``part`` is ``encoder.`` for the encoder alone, empty for all. SettingsError when the file does
    not hold them.
    """
    try:
        with weights_file(variant, weights) as path:
            tensors = load_file(path)
        network = build(variant, len(tensors["encoder.log_variance.bias"]))
        network.load_state_dict(
            {k.removeprefix(part): v.float() for k, v in tensors.items() if k.startswith(part)}
        )
    except (OSError, SafetensorError, KeyError, RuntimeError) as problem:
        reason = str(problem).splitlines()[0]
        raise SettingsError(
            f"{weights or 'The shipped weights'}: no weights of the {variant} "
            f"{part.strip('.') or 'network'} ({reason})."
        ) from None
    return network.eval()

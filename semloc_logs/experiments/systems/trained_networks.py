"""Networks of the baselines: trained once, and kept in a file."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from semloc_logs.experiments.kept_files import kept_file
from semloc_logs.experiments.system import View

KEYED = 64  # views that a key is made of: reading all of them takes long


def key_of(views: Sequence[View], *settings: object) -> str:
    """A key of the views that something is learnt from, by some of them, and of how."""
    content = hashlib.sha256(repr((len(views), settings)).encode())
    for number in np.unique(np.linspace(0, len(views) - 1, KEYED).astype(int)):
        view = views[number]
        content.update(f"{view.session} {view.stamp_ns}".encode() + view.world_T_base.tobytes())
    return content.hexdigest()[:16]


def trained(path: Path, network: nn.Module, train: Callable[[], None]) -> None:
    """Load the weights of ``network`` from the file ``path``, or ``train`` it and write them.

    Training begins with the same random weights every time.
    """
    torch.set_num_threads(1)

    def make(temporary: Path) -> None:
        network.train()
        torch.manual_seed(0)
        network.apply(_begin_anew)
        train()
        weights = {name: value.contiguous() for name, value in network.state_dict().items()}
        save_file(weights, temporary)

    kept_file(path, make)
    try:
        network.load_state_dict(load_file(path))
    except (SafetensorError, RuntimeError):  # damaged, or of another network
        path.unlink()
        network.load_state_dict(load_file(kept_file(path, make)))
    network.eval()


def _begin_anew(module: nn.Module) -> None:
    if isinstance(module, nn.Linear | nn.Conv2d | nn.Conv3d):
        module.reset_parameters()

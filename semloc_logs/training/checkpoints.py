"""Checkpoints of a training: network, optimiser and step in one safetensors file; and finished
weights, written and read.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from semloc_logs.errors import WorkspaceError
from semloc_logs.settings import Training
from semloc_logs.subvolumes.network import Network
from semloc_logs.tables.atomic_files import replacing_file
from semloc_logs.training.schedule import open_ended


def save_checkpoint(
    path: Path, model: Network, optimiser: torch.optim.Optimizer, training: Training, step: int
) -> None:
    """What :func:`resume` needs to go on after ``step`` steps."""
    tensors = {f"model.{k}": v.contiguous() for k, v in model.state_dict().items()}
    for i, p in enumerate(model.parameters()):
        tensors |= {
            f"optimiser.{i}.{k}": v.contiguous()
            for k, v in optimiser.state.get(p, {}).items()
            if isinstance(v, Tensor)
        }
    note = {
        "step": str(step),
        "training": training.model_dump_json(),
        "variant": model.encoder.variant,
    }
    with replacing_file(path) as temporary:
        save_file(tensors, temporary, metadata=note)


def resume(path: Path, model: Network, optimiser: torch.optim.Optimizer, training: Training) -> int:
    """Put ``model`` and ``optimiser`` back to where the checkpoint was written; the number of steps
    done.

    Raises WorkspaceError when the file is damaged, or of another training or network.
    """
    try:
        with safe_open(path, "pt") as handle:
            note = handle.metadata() or {}
        tensors = load_file(path)
        step = int(note["step"])
        same_network = note.get("variant", model.encoder.variant) == model.encoder.variant
        before = Training.model_validate_json(note["training"])  # settings may be new since
        same = same_network and _goes_on(
            before.model_dump(mode="json"), training.model_dump(mode="json"), step
        )
    except (OSError, SafetensorError, KeyError, ValueError) as problem:
        raise WorkspaceError(
            f"Checkpoint {path} cannot be read ({problem}): remove it to start over."
        ) from None
    if not same:
        raise WorkspaceError(
            f"Checkpoint {path} is of a training with other settings: remove it to start over."
        )
    try:
        model.load_state_dict({k[6:]: v for k, v in tensors.items() if k.startswith("model.")})
    except RuntimeError:
        raise WorkspaceError(
            f"Checkpoint {path} is of another network: remove it to start over."
        ) from None
    for i, p in enumerate(model.parameters()):
        state = {
            k.split(".", 2)[2]: v for k, v in tensors.items() if k.startswith(f"optimiser.{i}.")
        }
        if state:
            # counters stay where they are, moments go where the parameters live
            optimiser.state[p] = {k: v if k == "step" else v.to(p.device) for k, v in state.items()}
    return step


def steps_done(path: Path) -> int:
    """Steps of the training whose checkpoint is at ``path``; 0 where there is none that can be
    read.
    """
    try:
        with safe_open(path, "pt") as handle:
            return int((handle.metadata() or {})["step"])
    except (OSError, SafetensorError, KeyError, ValueError):
        return 0


def _goes_on(before: dict[str, Any], now: dict[str, Any], step: int) -> bool:
    """Whether the training of the settings ``now`` would have come by the same ``step``.

    While the rate stays it does not matter how many samples are to be seen in all.
    """
    lengths = ("samples", "scenes")
    if {k: v for k, v in before.items() if k not in lengths} != {
        k: v for k, v in now.items() if k not in lengths
    }:
        return False
    latest = min(open_ended(Training.model_validate(settings)) for settings in (before, now))
    return before["samples"] == now["samples"] or step <= latest

"""Weights of the baselines' networks: kept in a file, and learnt anew where it is of no use."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from semloc_logs.experiments.systems.trained_networks import trained


@pytest.mark.parametrize("content", ["missing", "whole", "damaged", "of another network"])
def test_weights_are_learnt_once_and_anew_where_the_file_is_of_no_use(
    tmp_path: Path, content: str
) -> None:
    path = tmp_path / "network.safetensors"
    network = nn.Linear(2, 1)
    runs = []

    def train() -> None:
        runs.append(1)
        nn.init.constant_(network.weight, 3.0)

    if content == "whole":
        save_file({"weight": torch.full((1, 2), 5.0), "bias": torch.zeros(1)}, path)
    elif content == "damaged":
        path.write_bytes(b"half")
    elif content != "missing":
        save_file({"weight": torch.zeros(4, 4)}, path)
    for _ in range(2):
        trained(path, network, train)
        assert network.weight.tolist() == [[5.0, 5.0] if content == "whole" else [3.0, 3.0]]
    assert len(runs) == (content != "whole")


def test_a_training_that_fails_is_not_taken_for_a_damaged_file(tmp_path: Path) -> None:
    runs = []

    def train() -> None:
        runs.append(1)
        raise RuntimeError("out of memory")

    with pytest.raises(RuntimeError, match="out of memory"):
        trained(tmp_path / "network.safetensors", nn.Linear(2, 1), train)
    assert len(runs) == 1
    assert not list(tmp_path.iterdir())

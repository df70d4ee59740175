"""Tiny random OpenVLA-OFT checkpoints in the public layout."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from rn_backend_oft.components import head_shard, proprio_shard
from rn_backend_oft.constants import CONSTANTS
from rn_backend_oft.state import state_width
from rn_vla.openvla.checkpoint import OpenvlaCheckpoint
from rn_vla.openvla.tiny import STATISTICS_KEY, make_tiny, random_values, tiny_statistics


def make_tiny_oft(path: Path, *, seed: int = 0) -> None:
    """Write a checkpoint with L1 head and proprio projector (constants "libero") into the new or
    empty `path`.

    Raises:
        ConfigurationError: the directory is not empty.
    """
    import torch  # heavy

    constants = CONSTANTS["libero"]
    width = state_width(constants.state)
    make_tiny(path, seed=seed, proprio_width=width)
    statistics = {STATISTICS_KEY: tiny_statistics(width)}
    (path / "dataset_statistics.json").write_text(
        json.dumps(statistics, indent=1) + "\n", encoding="utf-8"
    )
    decoder = OpenvlaCheckpoint.read(path).decoder
    generator = np.random.default_rng(seed + 1)
    for shard in (
        head_shard(path / "action_head--1_checkpoint.pt", decoder, constants.action_width),
        proprio_shard(path / "proprio_projector--1_checkpoint.pt", decoder, width),
    ):
        tensors = {
            name: torch.from_numpy(random_values(name, weight, generator)).to(torch.bfloat16)
            for name, weight in shard.weights.items()
        }
        torch.save(tensors, shard.path)

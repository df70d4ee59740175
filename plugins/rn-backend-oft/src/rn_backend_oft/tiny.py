"""Tiny random OpenVLA-OFT checkpoints in the public layout."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rn_backend_oft.components import head_shard, proprio_shard
from rn_backend_oft.constants import CONSTANTS
from rn_backend_oft.state import state_width
from rn_vla.joint_rows import PlatformJoints
from rn_vla.openvla.checkpoint import OpenvlaCheckpoint
from rn_vla.openvla.tiny import STATISTICS_KEY, make_tiny, random_values, tiny_statistics
from roboneuron import ConfigurationError

_REACH_RAD = 0.5
"""Largest joint position of tiny policies."""


def make_tiny_oft(path: Path, *, seed: int = 0, platform: str = "libero") -> None:
    """Write a checkpoint with L1 head and proprio projector into the new or empty `path`.

    Args:
        path: destination.
        seed: seed of the random weights.
        platform: one of `CONSTANTS`.

    Raises:
        ConfigurationError: there is no such platform, or the directory is not empty.
    """
    import torch  # heavy

    if platform not in CONSTANTS:
        raise ConfigurationError(
            f"There are no constants of {platform!r}; choose one of {', '.join(CONSTANTS)}."
        )
    constants = CONSTANTS[platform]
    if constants.state == "joints":
        width = constants.action_width
        block = _joint_statistics(constants.rows())
    else:
        width = state_width(constants.state)
        block = tiny_statistics(width)
    make_tiny(path, seed=seed, proprio_width=width)
    statistics = {STATISTICS_KEY: block}
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


def _joint_statistics(rows: PlatformJoints) -> Mapping[str, object]:
    """Statistics of one data set: joints within `_REACH_RAD`, grippers 0..1."""
    high = np.where(rows.grippers, 1.0, _REACH_RAD)
    low = np.where(rows.grippers, 0.0, -_REACH_RAD)
    block = {"min": low.tolist(), "max": high.tolist(), "q01": low.tolist(), "q99": high.tolist()}
    return {"action": block, "proprio": block}

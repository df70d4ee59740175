"""Names of the tensors of a checkpoint, read from the header or the index only, without PyTorch."""

from __future__ import annotations

import json
from pathlib import Path

from rn_backend_pi0.architecture import Variant
from rn_backend_pi0.documents import Pi0ShardIndex
from rn_vla.checkpoint_files import check_safetensors, read_schema, reading

WEIGHT_FILE = "model.safetensors"
INDEX_FILE = "model.safetensors.index.json"
MAX_INDEX_BYTES = 16 * 2**20
LEROBOT_PREFIX = "model."
"""Prefix of LeRobot's keys; openpi's have none."""


def read_names(directory: Path) -> frozenset[str]:
    """Keys of all tensors, without LeRobot's prefix.

    Raises:
        CheckpointError: there are no weights, or the header or index is damaged.
    """
    index = directory / INDEX_FILE
    if index.is_symlink() or index.exists():
        keys = list(read_schema(index, Pi0ShardIndex, MAX_INDEX_BYTES).weight_map)
    else:
        path = directory / WEIGHT_FILE
        check_safetensors(path)
        with reading(path, "safetensors"), path.open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
            keys = list(dict(json.loads(file.read(length))))
    return frozenset(key.removeprefix(LEROBOT_PREFIX) for key in keys)


def variant_of(names: frozenset[str]) -> Variant:
    """The variant with these tensors; "pi0" by default."""
    return "pi05" if "time_mlp_in.weight" in names else "pi0"

"""Names of the tensors of a checkpoint, from the header or the index alone, without PyTorch."""

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
"""LeRobot's keys begin with it, openpi's do not."""


def read_names(directory: Path) -> frozenset[str]:
    """Keys of all tensors, without LeRobot's prefix.

    Raises:
        CheckpointError: there are no weights, or header or index is damaged.
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
    """Which model has such tensors; "pi0" when nothing says otherwise."""
    return "pi05" if "time_mlp_in.weight" in names else "pi0"

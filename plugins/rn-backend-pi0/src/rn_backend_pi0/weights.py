"""Loading of weights from safetensors files into a network: every tensor is checked, and only one
is in host memory at a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Protocol, cast

import torch
from safetensors import safe_open
from torch import Tensor, nn

from rn_backend_pi0.architecture import (
    EMBEDDING_KEYS,
    Pi0Dims,
    Shape,
    Variant,
    module_keys,
    optional_tensors,
    required_tensors,
)
from rn_backend_pi0.documents import Pi0ShardIndex
from rn_backend_pi0.fast_network import FastNetwork
from rn_backend_pi0.network import Pi0Network
from rn_backend_pi0.pi05_network import Pi05Network
from rn_backend_pi0.prefix import PrefixNetwork
from rn_backend_pi0.tensor_names import INDEX_FILE, LEROBOT_PREFIX, MAX_INDEX_BYTES, WEIGHT_FILE
from rn_vla.checkpoint_files import check_safetensors, clip, list_names, read_schema, reading
from roboneuron import CheckpointError, ConfigurationError

_FLOAT32 = (
    "state_proj.",
    "action_in_proj.",
    "action_time_mlp_in.",
    "action_time_mlp_out.",
    "time_mlp_in.",
    "time_mlp_out.",
    "action_out_proj.",
)
_REAL_NUMBERS = frozenset({"F64", "F32", "F16", "BF16"})
_NETWORKS: dict[Variant, type[Pi0Network] | type[Pi05Network] | type[FastNetwork]] = {
    "pi0": Pi0Network,
    "pi05": Pi05Network,
    "pi0_fast": FastNetwork,
}
_NAMES: dict[Variant, str] = {"pi0": "pi0", "pi05": "pi0.5", "pi0_fast": "pi0-FAST"}
_MARKS: dict[str, Variant] = {"action_time_mlp_in.": "pi0", "time_mlp_in.": "pi05"}
"""Variant by the prefix of keys that only it has."""


class _Slice(Protocol):
    def get_shape(self) -> list[int]: ...
    def get_dtype(self) -> str: ...


class _Shard(Protocol):
    def keys(self) -> list[str]: ...
    def get_slice(self, name: str) -> _Slice: ...
    def get_tensor(self, name: str) -> Tensor: ...


@contextmanager
def open_shards(directory: Path) -> Iterator[dict[str, tuple[_Shard, str]]]:
    """Yield the open shard and the key in it, by key without LeRobot's leading "model.".

    Raises:
        CheckpointError: a missing, truncated or damaged file, a key in two shards, or a tensor of
            integers.
    """
    index = directory / INDEX_FILE
    if index.is_symlink() or index.exists():
        shards = read_schema(index, Pi0ShardIndex, MAX_INDEX_BYTES).weight_map
        names = sorted(set(shards.values()))
    else:
        names = [WEIGHT_FILE]
    with ExitStack() as stack:
        by_key: dict[str, tuple[_Shard, str]] = {}
        for name in names:
            path = directory / name
            check_safetensors(path)
            with reading(path, "safetensors: it is truncated or damaged"):
                shard = cast(
                    "_Shard", stack.enter_context(safe_open(path, framework="pt", device="cpu"))
                )
            for key in shard.keys():  # noqa: SIM118 - not a mapping
                plain = key.removeprefix(LEROBOT_PREFIX)
                if plain in by_key:
                    raise CheckpointError(
                        f"{path} holds {clip(key)!r}, which another shard holds too."
                    )
                if shard.get_slice(key).get_dtype() not in _REAL_NUMBERS:
                    raise CheckpointError(
                        f"{path} holds {clip(key)!r} of the number type "
                        f"{shard.get_slice(key).get_dtype()}, which no "
                        "weight has."
                    )
                by_key[plain] = (shard, key)
        yield by_key


def check_keys(shapes: Mapping[str, Shape], dims: Pi0Dims) -> str:
    """Compare a checkpoint's tensors with those required by its dimensions; returns the key of the
    token embedding.

    Raises:
        CheckpointError: lists missing, unexpected and misshaped keys.
    """
    expected = required_tensors(dims)
    embedding: Shape = (dims.vocabulary, dims.prefix.width)
    allowed = expected | optional_tensors(dims) | dict.fromkeys(EMBEDDING_KEYS, embedding)
    missing = sorted(set(expected) - set(shapes))
    present = [key for key in EMBEDDING_KEYS if key in shapes]
    if not present:
        missing.append(f"{EMBEDDING_KEYS[0]} (or {EMBEDDING_KEYS[1]})")
    unexpected = sorted(set(shapes) - set(allowed))
    misshaped = [
        f"{key}: {clip(shapes[key])}, expected {allowed[key]}"
        for key in sorted(shapes)
        if key in allowed and shapes[key] != allowed[key]
    ]
    if missing or unexpected or misshaped:
        parts = [
            f"{len(names)} {word}: {list_names(names)}"
            for word, names in (
                ("missing", missing),
                ("unexpected", unexpected),
                ("misshaped", misshaped),
            )
            if names
        ]
        found = [v for mark, v in _MARKS.items() if any(n.startswith(mark) for n in unexpected)]
        said = f"config.json says {_NAMES[dims.variant]}"
        hint = f"These look like the keys of {_NAMES[found[0]]}, {said}." if found else ""
        raise CheckpointError(
            f"The weights do not fit a {_NAMES[dims.variant]} model of these dimensions. "
            f"{'. '.join(parts)}.",
            hint=hint,
        )
    return present[0]


def load_network(
    directory: Path, dims: Pi0Dims, *, device: torch.device, dtype: torch.dtype
) -> PrefixNetwork:
    """Create the network and load its weights.

    Args:
        directory: holds model.safetensors, or shards and their index.
        dims: dimensions of the model.
        device, dtype: device and number type of the weights; norms and the projections at the
            border stay float32.

    Raises:
        CheckpointError: keys or shapes do not fit, or a value is not finite.
        ConfigurationError: the device has not enough memory.
    """
    try:
        with open_shards(directory) as shards:
            shapes = {
                key: tuple(shard.get_slice(full).get_shape())
                for key, (shard, full) in shards.items()
            }
            embedding = check_keys(shapes, dims)
            with torch.device("meta"):
                network = _NETWORKS[dims.variant](dims)
            names = {
                key: name
                for name, key in (module_keys(dims) | {"embedding.weight": embedding}).items()
            }
            for key, (shard, full) in shards.items():
                tensor = shard.get_tensor(full)
                if not tensor.is_floating_point() or not bool(torch.isfinite(tensor).all()):
                    raise CheckpointError(
                        f"{directory}: {key!r} ({tensor.dtype}) holds values that are not finite "
                        "numbers."
                    )
                # the others, such as the expert's head, are never read by inference
                if key in names:
                    name = names[key]
                    _assign(
                        network,
                        name,
                        tensor.to(device=device, dtype=_dtype_of(name, dtype), copy=True),
                    )
    except torch.OutOfMemoryError as error:
        raise ConfigurationError(
            f"{device} has not enough free memory for the weights in {directory}.",
            hint="Free it, choose dtype = 'bfloat16', or another device.",
        ) from error
    left = [name for name, parameter in network.named_parameters() if parameter.is_meta]
    assert not left, left
    return network.eval()


def _dtype_of(name: str, dtype: torch.dtype) -> torch.dtype:
    return torch.float32 if name.startswith(_FLOAT32) or _is_rms_norm(name) else dtype


def _is_rms_norm(name: str) -> bool:
    return name.startswith(("prefix.", "expert.")) and "norm" in name


def _assign(network: nn.Module, name: str, tensor: Tensor) -> None:
    path, _, leaf = name.rpartition(".")
    setattr(network.get_submodule(path), leaf, nn.Parameter(tensor, requires_grad=False))

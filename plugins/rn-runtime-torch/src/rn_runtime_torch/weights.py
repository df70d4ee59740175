"""Loading of weights to the device, one tensor at a time: the host never holds more than the model
and one shard.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, Protocol

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from rn_runtime_torch.state_dictionary import read_header
from rn_vla.checkpoint_files import check_safetensors, clip, list_names
from rn_vla.decoding import Shard
from roboneuron import CheckpointError

_REAL_NUMBERS = {"F64", "F32", "F16", "BF16", "Double", "Float", "Half", "BFloat16"}
"""Number types of weights, as named by safetensors and torch.save."""


class _OpenShard(Protocol):
    def shapes(self) -> Mapping[str, tuple[int, ...]]: ...

    def kinds(self) -> Mapping[str, str]: ...

    def tensor(self, name: str) -> Tensor: ...


class _Safetensors:
    def __init__(self, path: Path) -> None:
        check_safetensors(path)
        # the library is not typed
        self._file: Any = safe_open(path, framework="pt", device="cpu")

    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        return {name: tuple(self._file.get_slice(name).get_shape()) for name in self._file.keys()}  # noqa: SIM118

    def kinds(self) -> Mapping[str, str]:
        return {name: str(self._file.get_slice(name).get_dtype()) for name in self._file.keys()}  # noqa: SIM118

    def tensor(self, name: str) -> Tensor:
        found: Tensor = self._file.get_tensor(name)
        return found


class _StateDictionary:
    """A file written by `torch.save`; its header is checked first, and nothing in it is
    executed.
    """

    def __init__(self, path: Path) -> None:
        self._header = read_header(path)
        self._tensors: dict[str, Tensor] = torch.load(
            path, map_location="cpu", weights_only=True, mmap=True
        )

    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        return {name: tensor.shape for name, tensor in self._header.items()}

    def kinds(self) -> Mapping[str, str]:
        return {name: tensor.kind for name, tensor in self._header.items()}

    def tensor(self, name: str) -> Tensor:
        return self._tensors[name]


@contextmanager
def _opened(path: Path) -> Iterator[_OpenShard]:
    try:
        yield _Safetensors(path) if path.suffix == ".safetensors" else _StateDictionary(path)
    except (SafetensorError, UnpicklingError, EOFError, RuntimeError, OSError, ValueError) as error:
        if isinstance(error, torch.OutOfMemoryError) or "allocate memory" in str(error):
            raise
        raise CheckpointError(
            f"Weight file {path} ({path.stat().st_size} bytes) is truncated or damaged: "
            f"{clip(error, 200)}",
            hint="Download the checkpoint again.",
        ) from error


def check_shards(shards: tuple[Shard, ...]) -> None:
    """Compare names and shapes on disk with the expected ones, before any tensor is read.

    Raises:
        CheckpointError: lists every missing, unexpected and misshaped tensor, or names the damaged
            file.
    """
    problems: list[str] = []
    for shard in shards:
        with _opened(shard.path) as opened:
            found, kinds = opened.shapes(), opened.kinds()
        missing = sorted(shard.weights.keys() - found.keys())
        extra = sorted(found.keys() - shard.weights.keys())
        misshaped = [
            f"{name} is {clip(list(found[name]))}, expected {list(weight.shape)}"
            for name, weight in shard.weights.items()
            if name in found and found[name] != weight.shape
        ]
        odd = [
            f"{name} is {clip(kinds[name])}"
            for name in sorted(found)
            if kinds[name] not in _REAL_NUMBERS
        ]
        for what, names in (
            ("missing", missing),
            ("unexpected", extra),
            ("misshaped", misshaped),
            ("of a number type that no weight has", odd),
        ):
            if names:
                problems.append(f"{shard.path.name}: {len(names)} {what}: {list_names(names)}")
    if problems:
        raise CheckpointError(
            f"The weights in {shards[0].path.parent} are not those of this model. "
            + "; ".join(problems)
            + ".",
            hint="Check that the checkpoint belongs to this backend and is complete.",
        )


def load_shards(shards: tuple[Shard, ...], slots: Mapping[str, Tensor]) -> None:
    """Copy every tensor that has a target into its slot, converting type and device, shard by
    shard.

    Tensors without a target, of parts that inference never runs, are read too, so that any damage
    of a file is found.

    Raises:
        CheckpointError: a tensor holds NaN or infinity, a file is damaged, or a slot stayed empty.
    """
    filled: set[str] = set()
    for shard in shards:
        finite: dict[str, Tensor] = {}
        with _opened(shard.path) as opened:
            for name, weight in shard.weights.items():
                tensor = opened.tensor(name)
                if weight.target:
                    slot = slots[weight.target]
                    slot.copy_(tensor)
                    filled.add(weight.target)
                    tensor = slot  # checked in the type of the runtime, which may overflow
                finite[name] = torch.isfinite(tensor).all()
        bad = [name for name, flag in finite.items() if not bool(flag)]
        if bad:
            raise CheckpointError(
                f"{shard.path} holds NaN or infinite values in {len(bad)} tensors: "
                f"{list_names(bad)}.",
                hint="Download the checkpoint again; a float16 runtime can also overflow: use "
                "bfloat16 or float32.",
            )
    empty = sorted(slots.keys() - filled)
    if empty:
        raise CheckpointError(f"{len(empty)} parameters got no weight: {list_names(empty)}.")

"""Weights from disk to the device, one tensor at a time: the host never holds more than the model and one shard."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, Protocol

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from roboneuron.contract.decoding import Shard
from roboneuron.errors import CheckpointError

_LISTED = 12
"""Names shown in an error before "and N more"."""


class _OpenShard(Protocol):
    def shapes(self) -> Mapping[str, tuple[int, ...]]: ...

    def tensor(self, name: str) -> Tensor: ...


class _Safetensors:
    def __init__(self, path: Path) -> None:
        self._file: Any = safe_open(path, framework="pt", device="cpu")  # the library is not typed

    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        return {name: tuple(self._file.get_slice(name).get_shape()) for name in self._file.keys()}  # noqa: SIM118

    def tensor(self, name: str) -> Tensor:
        found: Tensor = self._file.get_tensor(name)
        return found


class _StateDictionary:
    """A file written by `torch.save`; only plain tensors are read, nothing in it is executed."""

    def __init__(self, path: Path) -> None:
        loaded = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
        if not isinstance(loaded, dict) or not all(isinstance(value, Tensor) for value in loaded.values()):
            raise CheckpointError(f"{path} holds a {type(loaded).__name__}, expected a dictionary of tensors.")
        self._tensors: dict[str, Tensor] = loaded

    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        return {name: tuple(tensor.shape) for name, tensor in self._tensors.items()}

    def tensor(self, name: str) -> Tensor:
        return self._tensors[name]


@contextmanager
def _opened(path: Path) -> Iterator[_OpenShard]:
    if not path.is_file():
        raise CheckpointError(f"Weight file {path} does not exist.", hint="Download the checkpoint again.")
    try:
        yield _Safetensors(path) if path.suffix == ".safetensors" else _StateDictionary(path)
    except (SafetensorError, UnpicklingError, EOFError, RuntimeError, OSError) as error:
        if isinstance(error, torch.OutOfMemoryError) or "allocate memory" in str(error):
            raise
        raise CheckpointError(
            f"Weight file {path} ({path.stat().st_size} bytes) is truncated or damaged: {error}",
            hint="Download the checkpoint again.",
        ) from error


def check_shards(shards: tuple[Shard, ...]) -> None:
    """Compare names and shapes on disk with what is expected, before any tensor is read.

    Raises:
        CheckpointError: lists every missing, unexpected and misshaped tensor, or names the damaged file.
    """
    problems: list[str] = []
    for shard in shards:
        with _opened(shard.path) as opened:
            found = opened.shapes()
        missing = sorted(shard.weights.keys() - found.keys())
        extra = sorted(found.keys() - shard.weights.keys())
        misshaped = [
            f"{name} is {list(found[name])}, expected {list(weight.shape)}"
            for name, weight in shard.weights.items()
            if name in found and found[name] != weight.shape
        ]
        for what, names in (("missing", missing), ("unexpected", extra), ("misshaped", misshaped)):
            if names:
                problems.append(f"{shard.path.name}: {len(names)} {what}: {list_names(names)}")
    if problems:
        raise CheckpointError(
            f"The weights in {shards[0].path.parent} are not those of this model. " + "; ".join(problems) + ".",
            hint="Check that the checkpoint belongs to this backend and is complete.",
        )


def list_names(names: list[str]) -> str:
    """The first names, and how many more there are."""
    more = len(names) - _LISTED
    return ", ".join(names[:_LISTED]) + (f" and {more} more" if more > 0 else "")


def load_shards(shards: tuple[Shard, ...], slots: Mapping[str, Tensor]) -> None:
    """Copy every tensor that has a target into its slot, converting type and device, shard by shard.

    Raises:
        CheckpointError: a tensor holds NaN or infinity, a file is damaged, or a slot stayed empty.
    """
    filled: set[str] = set()
    for shard in shards:
        finite: dict[str, Tensor] = {}
        with _opened(shard.path) as opened:
            for name, weight in shard.weights.items():
                if weight.target:
                    slot = slots[weight.target]
                    slot.copy_(opened.tensor(name))
                    finite[name] = torch.isfinite(slot).all()
                    filled.add(weight.target)
        bad = [name for name, flag in finite.items() if not bool(flag)]
        if bad:
            raise CheckpointError(
                f"{shard.path} holds NaN or infinite values in {len(bad)} tensors: {list_names(bad)}.",
                hint="Download the checkpoint again; a float16 runtime can also overflow: use bfloat16 or float32.",
            )
    empty = sorted(slots.keys() - filled)
    if empty:
        raise CheckpointError(f"{len(empty)} parameters got no weight: {list_names(empty)}.")

"""Choice of device and number type, check of the memory, and errors if it is insufficient."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch

from rn_runtime_torch.config import TorchRuntimeConfig
from roboneuron import ConfigurationError

_STREAM_BYTES = 2 * 32 * 2**20
"""Workspaces of cuBLAS and cuBLASLt per stream: 32 MiB each on Hopper, less before. Source:
PyTorch, CUDA notes.
"""
_GRAPH_BYTES = 16 * 2**20
"""Inputs, outputs and kernel arguments of one recorded graph: an estimate for a few thousand
kernels.
"""
_DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}


def choose_device(config: TorchRuntimeConfig) -> torch.device:
    """The configured device. Raises ConfigurationError for a CUDA device that does not exist."""
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if config.device == "auto":
        return torch.device("cuda:0" if count else "cpu")
    device = torch.device(config.device)
    if device.type == "cuda" and (device.index or 0) >= count:
        raise ConfigurationError(
            f"Runtime 'torch' should use {config.device!r}, but torch {torch.__version__} sees "
            f"{count} CUDA devices.",
            hint='Set device = "auto" or "cpu", or install a CUDA build of torch.',
        )
    return device


def choose_dtype(config: TorchRuntimeConfig, device: torch.device) -> torch.dtype:
    """The configured number type, or the device's default."""
    if config.dtype == "auto":
        return torch.bfloat16 if device.type == "cuda" or has_matrix_tiles() else torch.float32
    return _DTYPES[config.dtype]


def has_matrix_tiles() -> bool:
    """True if products of bfloat16 matrices run in the processor's tile unit (Intel AMX), as used
    by oneDNN.

    Without it bfloat16 is slower than float32 on most processors.
    """
    return bool(torch.backends.mkldnn.is_available() and torch.cpu._is_amx_tile_supported())  # type: ignore[no-untyped-call]


def free_bytes(device: torch.device) -> int:
    """Available memory of `device` in bytes. Source: MemAvailable of proc(5); cudaMemGetInfo."""
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    raise ConfigurationError("Cannot read the available memory from /proc/meminfo.")


@dataclass(frozen=True, kw_only=True, slots=True)
class Needs:
    """Memory that a model needs, in bytes.

    Attributes:
        weights: weights of all parts, int8 copies included.
        cache: keys and values of the longest sequence.
        activations: peak of simultaneous tensors during the longest request.
        recordings: number of CUDA graphs; 0 for none.
    """

    weights: int
    cache: int
    activations: int
    recordings: int = 0

    def working(self, device: torch.device) -> int:
        """Memory besides weights and cache."""
        if device.type != "cuda":
            return self.activations
        # graphs have their own pool besides the ordinary memory
        passes = 2 if self.recordings else 1
        return passes * (self.activations + _STREAM_BYTES) + self.recordings * _GRAPH_BYTES

    def total(self, device: torch.device) -> int:
        """Total memory."""
        return self.weights + self.cache + self.working(device)


def check_fits(needs: Needs, device: torch.device, dtype: torch.dtype) -> None:
    """Raise ConfigurationError when a model needs more bytes than `device` has free."""
    free = free_bytes(device)
    if needs.total(device) > free:
        parts = (needs.weights, needs.cache, needs.working(device))
        weights, cache, working = (f"{part / 1e9:.2f}" for part in parts)
        raise ConfigurationError(
            f"The model needs {needs.total(device) / 1e9:.2f} GB as "
            f"{str(dtype).removeprefix('torch.')} on {device} "
            f"(weights {weights}, keys and values {cache}, working memory {working}), "
            f"which has {free / 1e9:.2f} GB free.",
            hint="Free memory, choose a smaller dtype or another device, or lower "
            "max_prompt_tokens.",
        )


@contextmanager
def memory_errors(device: torch.device) -> Iterator[None]:
    """Convert torch's out-of-memory errors within the block to ConfigurationError."""
    try:
        yield
    except RuntimeError as error:
        if isinstance(error, torch.OutOfMemoryError) or "allocate memory" in str(error):
            raise ConfigurationError(
                f"Out of memory on {device}: {str(error).splitlines()[0]}",
                hint="Free memory, choose a smaller dtype or another device.",
            ) from error
        raise


def release_memory() -> None:
    """Return cached device memory after an engine was deleted."""
    if torch.cuda.is_available():
        torch.cuda.empty_cache()

"""Which device and number type, and whether the model fits there."""

from __future__ import annotations

from pathlib import Path

import torch

from rn_runtime_torch.config import TorchRuntimeConfig
from roboneuron.errors import ConfigurationError

_DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}


def choose_device(config: TorchRuntimeConfig) -> torch.device:
    """The configured device. Raises ConfigurationError when it is a CUDA device that is not there."""
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if config.device == "auto":
        return torch.device("cuda:0" if count else "cpu")
    device = torch.device(config.device)
    if device.type == "cuda" and (device.index or 0) >= count:
        raise ConfigurationError(
            f"Runtime 'torch' is to use {config.device!r}, but torch {torch.__version__} sees {count} CUDA devices.",
            hint='Set device = "auto" or "cpu", or install a CUDA build of torch.',
        )
    return device


def choose_dtype(config: TorchRuntimeConfig, device: torch.device) -> torch.dtype:
    """The configured number type, or the device's usual one."""
    if config.dtype == "auto":
        return torch.bfloat16 if device.type == "cuda" else torch.float32
    return _DTYPES[config.dtype]


def free_bytes(device: torch.device) -> int:
    """Memory that can still be had on `device`. Source: MemAvailable of proc(5); cudaMemGetInfo."""
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    raise ConfigurationError("Cannot read the available memory from /proc/meminfo.")


def check_fits(needed: int, device: torch.device, dtype: torch.dtype) -> None:
    """Raise ConfigurationError when `needed` bytes are more than `device` has free."""
    free = free_bytes(device)
    if needed > free:
        raise ConfigurationError(
            f"The model needs {needed / 1e9:.2f} GB as {str(dtype).removeprefix('torch.')} on {device}, "
            f"which has {free / 1e9:.2f} GB free.",
            hint="Free memory, choose a smaller dtype or another device.",
        )

"""The backends' contract cases: tiny random checkpoints on the in-process runtime."""

from __future__ import annotations

import atexit
import functools
import tempfile
from pathlib import Path

from rn_backend_oft.plugin import roboneuron_backends
from rn_testing import BackendCase
from roboneuron import BackendSpec


def oft_case() -> BackendCase:
    """`oft` with constants and profile libero."""
    return _case(roboneuron_backends()[0])


def oft_primary_case() -> BackendCase:
    """`oft-primary` with the same constants."""
    return _case(roboneuron_backends()[1])


def oft_pair_case() -> BackendCase:
    """`oft-pair` with the same constants."""
    return _case(roboneuron_backends()[2])


def _case(spec: BackendSpec) -> BackendCase:
    from rn_runtime_torch.config import TorchRuntimeConfig
    from rn_runtime_torch.runtime import TorchRuntime

    return BackendCase(
        spec=spec,
        options={
            "checkpoint": str(_checkpoint()),
            "profile": "libero",
            "constants": "libero",
            "proprio": True,
        },
        runtime=lambda: TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32")),
    )


@functools.cache
def _checkpoint() -> Path:
    from rn_backend_oft.tiny import make_tiny_oft

    held = tempfile.TemporaryDirectory(prefix="rn-backend-oft-")
    atexit.register(held.cleanup)
    make_tiny_oft(Path(held.name))
    return Path(held.name)

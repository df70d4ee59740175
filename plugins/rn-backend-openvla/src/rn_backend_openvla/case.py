"""The backends' contract cases: a tiny random checkpoint on the in-process runtime."""

from __future__ import annotations

import atexit
import functools
import tempfile
from pathlib import Path

from rn_backend_openvla.plugin import roboneuron_backends
from rn_testing import BackendCase
from roboneuron import BackendSpec


def openvla_case() -> BackendCase:
    """`openvla` with profile libero."""
    return _case(roboneuron_backends()[0], {"profile": "libero"})


def openvla_tcp_case() -> BackendCase:
    """`openvla-tcp` with a tool-frame profile."""
    own = {
        "metres_per_unit": 0.05,
        "radians_per_unit": 0.5,
        "rotation": "rpy",
        "frame": "tcp",
        "gripper": "signed_close",
        "step_s": 0.1,
    }
    return _case(roboneuron_backends()[1], {"profile": "own", "own_profile": own})


def _case(spec: BackendSpec, options: dict[str, object]) -> BackendCase:
    from rn_runtime_torch.config import TorchRuntimeConfig
    from rn_runtime_torch.runtime import TorchRuntime

    return BackendCase(
        spec=spec,
        options={"checkpoint": str(_checkpoint()), **options},
        runtime=lambda: TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32")),
    )


@functools.cache
def _checkpoint() -> Path:
    from rn_vla.openvla.tiny import make_tiny

    held = tempfile.TemporaryDirectory(prefix="rn-backend-openvla-")
    atexit.register(held.cleanup)
    make_tiny(Path(held.name))
    return Path(held.name)

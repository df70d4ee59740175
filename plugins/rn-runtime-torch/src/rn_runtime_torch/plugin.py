"""Descriptors of this package: the runtime `torch`."""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron import Requirement, RuntimeSpec, hookimpl

FAMILIES = ("openvla", "openvla-oft")
"""Supported model families."""
CAPABILITIES = ("token-decode", "bidirectional-hidden", "visual-token-pruning")
"""Supported kinds of request (see `rn_vla.decoding`) and hooks."""


@hookimpl
def roboneuron_runtimes() -> Sequence[RuntimeSpec]:
    """Register the in-process runtime."""
    return (
        RuntimeSpec(
            name="torch",
            summary="In-process PyTorch decoder on CPU or CUDA: static cache, CUDA graphs, "
            "visual-token pruning.",
            target="rn_runtime_torch.runtime:TorchRuntime",
            config="rn_runtime_torch.config:TorchRuntimeConfig",
            requires=(
                Requirement(
                    module="torch", install="pip install torch (which build: README.md, PyTorch)"
                ),
                Requirement(module="safetensors", install="pip install safetensors"),
            ),
            families=FAMILIES,
            capabilities=CAPABILITIES,
            case="rn_runtime_torch.case:torch_case",
        ),
    )

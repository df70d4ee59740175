"""Descriptors of this package: the runtime `sglang`."""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron import RuntimeSpec, hookimpl

FAMILIES = ("openvla",)
"""Supported model families; docs/serving.md explains why OpenVLA-OFT and pi0 are not among them."""
CAPABILITIES = ("token-decode",)
"""Supported kinds of request. It has no hook to drop visual tokens: see docs/serving.md."""


@hookimpl
def roboneuron_runtimes() -> Sequence[RuntimeSpec]:
    """Register the served runtime."""
    return (
        RuntimeSpec(
            name="sglang",
            summary="SGLang server, launched in its own virtual environment or reached by URL: "
            "image in, tokens out.",
            target="rn_runtime_sglang.runtime:SglangRuntime",
            config="rn_runtime_sglang.config:SglangRuntimeConfig",
            families=FAMILIES,
            capabilities=CAPABILITIES,
            served=True,
            case="rn_runtime_sglang.case:sglang_case",
        ),
    )

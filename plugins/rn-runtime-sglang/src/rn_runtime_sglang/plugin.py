"""What this package offers: the runtime `sglang`."""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron import RuntimeSpec, hookimpl

FAMILIES = ("openvla",)
"""Model families whose requests it answers; why not OpenVLA-OFT and pi0 is said in docs/sglang.md.
"""
CAPABILITIES = ("token-decode",)
"""Kinds of request it answers. It has no hook to drop visual tokens: see docs/sglang.md."""


@hookimpl
def roboneuron_runtimes() -> Sequence[RuntimeSpec]:
    """The served runtime."""
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

"""Descriptors of this package: the presets `fastv-p25`, `fastv-p50`, `fastv-p75`, and `fastv` with
a free share.
"""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron import AccelerationSpec, Requirement, hookimpl

FAMILIES = ("openvla", "openvla-oft")
"""Model families whose visual tokens are one span after the first token."""


def _spec(name: str, summary: str, target: str, config: str, case: str) -> AccelerationSpec:
    return AccelerationSpec(
        name=name,
        summary=summary,
        target=f"rn_accel_fastv.preset:{target}",
        config=f"rn_accel_fastv.config:{config}",
        case=f"rn_accel_fastv.case:{case}",
        requires=(
            Requirement(
                module="torch", install="pip install torch (which build: README.md, PyTorch)"
            ),
            Requirement(
                module="rn_runtime_torch", install="pip install ./plugins/rn-runtime-torch"
            ),
        ),
        families=FAMILIES,
        capability="visual-token-pruning",
    )


def _named(percent: int) -> AccelerationSpec:
    return _spec(
        f"fastv-p{percent}",
        f"FastV: drops {percent} % of the visual tokens after two layers.",
        f"FastVP{percent}",
        "PresetConfig",
        f"p{percent}_case",
    )


@hookimpl
def roboneuron_accelerations() -> Sequence[AccelerationSpec]:
    """Register FastV with fixed and with free shares of dropped visual tokens."""
    free = "FastV with a free layer k and a free share r of dropped visual tokens."
    return (
        _named(25),
        _named(50),
        _named(75),
        _spec("fastv", free, "FastV", "FastVConfig", "free_case"),
    )

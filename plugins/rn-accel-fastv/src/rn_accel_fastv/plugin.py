"""What this package offers: the presets `fastv-p25`, `fastv-p50`, `fastv-p75`, and `fastv` with a free share."""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron.plugins.markers import hookimpl
from roboneuron.plugins.specs import AccelerationSpec, Requirement

FAMILIES = ("openvla", "openvla-oft")
"""Model families whose visual tokens stand in one span behind the first token."""


def _spec(name: str, summary: str, target: str, config: str) -> AccelerationSpec:
    return AccelerationSpec(
        name=name,
        summary=summary,
        target=f"rn_accel_fastv.preset:{target}",
        config=f"rn_accel_fastv.config:{config}",
        requires=(Requirement(module="torch", install="pip install torch"),),
        families=FAMILIES,
        capability="visual-token-pruning",
    )


@hookimpl
def roboneuron_accelerations() -> Sequence[AccelerationSpec]:
    """FastV with named and with free shares of dropped visual tokens."""
    return (
        _spec("fastv-p25", "FastV: drops 25 % of the visual tokens after two layers.", "FastVP25", "PresetConfig"),
        _spec("fastv-p50", "FastV: drops 50 % of the visual tokens after two layers.", "FastVP50", "PresetConfig"),
        _spec("fastv-p75", "FastV: drops 75 % of the visual tokens after two layers.", "FastVP75", "PresetConfig"),
        _spec("fastv", "FastV with a free layer k and share r of dropped visual tokens.", "FastV", "FastVConfig"),
    )

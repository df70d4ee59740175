"""Descriptors of this package; standard library only."""

from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="fleet",
    summary="Several robots behind one server, `[robots.<name>]`, each with its own gate and "
    "emergency stop.",
    target="rn_standard.fleet.feature:FleetFeature",
    fleet="rn_standard.fleet.fleet:Fleet",
    fleet_config="rn_standard.fleet.reading:read_robots",
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

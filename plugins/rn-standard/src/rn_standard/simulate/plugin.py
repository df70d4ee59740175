"""What this package offers; standard library and descriptors only."""

from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="simulate",
    summary="simulate=true: what a motion would do, found out in a simulated twin of the cell.",
    target="rn_standard.simulate.feature:SimulateFeature",
    config="rn_standard.simulate.options:SimulateOptions",
    needs=("direct-path", "tools-arm"),
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

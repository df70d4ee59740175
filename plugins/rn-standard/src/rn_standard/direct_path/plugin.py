"""Descriptors of this package; standard library only."""

from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="direct-path",
    summary="The gate of the direct path: judges, sends and ends every message, request and goal "
    "for an agent.",
    target="rn_standard.direct_path.feature:DirectPath",
    config="rn_standard.direct_path.options:DirectPathOptions",
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

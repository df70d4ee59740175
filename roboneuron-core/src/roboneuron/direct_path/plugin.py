"""Descriptors of this package; standard library only."""

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import FeatureSpec

FEATURE = FeatureSpec(
    name="direct-path",
    summary="The gate of the direct path: judges, sends and ends every message, request and goal "
    "for an agent.",
    target="roboneuron.direct_path.feature:DirectPath",
    config="roboneuron.direct_path.options:DirectPathOptions",
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

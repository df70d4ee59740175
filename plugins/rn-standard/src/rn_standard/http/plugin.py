"""Descriptors of this package; standard library only."""

from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="http",
    summary="Serves several clients over streamable HTTP, with tokens and leases.",
    target="rn_standard.http.feature:HttpFeature",
    config="rn_standard.http.options:HttpOptions",
    transports=("http",),
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

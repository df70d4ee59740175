"""Descriptors of this package; standard library only."""

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import FeatureSpec

FEATURE = FeatureSpec(
    name="stdio",
    summary="Serves the client that has started the server, over standard input and output.",
    target="roboneuron.stdio.feature:StdioFeature",
    transports=("stdio",),
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

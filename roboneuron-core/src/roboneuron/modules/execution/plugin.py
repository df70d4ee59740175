"""Descriptors of this package; standard library only."""

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import FeatureSpec

FEATURE = FeatureSpec(
    name="execution",
    summary="Executes chunks of actions without pauses: overlap, real-time chunking, predicted "
    "states.",
    target="roboneuron.modules.execution.feature:ExecutionFeature",
    on_join="roboneuron.modules.execution.feature:join",
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

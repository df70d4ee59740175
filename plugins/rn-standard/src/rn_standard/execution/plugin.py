"""Descriptors of this package; standard library only."""

from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="execution",
    summary="Executes chunks of actions without pauses: overlap, real-time chunking, predicted "
    "states.",
    target="rn_standard.execution.feature:ExecutionFeature",
    on_join="rn_standard.execution.feature:join",
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

"""Descriptors of this package; standard library only."""

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import FeatureSpec

FEATURE = FeatureSpec(
    name="tools-loop",
    summary="start_*, set_instruction, get_status and reset_emergency_stop, for agents.",
    target="roboneuron.tools.loop.feature:LoopTools",
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

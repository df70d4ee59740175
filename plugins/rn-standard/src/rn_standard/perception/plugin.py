"""Descriptors of this package; standard library only."""

from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="perception",
    summary="Runs cameras: frames of a source in, images on ROS topics out.",
    target="roboneuron:Feature",
    module="rn_standard.perception.module:PerceptionModule",
    module_plan="rn_standard.perception.planning:plan_perception",
)
"""Descriptor of the feature; it has no part in the server."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

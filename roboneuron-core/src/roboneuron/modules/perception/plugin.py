"""Descriptors of this package; standard library only."""

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import FeatureSpec

FEATURE = FeatureSpec(
    name="perception",
    summary="Runs cameras: frames of a source in, images on ROS topics out.",
    target="roboneuron:Feature",
    module="roboneuron.modules.perception.module:PerceptionModule",
    module_plan="roboneuron.modules.perception.planning:plan_perception",
)
"""Descriptor of the feature; it has no part in the server."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

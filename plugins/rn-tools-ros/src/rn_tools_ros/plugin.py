"""What this package offers; standard library and descriptors only."""

from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="tools-ros",
    summary="Typed tools for the ROS topics, services, actions and parameters that are exposed.",
    target="rn_tools_ros.feature:RosTools",
    config="rn_tools_ros.options:RosToolsOptions",
    sections=("direct", "expose", "discover"),
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

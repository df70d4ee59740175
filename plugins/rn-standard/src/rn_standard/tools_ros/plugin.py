"""Descriptors of this package; standard library only."""

from roboneuron import CommandSpec, FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="tools-ros",
    summary="Typed tools for the ROS topics, services, actions and parameters that are exposed.",
    target="rn_standard.tools_ros.feature:RosTools",
    config="rn_standard.tools_ros.options:RosToolsOptions",
    sections=("direct", "expose", "discover"),
    needs=("direct-path",),
)
"""Descriptor of the feature."""
COMMAND = CommandSpec(
    name="describe",
    summary="show a ROS interface as agents see it, or list the installed ones",
    target="rn_standard.tools_ros.describe:Describe",
)
"""Descriptor of the command."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)


@hookimpl
def roboneuron_commands() -> tuple[CommandSpec, ...]:
    """The commands of this package."""
    return (COMMAND,)

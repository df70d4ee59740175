"""Descriptors of this package; standard library only."""

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import CommandSpec, FeatureSpec

FEATURE = FeatureSpec(
    name="tools-ros",
    summary="Typed tools for the ROS topics, services, actions and parameters that are exposed.",
    target="roboneuron.tools.ros.feature:RosTools",
    config="roboneuron.tools.ros.options:RosToolsOptions",
    sections=("direct", "expose", "discover"),
    needs=("direct-path",),
)
"""Descriptor of the feature."""
COMMAND = CommandSpec(
    name="ros-describe",
    group="ros",
    summary="show a ROS interface as agents see it, or list the installed ones",
    target="roboneuron.tools.ros.describe:Describe",
    old_names=("describe",),
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

"""Descriptors of this package; standard library only."""

from roboneuron import CommandSpec, FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="interfaces",
    summary="Makes learnt ROS messages, services and actions importable, and tells agents which "
    "are unknown.",
    target="rn_interfaces.feature:Interfaces",
    on_discovery="rn_interfaces.finder:install",
)
"""Descriptor of the feature."""

COMMAND = CommandSpec(
    name="ros",
    section="group",
    summary="describe ROS interfaces; learn, list and show them from their definitions",
    target="rn_interfaces_learning.command:Ros",
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

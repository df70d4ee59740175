"""Descriptors of this package; standard library only."""

from roboneuron import CommandSpec, FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="link",
    summary="Encrypts and authenticates ROS between paired machines.",
    target="rn_link.feature:LinkFeature",
    on_discovery="rn_link.environment:join_link",
)
"""Descriptor of the feature."""

COMMAND = CommandSpec(
    name="link",
    section="group",
    summary="pair machines, and show or remove paired ones",
    target="rn_link.command:LinkCommand",
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

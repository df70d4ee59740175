"""Descriptors of this package; imports nothing else."""

from roboneuron import CommandSpec, FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="view",
    summary="Shows the robot, its cameras and its state in a browser, with an emergency stop.",
    target="rn_view.feature:ViewFeature",
    config="rn_view.options:ViewOptions",
    needs=("http",),
    switch="enabled",
)
"""Descriptor of the feature; `http` holds the tokens and the rules for hosts and origins."""

COMMAND = CommandSpec(
    name="view",
    section="operate",
    summary="show the robot of a running server in a browser; the server needs no view",
    target="rn_view_attached.command:ViewCommand",
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

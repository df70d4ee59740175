"""Descriptors of this package; standard library only."""

from roboneuron import CommandSpec, hookimpl

COMMAND = CommandSpec(
    name="demo",
    summary="an agent stand-in picks up a cube with the simulated robot",
    target="rn_standard.demo.command:Demo",
    old_options=(("--output", "--out"),),
    section="start",
)
"""Descriptor of the command."""


@hookimpl
def roboneuron_commands() -> tuple[CommandSpec, ...]:
    """The commands of this package."""
    return (COMMAND,)

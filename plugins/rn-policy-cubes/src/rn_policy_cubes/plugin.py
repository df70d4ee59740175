"""Descriptors of this package: the command "cubes-policy"; standard library only."""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron import CommandSpec, hookimpl

COMMAND = CommandSpec(
    name="cubes-policy",
    summary="make demonstrations, train the small learned policy, pack and unpack its weights",
    target="rn_policy_cubes.command:CubesPolicy",
)


@hookimpl
def roboneuron_commands() -> Sequence[CommandSpec]:
    """The command `roboneuron cubes-policy`."""
    return [COMMAND]

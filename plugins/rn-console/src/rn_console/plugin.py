"""What this package offers; standard library and descriptors only."""

from roboneuron import CommandSpec, hookimpl

RUN = CommandSpec(
    name="run",
    summary="start the configured robot, carry out one instruction, stop everything",
    target="rn_console.run_command:Run",
)
STATUS = CommandSpec(
    name="status",
    summary="show modules, rates, latencies and the emergency stop; --watch goes on",
    target="rn_console.status_command:StatusCommand",
)
LOGS = CommandSpec(
    name="logs",
    summary="show the logs of the newest run; -f follows them",
    target="rn_console.logs_command:Logs",
)
COMPLETION = CommandSpec(
    name="completion",
    summary="print a completion script for bash, zsh or fish",
    target="rn_console.completion:Completion",
)
COMMANDS = (RUN, STATUS, LOGS, COMPLETION)
"""Descriptors of the commands."""


@hookimpl
def roboneuron_commands() -> tuple[CommandSpec, ...]:
    """The commands of this package."""
    return COMMANDS

"""Descriptors of this package; standard library only."""

from roboneuron import CommandSpec, hookimpl

RUN = CommandSpec(
    name="run",
    section="start",
    summary="start the configured robot, carry out one instruction, stop everything",
    target="rn_standard.console.run_command:RunCommand",
)
STATUS = CommandSpec(
    name="status",
    section="operate",
    summary="show modules, rates, latencies and the emergency stop; --watch goes on",
    target="rn_standard.console.status_command:StatusCommand",
)
LOGS = CommandSpec(
    name="logs",
    section="operate",
    summary="show the logs of the newest run; -f follows them",
    target="rn_standard.console.logs_command:Logs",
)
COMPLETION = CommandSpec(
    name="completion",
    summary="print a completion script for bash, zsh or fish",
    target="rn_standard.console.completion:Completion",
)
CALL = CommandSpec(
    name="call",
    section="operate",
    summary="call a tool as an agent would, on a spawned or a running server",
    target="rn_standard.console.call:CallCommand",
)
TOOLS = CommandSpec(
    name="tools",
    section="operate",
    summary="list the tools that agents get",
    target="rn_standard.console.tools:Tools",
)
CONFIG_SHOW = CommandSpec(
    name="config-show",
    group="config",
    summary="print the default configuration and the options of features",
    target="rn_standard.console.configuration:ConfigShow",
)
CONFIG_CHECK = CommandSpec(
    name="config-check",
    group="config",
    summary="say what is wrong with a roboneuron.toml, as `serve` would",
    target="rn_standard.console.config_check:ConfigCheck",
)
CONFIG_REFERENCE = CommandSpec(
    name="config-reference",
    group="config",
    summary="list all keys of roboneuron.toml, as Markdown",
    target="rn_standard.console.configuration:ConfigReference",
)
PLUGINS_LIST = CommandSpec(
    name="plugins-list",
    group="plugins",
    summary="list the installed plugins and what they offer",
    target="rn_standard.console.plugins_list:PluginsList",
)
PLUGINS_SHOW = CommandSpec(
    name="plugins-show",
    group="plugins",
    summary="show everything about one plugin, or one thing it offers",
    target="rn_standard.console.plugins_show:PluginsShow",
)
UP = CommandSpec(
    name="up",
    section="operate",
    summary="start everything that is configured at once, and keep it",
    target="rn_standard.console.up_command:Up",
)
DOWN = CommandSpec(
    name="down",
    section="operate",
    summary="stop everything that runs, of `up` or of a server",
    target="rn_standard.console.up_command:Down",
)
COMMANDS = (
    RUN,
    UP,
    DOWN,
    STATUS,
    LOGS,
    CALL,
    TOOLS,
    CONFIG_CHECK,
    CONFIG_SHOW,
    CONFIG_REFERENCE,
    PLUGINS_LIST,
    PLUGINS_SHOW,
    COMPLETION,
)
"""Descriptors of the commands."""


@hookimpl
def roboneuron_commands() -> tuple[CommandSpec, ...]:
    """The commands of this package."""
    return COMMANDS

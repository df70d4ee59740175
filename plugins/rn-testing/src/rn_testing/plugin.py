"""Descriptors of this package; standard library only."""

from roboneuron import CommandSpec, hookimpl

NEW = CommandSpec(
    name="plugins-new",
    group="plugins",
    summary="write a plugin package that passes its contract tests",
    target="rn_testing.new:New",
    old_names=("new",),
    old_options=(("--directory", "--out"),),
)
"""Descriptor of `roboneuron plugins new`."""
CHECK = CommandSpec(
    name="plugins-check",
    group="plugins",
    summary="run the contract rules against an installed plugin",
    target="rn_testing.plugin_check:PluginsCheck",
)
"""Descriptor of `roboneuron plugins check`."""
RULES = CommandSpec(
    name="plugins-rules",
    group="plugins",
    summary="print the contract rules of each kind of plugin",
    target="rn_testing.plugin_rules:PluginsRules",
)
"""Descriptor of `roboneuron plugins rules`."""


@hookimpl
def roboneuron_commands() -> tuple[CommandSpec, ...]:
    """The commands of this package."""
    return (NEW, CHECK, RULES)

"""Descriptors of this package; standard library only."""

from roboneuron import CommandSpec, FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="declared-arm",
    summary="Arms that roboneuron.toml declares by their URDF, in [robot.arm]; with ros2_control, "
    "LeRobot, FCI or simulated.",
    target="rn_standard.declared_arm.feature:DeclaredArm",
    declared_robot="rn_standard.declared_arm.profile:describe",
)
"""Descriptor of the feature."""
COMMAND = CommandSpec(
    name="config-arm",
    group="config",
    summary="say what the URDF of [robot.arm] gives, and what was guessed",
    target="rn_standard.declared_arm.command:ConfigArm",
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

"""Descriptors of this package; standard library only."""

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import CommandSpec, FeatureSpec

FEATURE = FeatureSpec(
    name="tools-arm",
    summary="move_joints and move_ee: joint targets and end-effector deltas of an arm, within the "
    "limits.",
    target="roboneuron.tools.arm.feature:ArmTools",
    config="roboneuron.tools.arm.options:ArmToolsOptions",
    needs=("direct-path",),
    on_join="roboneuron.tools.arm.grip_reports:join",
)
"""Descriptor of the feature."""

LIMITS = FeatureSpec(
    name="limits",
    summary="tighten_limits: limits that clients tighten at run time and only a person loosens.",
    target="roboneuron.tools.arm.limits_feature:LimitsFeature",
    needs=("direct-path",),
    on_join="roboneuron.tools.arm.limit_reports:join",
)
"""Descriptor of the feature that tightens limits."""

STOP_MOTION = FeatureSpec(
    name="stop-motion",
    summary="stop_motion: ends whatever moves the robot; nothing is latched.",
    target="roboneuron.tools.arm.stop_motion:StopMotionFeature",
    needs=("tools-arm",),
)
"""Descriptor of the feature that ends motions."""

COMMAND = CommandSpec(
    name="robot-limits",
    group="robot",
    summary="show the limits that clients have tightened, and loosen them",
    target="roboneuron.tools.arm.limits_command:Limits",
    old_names=("limits",),
)
"""Descriptor of the command."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE, LIMITS, STOP_MOTION)


@hookimpl
def roboneuron_commands() -> tuple[CommandSpec, ...]:
    """The commands of this package."""
    return (COMMAND,)

"""Descriptors of this package; standard library only."""

from roboneuron import CommandSpec, FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="tools-arm",
    summary="move_joints and move_ee: joint targets and end-effector deltas of an arm, within the "
    "limits.",
    target="rn_standard.tools_arm.feature:ArmTools",
    config="rn_standard.tools_arm.options:ArmToolsOptions",
    needs=("direct-path",),
    on_join="rn_standard.tools_arm.grip_reports:join",
)
"""Descriptor of the feature."""

LIMITS = FeatureSpec(
    name="limits",
    summary="tighten_limits: limits that clients tighten at run time and only a person loosens.",
    target="rn_standard.tools_arm.limits_feature:LimitsFeature",
    needs=("direct-path",),
    on_join="rn_standard.tools_arm.limit_reports:join",
)
"""Descriptor of the feature that tightens limits."""

STOP_MOTION = FeatureSpec(
    name="stop-motion",
    summary="stop_motion: ends whatever moves the robot; nothing is latched.",
    target="rn_standard.tools_arm.stop_motion:StopMotionFeature",
    needs=("tools-arm",),
)
"""Descriptor of the feature that ends motions."""

COMMAND = CommandSpec(
    name="limits",
    summary="show the limits that clients have tightened, and loosen them",
    target="rn_standard.limits.command:Limits",
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

"""What this package offers; standard library and descriptors only."""

from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="tools-arm",
    summary="move_joints and move_ee: joint targets and end-effector deltas of an arm, within the limits.",
    target="rn_tools_arm.feature:ArmTools",
    config="rn_tools_arm.options:ArmToolsOptions",
    needs=("direct-path",),
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

"""Descriptors of this package; standard library only."""

from __future__ import annotations

from rn_standard.teleoperation.hooks import TeleoperatorSpec
from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="teleoperation",
    summary="A person leads the arm, takes over from a policy and hands back, within the limits.",
    target="rn_standard.teleoperation.feature:Teleoperation",
    brings="rn_standard.teleoperation.hooks:TeleoperatorSpec",
    needs=("direct-path",),
    on_join="rn_standard.teleoperation.in_control:join",
)
"""Descriptor of the feature."""

TELEOPERATORS = (
    TeleoperatorSpec(
        name="twist-topic",
        summary="Twists of a ROS topic (geometry_msgs/TwistStamped).",
        target="rn_standard.teleoperation.topic_sources:TwistTopic",
        config="rn_standard.teleoperation.topic_sources:TwistTopicOptions",
        case="rn_standard.teleoperation.contract_cases:twist_case",
    ),
    TeleoperatorSpec(
        name="joint-topic",
        summary="A second robot or leader arm (sensor_msgs/JointState, and a switch).",
        target="rn_standard.teleoperation.topic_sources:JointTopic",
        config="rn_standard.teleoperation.topic_sources:JointTopicOptions",
        gives="joint_position",
        case="rn_standard.teleoperation.contract_cases:joint_case",
    ),
    TeleoperatorSpec(
        name="spacemouse",
        summary="A 3Dconnexion SpaceMouse; its first button is the switch.",
        target="rn_standard.teleoperation.spacemouse:SpaceMouse",
        config="rn_standard.teleoperation.spacemouse:SpaceMouseOptions",
        case="rn_standard.teleoperation.contract_cases:spacemouse_case",
    ),
)
"""Descriptors of the teleoperators."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)


@hookimpl
def roboneuron_teleoperators() -> tuple[TeleoperatorSpec, ...]:
    """The teleoperators of this package."""
    return TELEOPERATORS

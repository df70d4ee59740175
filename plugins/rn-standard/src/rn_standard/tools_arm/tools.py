"""The tools of an arm: move_ee through the control module, move_joints directly."""

from __future__ import annotations

from typing import Any

from rn_standard.direct_path.derived import Derived
from rn_standard.direct_path.exposed import ACTION_LABEL
from rn_standard.tools_arm.end_effector import EndEffectorMove, EndEffectorMover, MoveEndEffector
from rn_standard.tools_arm.joints import joint_tools
from rn_standard.tools_arm.measured import MeasuredPose
from rn_standard.tools_arm.options import ArmToolsOptions
from rn_standard.tools_arm.placing import GripHeight, place_tool
from roboneuron import Host, Tool
from roboneuron.feature import Schema


def arm_tools(
    host: Host,
    options: ArmToolsOptions,
    poses: dict[str, MeasuredPose],
    grips: dict[str, GripHeight],
) -> list[Tool[Any]]:
    """move_ee, move_joints and place, for the arm among the exposed endpoints.

    `poses` and `grips` keep what is measured, by namespace.
    """
    gate = host.gate
    listed = gate.exposed
    tools = joint_tools(host, [e for e in listed if not e.hidden], gate)
    action = next((e for e in listed if e.hidden and e.label == ACTION_LABEL), None)
    if action is None or action.profile is None:
        return tools
    tcp = poses.setdefault(action.namespace, MeasuredPose(host, action.namespace))
    grip = grips.setdefault(action.namespace, GripHeight(host, gate, action, tcp))
    mover = EndEffectorMover(action, action.profile, host, options, tcp)
    properties: dict[str, Schema] = {name: {} for name in MoveEndEffector.model_fields}
    properties["duration_s"] = {"maximum": gate.max_duration_s}
    if action.profile.gripper is None:
        del properties["gripper_open"]
    move: Tool[Any] = Tool(
        name="move_ee",
        title="Move the end effector",
        description=(
            f"Move the TCP of {action.robot!r} by a delta in the base frame in a straight line, "
            "at up to "
            f"{options.ee_speed_m_s:g} m/s and {options.ee_turn_rad_s:g} rad/s, and set the "
            "gripper. Without "
            "gripper_open the hand holds its last commanded grip. Needs start_robot and "
            "start_control; refused while "
            "a policy runs. Returns what was measured when the arm is there; an error says where "
            "it stopped and why."
        ),
        arguments=Derived(model=MoveEndEffector, properties=properties),
        result=EndEffectorMove,
        handler=mover,
        open_world=True,
    )
    if action.profile.gripper is None:
        return [move, *tools]
    return [move, *tools, place_tool(mover, grip, action.robot)]

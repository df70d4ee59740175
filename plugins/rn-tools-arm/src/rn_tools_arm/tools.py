"""The tools of an arm: move_ee through the control module, move_joints directly."""

from __future__ import annotations

from typing import Any

from rn_direct_path.derived import Derived
from rn_direct_path.exposed import ACTION_LABEL
from rn_direct_path.feature import gate_of
from rn_tools_arm.end_effector import EndEffectorMove, EndEffectorMover, MoveEndEffector
from rn_tools_arm.joints import joint_tools
from rn_tools_arm.measured import MeasuredPose
from rn_tools_arm.options import ArmToolsOptions
from roboneuron.server.host import Host
from roboneuron.server.schema import Schema
from roboneuron.server.tool import Tool


def arm_tools(host: Host, options: ArmToolsOptions, poses: dict[str, MeasuredPose]) -> list[Tool[Any]]:
    """move_ee and move_joints, for the arm among the exposed endpoints; `poses` keeps what is measured by namespace."""
    gate = gate_of(host)
    listed = gate.exposed
    tools = joint_tools([e for e in listed if not e.hidden], gate)
    action = next((e for e in listed if e.hidden and e.label == ACTION_LABEL), None)
    if action is None or action.profile is None:
        return tools
    tcp = poses.setdefault(action.namespace, MeasuredPose(host, action.namespace))
    properties: dict[str, Schema] = {name: {} for name in MoveEndEffector.model_fields}
    properties["duration_s"] = {"maximum": gate.max_duration_s}
    if action.profile.gripper is None:
        del properties["gripper_open"]
    move: Tool[Any] = Tool(
        name="move_ee",
        title="Move the end effector",
        description=(
            f"Move the TCP of {action.robot!r} by a delta in the base frame (translation in m, rotation vector in rad) "
            f"and set the gripper (0 closed .. 1 open), in a straight line at up to {options.ee_speed_m_s:g} m/s and "
            f"{options.ee_turn_rad_s:g} rad/s. Needs start_robot and start_control; refused while a policy runs. "
            "Returns what was measured when the arm is there; an error says where it stopped and why."
        ),
        arguments=Derived(model=MoveEndEffector, properties=properties),
        result=EndEffectorMove,
        handler=EndEffectorMover(action, action.profile, host, options, tcp),
        open_world=True,
    )
    return [move, *tools]

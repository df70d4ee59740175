"""The tools of an arm: move_ee through the control module, move_joints directly."""

from __future__ import annotations

from rn_tools_arm.end_effector import EndEffectorMove, EndEffectorMover
from rn_tools_arm.joints import joint_tools
from rn_tools_arm.options import ArmToolsOptions
from rn_tools_ros.arguments import Schema, boolean, object_schema
from roboneuron.server.host import Host
from roboneuron.server.motion.exposed import ACTION_LABEL
from roboneuron.server.schema import output_schema
from roboneuron.server.tool import DerivedTool


def arm_tools(host: Host, options: ArmToolsOptions) -> list[DerivedTool]:
    """move_ee and move_joints, for the arm among the exposed endpoints."""
    listed = host.gate.exposed
    tools = joint_tools([e for e in listed if not e.hidden], host.gate)
    action = next((e for e in listed if e.hidden and e.label == ACTION_LABEL), None)
    if action is None or action.profile is None:
        return tools
    mover = EndEffectorMover(action, action.profile, host, options)
    numbers = mover.numbers
    properties: dict[str, Schema] = {name: number.schema() for name, number in numbers.items()}
    if action.profile.gripper is None:
        del properties["gripper_open"]
    properties["dry_run"] = boolean("Only answer what would happen; nothing is sent.")
    move = DerivedTool(
        name="move_ee",
        title="Move the end effector",
        description=(
            f"Move the TCP of {action.robot!r} by a delta in the base frame (translation in m, rotation vector in rad) "
            f"and set the gripper (0 closed .. 1 open), in a straight line at up to {options.ee_speed_m_s:g} m/s and "
            f"{options.ee_turn_rad_s:g} rad/s. Needs start_robot and start_control; refused while a policy runs. "
            "Returns what was measured when the arm is there; an error says where it stopped and why."
        ),
        input_schema=object_schema(properties),
        output_schema=output_schema(EndEffectorMove),
        handler=mover,
    )
    return [move, *tools]

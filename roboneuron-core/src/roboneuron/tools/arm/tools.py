"""Tools of an arm: move_ee through the control module, move_joints directly."""

from __future__ import annotations

from roboneuron.server.host import Host
from roboneuron.server.tool import Tool
from roboneuron.tools.arm.ee_move import EndEffectorMove, MoveEndEffector
from roboneuron.tools.arm.end_effector import EndEffectorMover
from roboneuron.tools.arm.grasps import Grasp
from roboneuron.tools.arm.grip_height import GripHeight
from roboneuron.tools.arm.joints import joint_tools
from roboneuron.tools.arm.measured import MeasuredPose
from roboneuron.tools.arm.options import ArmToolsOptions
from roboneuron.tools.arm.picking import pick_tool
from roboneuron.tools.arm.placing import place_tool
from roboneuron.tools.arm.pushing import push_tool
from roboneuron.tools.arm.put_down import HeldObject
from roboneuron.tools.arm.several_arms import arguments_of, handler_of


def arm_tools(
    host: Host,
    options: ArmToolsOptions,
    poses: dict[str, MeasuredPose],
    grips: dict[str, GripHeight],
) -> list[Tool]:
    """Create move_ee, move_joints and place, for the robot among the exposed endpoints.

    `poses` and `grips` store the measurements, by namespace and arm.
    """
    gate = host.gate
    listed = gate.exposed
    tools = joint_tools(host, [e for e in listed if not e.hidden], gate)
    action = next((e for e in listed if e.control_input == "action"), None)
    if action is None or action.profile is None:
        return tools
    space, profile = action.namespace, action.profile
    tcps: dict[str, MeasuredPose] = {}
    hands: dict[str, GripHeight] = {}
    for arm in profile.each_arm:
        key = f"{space}/{arm.name}"
        tcp = tcps[arm.name] = poses.setdefault(key, MeasuredPose(host, space, arm.name))
        if arm.gripper is not None:
            grip = GripHeight(host, gate, action, tcp, arm.name)
            hands[arm.name] = grips.setdefault(key, grip)
    movers = {arm: EndEffectorMover(action, profile, host, options, tcps, arm) for arm in tcps}
    arguments = arguments_of(
        MoveEndEffector,
        movers,
        omitted=() if hands else ("gripper_open",),
        duration_s={"maximum": gate.max_duration_s},
    )
    move: Tool = Tool(
        name="move_ee",
        title="Move the end effector",
        description=(
            f"Move the TCP of {_one_of(action.robot, [*movers])} by a delta in the base frame in a "
            f"straight line, at up to {options.ee_speed_m_s:g} m/s and "
            f"{options.ee_turn_rad_s:g} rad/s, and set the gripper. Needs start_control; refused "
            "while a policy has an instruction. Returns when the arm is measured there; an error "
            "says where it stopped and why."
        ),
        arguments=arguments,
        result=EndEffectorMove,
        handler=handler_of(movers),
        simulated_by=frozenset({"twin", "limits"}),
        open_world=True,
    )
    if not hands:
        return [move, *tools]

    def remember(arm: str, grasp: Grasp) -> None:
        hands[arm].watch()
        hands[arm].hold(HeldObject.seen(grasp.object, grasp.position_m, grasp.yaw_rad))

    return [
        move,
        *tools,
        pick_tool(host, movers, hands, options.hand, action.robot, remember),
        push_tool(host, movers, hands, options.hand, action.robot),
        place_tool(host, movers, hands, options.hand, action.robot),
    ]


def _one_of(robot: str, arms: list[str]) -> str:
    """Describe what a tool moves, for its description."""
    return repr(robot) if arms == [""] else f"one arm of {robot!r} ({' or '.join(arms)})"

"""The tools of an arm, and the endpoint that they use: move_ee through the control module, move_joints directly."""

from __future__ import annotations

from collections.abc import Iterable

from roboneuron.config import Config
from roboneuron.contract import Endpoint
from roboneuron.interfaces import load_interface
from roboneuron.ros.topics import ACTION
from roboneuron.server.direct.access import Access
from roboneuron.server.direct.arguments import Schema, boolean, object_schema
from roboneuron.server.direct.end_effector import EndEffectorMove, EndEffectorMover
from roboneuron.server.direct.endpoints import Exposed, Exposure
from roboneuron.server.direct.joints import joint_tools
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.schema import output_schema
from roboneuron.server.tool import DerivedTool

LABEL = "ee_delta"
_TYPE = "std_msgs/msg/Float64MultiArray"


def arm_endpoints(config: Config, exposed: Exposure) -> list[Exposed]:
    """The action topic of the configured robot, when that is an arm with an end effector."""
    mine = next((e for e in exposed.endpoints if e.robot == config.robot.name and e.profile is not None), None)
    if mine is None or mine.profile is None or not (mine.profile.arm_joints and mine.profile.tcp_link):
        return []
    endpoint = Endpoint(
        name=LABEL, kind="publish", topic=ACTION, type=_TYPE, summary="TCP deltas for control.",
        bounds={"data": (-1.0, 1.0)}, rate_hz=20.0,
    )  # fmt: skip
    return [
        Exposed(
            robot=mine.robot, namespace=mine.namespace, label=LABEL, endpoint=endpoint,
            interface=load_interface(_TYPE), profile=mine.profile, hidden=True,
        )
    ]  # fmt: skip


def arm_tools(endpoints: Iterable[Exposed], access: Access, loop: ClosedLoop) -> list[DerivedTool]:
    """move_ee and move_joints, for the arm among the endpoints."""
    listed = list(endpoints)
    tools = joint_tools(listed, access)
    action = next((e for e in listed if e.hidden and e.label == LABEL), None)
    if action is None or action.profile is None:
        return tools
    mover = EndEffectorMover(action, action.profile, access, loop)
    numbers = mover.numbers
    properties: dict[str, Schema] = {name: number.schema() for name, number in numbers.items()}
    if action.profile.gripper is None:
        del properties["gripper_open"]
    properties["dry_run"] = boolean("Only answer what would happen; nothing is sent.")
    config = loop.base.direct
    move = DerivedTool(
        name="move_ee",
        title="Move the end effector",
        description=(
            f"Move the TCP of {action.robot!r} by a delta in the base frame (translation in m, rotation vector in rad) "
            f"and set the gripper (0 closed .. 1 open), in a straight line at up to {config.ee_speed_m_s:g} m/s and "
            f"{config.ee_turn_rad_s:g} rad/s. Needs start_robot and start_control; refused while a policy runs. "
            "Returns what was measured when the arm is there; an error says where it stopped and why."
        ),
        input_schema=object_schema(properties),
        output_schema=output_schema(EndEffectorMove),
        handler=mover,
    )
    return [move, *tools]

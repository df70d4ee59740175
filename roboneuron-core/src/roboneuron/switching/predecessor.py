"""Subscriptions of a module in shadow to its predecessor: actions and commands until the
handover.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial

import numpy as np
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from roboneuron.contract import ACTION_LABEL, pose_from_message
from roboneuron.errors import InvalidInputError
from roboneuron.modules.control.module import ControlModule
from roboneuron.modules.inference.module import InferenceModule
from roboneuron.modules.module_host import Module
from roboneuron.switching.handover import TimedHandover

ACTION, EE_POSE, JOINT_COMMAND, JOINT_TRAJECTORY = (
    "action",
    "ee_pose",
    "joint_command",
    "joint_trajectory",
)
"""Topics of the contract, relative to the robot's namespace."""


def follow_predecessor(module: Module, handover: TimedHandover) -> None:
    """Subscribe, until cleanup, to the outputs of the predecessor of a module in shadow."""
    node = module.node
    if isinstance(module, InferenceModule):
        handover.period_s = lambda: module.executor.step_s
        node.subscribe(Float64MultiArray, ACTION, partial(_on_action, module, handover))
    elif isinstance(module, ControlModule):
        is_state = (
            module.config.control is not None and module.config.control.command == "joint_state"
        )
        commands = (JointState, JOINT_COMMAND) if is_state else (JointTrajectory, JOINT_TRAJECTORY)
        node.subscribe(PoseStamped, EE_POSE, partial(_on_pose, module, handover))
        node.subscribe(*commands, partial(_on_command, module, handover))


def _on_action(
    module: InferenceModule, handover: TimedHandover, message: Float64MultiArray
) -> None:
    """Count actions that move the arm until the handover; rows of another space are only
    counted.
    """
    dims, space = message.layout.dim, module.space
    is_ours = (dims[0].label if dims else ACTION_LABEL) == space.label
    values = message.data[: dims[0].size] if len(dims) > 1 else message.data  # without planned rows
    is_malformed = is_ours and len(values) != space.size
    if handover.has_sent("action") or is_malformed:
        return
    handover.hear_action()
    row = np.array(values) if is_ours else None
    module.executor.note_sent(row, time.monotonic(), module.node.now_ns())


def _on_pose(module: ControlModule, handover: TimedHandover, message: PoseStamped) -> None:
    try:
        handover.hear(pose_from_message(message), time.monotonic())
    except InvalidInputError:
        module.status.drop("malformed_pose")


def _on_command(
    module: ControlModule,
    handover: TimedHandover,
    message: JointTrajectory | JointState,
    info: Mapping[str, int],
) -> None:
    """Continue from a command of the previous control process."""
    sent_s = time.monotonic() - max(0.0, (time.time_ns() - int(info["source_timestamp"])) / 1e9)
    try:
        handover.hear(module.follow(message, sent_s), sent_s)
    except InvalidInputError:
        module.status.drop("malformed_command")

"""Names and times that the server and its module processes agree on."""

from __future__ import annotations

from roboneuron.config.models import ModuleKind as ModuleKind

MODULE_KINDS: tuple[ModuleKind, ...] = ("robot", "perception", "inference", "control")
ARM_KINDS: tuple[ModuleKind, ...] = ("robot", "control")
"""Modules that move the arm: after a stop they obey nothing until somebody asks for motion."""
INSTRUCTION_PARAMETER = "instruction"
"""ROS parameter of the inference node that sets the instruction without a restart."""
START_PARAMETER = "start"
"""ROS parameter of robot and control: the number of stops that was known when somebody asked for
motion; obeyed again when there was none since.
"""
NEEDS_NEW_START = "needs_new_start"
"""Counted in `dropped`: what came after a stop, before somebody asked for motion."""
EMERGENCY_STOP = "the emergency stop"
SERVER_SILENT = "the server gave no sign of life"
"""Reasons in `needs_start`."""
FAULT_DETAIL = "fault"
"""Key of `RobotState.detail`: what has stopped the robot by itself, such as a reflex; empty when
nothing has.
"""
LIMITS_PARAMETER = "limits"
"""ROS parameter of the control node: limits as JSON, tighter than the configured ones; empty for
these themselves.
"""
FOREIGN_REQUEST = "foreign_request"
"""Counted in `dropped`, and the newest one in words: a lifecycle or parameter request that is not
the server's.
"""
EMERGENCY_STOP_TOPIC = "emergency_stop"
"""std_msgs/Bool under the robot's namespace, reliable and transient local: True latches, False
releases.
"""
FUTURE_S = 0.1
"""How far the clock of another machine may be ahead of this one."""
FOLLOWING_NOTE = "following actions"
"""Note of control from an action on until it holds; a hold replaces what others have sent to the
joints.
"""
HOLD_DURATION_S = 0.05
"""Time that a hold gives the joints to be where they were measured."""
STATUS_PERIOD_S = 0.2
"""Every module reports on /diagnostics at least this often, and at once after a change."""

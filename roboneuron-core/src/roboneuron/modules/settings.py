"""Names and times shared by the server and its module processes."""

from __future__ import annotations

from roboneuron.config.models import ModuleKind as ModuleKind

MODULE_KINDS: tuple[ModuleKind, ...] = ("robot", "perception", "inference", "control")
"""Core's kinds; those that features add come after them."""
ARM_KINDS: tuple[ModuleKind, ...] = ("robot", "control")
"""Modules that move the arm: after a stop they refuse commands until motion is requested."""
INSTRUCTION_PARAMETER = "instruction"
"""ROS parameter of the inference node that sets the instruction without a restart."""
START_PARAMETER = "start"
"""ROS parameter of robot and control: the number of stops known when motion was requested; commands
are accepted again if there was no stop since.
"""
STOP_PARAMETER = "stop"
"""ROS parameter of robot, inference and control: the reason of a client's stop, which ends what
moves now. It is not latched: the next request for motion is obeyed.
"""
STOP_MOTION = "stop_motion"
"""Code of that stop, see `Module.stop`; the robot brakes."""
NEEDS_NEW_START = "needs_new_start"
"""Counted in `dropped`: commands between a stop and the next request for motion."""
EMERGENCY_STOP = "the emergency stop"
SERVER_SILENT = "the server gave no sign of life"
"""Reasons in `needs_start`."""
FAULT_DETAIL = "fault"
"""Key of `RobotState.detail`: fault with which the robot has stopped by itself, such as a reflex;
empty for none.
"""
LIMITS_PARAMETER = "limits"
"""ROS parameter of the control node: limits as JSON, tighter than the configured ones; empty for
the configured ones.
"""
FOREIGN_REQUEST = "foreign_request"
"""Counted in `dropped`, with the newest one as text: a lifecycle or parameter request that is not
the server's.
"""
REFUSED_COMMAND = "refused"
"""Value of the robot module's status: the newest joint command that was not executed, with the
reason and the foreign nodes that may have sent it.
"""
PLACES_CHECKED, PLACES_UNCHECKED = "places_checked", "places_unchecked"
"""Values of the robot module's status: whether places on the way of joint commands are checked, and
if not, why, with what to do.
"""
COLLISION_CHECKED = "collision_checked"
"""Value of control's status: whether distances between links are checked."""
EMERGENCY_STOP_TOPIC = "emergency_stop"
"""std_msgs/Bool under the robot's namespace, reliable and transient local: True latches, False
releases.
"""
FUTURE_S = 0.1
"""Tolerated lead of another machine's clock over this one."""
HOLDING_NOTE = "holding: "
"""Beginning of the status note of a module that holds the robot; the reason follows."""
FOLLOWING_NOTE = "following actions"
"""Control's status note from an action until the next hold; a hold replaces commands that other
nodes have sent to the joints.
"""
HOLD_DURATION_S = 0.05
"""Time that a hold gives the joints to return to their measured posture."""
STATUS_PERIOD_S = 0.2
"""Longest period of a module's reports on /diagnostics; changes are reported at once."""

"""Names and times that the server and its module processes agree on."""

from __future__ import annotations

from unicodedata import category

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
MAX_INSTRUCTION_LENGTH = 1000
"""Characters: models read a few dozen words, and the status repeats it five times a second."""
_BREAKS = "\t\n\r"
"""Control characters that may stand between the words of an instruction."""
GRIPPER_COMMANDED = "gripper_commanded"
"""Metric of the robot module: the opening that was last commanded, 0 closed .. 1 open, by whomever.
Of each of several arms under `arm_metric`.
"""


def arm_metric(name: str, arm: str) -> str:
    """Name of a metric of one arm: "left/gripper_open"; the plain name for the only arm."""
    return f"{arm}/{name}" if arm else name


def instruction_problem(text: str) -> str:
    """Why a text can be no instruction; empty when it can be one. ROS ends a text at NUL."""
    if len(text) > MAX_INSTRUCTION_LENGTH:
        return (
            f"The instruction is {len(text)} characters long, at most {MAX_INSTRUCTION_LENGTH} "
            "are allowed"
        )
    for place, character in enumerate(text):
        if category(character) in ("Cc", "Cs") and character not in _BREAKS:
            return (
                f"The instruction holds the control character U+{ord(character):04X} at "
                f"position {place}"
            )
    return ""


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
SHORTEST_STEP_S, FIRST_STEP_S = 0.02, 0.1
"""Time that control gives the arm for an action: that since the one before, at least the first; the
second one for an action after a pause.
"""
HOLD_SHARE = 0.75
"""Control holds after this share of `action_timeout_s`, so that the arm stands within all of it."""
FOLLOWING_NOTE = "following actions"
"""Note of control from an action on until it holds; a hold replaces what others have sent to the
joints.
"""
HOLD_DURATION_S = 0.05
"""Time that a hold gives the joints to be where they were measured."""
STATUS_PERIOD_S = 0.2
"""Every module reports on /diagnostics at least this often, and at once after a change."""

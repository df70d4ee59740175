"""Timed sending of commands, with a guaranteed end of the motion."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from roboneuron.contract import JointCommand, JointSample, RobotProfile
from roboneuron.direct_path.arbiter import ActiveMotion
from roboneuron.direct_path.exposed import stop_message
from roboneuron.direct_path.gate import Gate
from roboneuron.errors import NotReadyError, RefusedError, RoboNeuronError, StateError
from roboneuron.server.motion_gate import GateRequest, TimedCommand

if TYPE_CHECKING:
    from roboneuron.direct_path.writer import TopicWriter

TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
_HOLD_S = 0.1
"""Time of the trajectory that returns the joints to their measured positions."""


class Ending(StrEnum):
    """Cause of a motion's end; the values are words of messages."""

    NONE = "nothing could be sent to end it"
    STOP_MESSAGE = "the stop message was sent"
    HOLD = "the joints were told to hold"
    CONTROL = "control holds the arm"
    GOAL_ENDED = "the goal was ended"
    GOAL_UNCONFIRMED = "the goal was asked to end, but did not confirm"


@dataclass(frozen=True, kw_only=True, slots=True)
class MotionEnd:
    """End of a motion.

    Attributes:
        after_s: its duration [s].
        total_s: its planned duration [s]; None if unknown.
        ending: cause of the end.
        details: additional text, such as the position of the arm.
        cause: error that ended it early; None if it was completed.
        sent: number of messages, the one that ended it included.
    """

    after_s: float
    total_s: float | None = None
    ending: Ending = Ending.NONE
    details: str = ""
    cause: RoboNeuronError | None = None
    sent: int = 0

    def check(self) -> None:
        """Raise an error of the cause's kind that describes the end, unless the motion was
        completed.
        """
        if self.cause is None:
            return
        total = "" if self.total_s is None else f" s of the planned {self.total_s:.2f}"
        details = f" ({self.details})" if self.details else ""
        raise type(self.cause)(
            f"Ended early, after {self.after_s:.2f}{total} s; {self.ending}{details}: "
            f"{self.cause.message}",
            hint=self.cause.hint,
        ) from self.cause


def run(
    motion: ActiveMotion,
    writer: TopicWriter,
    gate: Gate,
    request: GateRequest,
    commands: Iterable[TimedCommand],
    *,
    joints: Callable[[], JointSample | None],
    total_s: float,
    details: Callable[[], str],
) -> MotionEnd:
    """Send each command when it is due, and end the motion in every case; see `DirectGate.play`.

    Args:
        motion: owned by the caller.
        writer: connected.
        gate: checks the messages that are not in `request`, which it has allowed.
        request: contains the messages that are known beforehand.
        commands: iterated when the next command is due.
        joints: the measured joints, for the hold at the end.
        total_s: planned duration of the motion, for messages.
        details: additional text for a motion that ended early.
    """
    exposed = motion.exposed
    judged = {id(message) for message in request.messages}
    began_s = time.monotonic()
    last: Any = None
    sent, failed, ending = 0, True, Ending.NONE
    cause: RoboNeuronError | None = None
    if exposed.endpoint.stop_message:
        motion.stop_now = lambda: writer.publish_if_possible(stop_message(exposed, time.time_ns()))
    try:
        for command in commands:
            motion.check()
            if command.message is not None:
                if sent and exposed.require_subscriber and not writer.matched():
                    raise NotReadyError(
                        f"The subscriber of {exposed.topic} is gone.", hint="Look at get_status."
                    )
                if id(command.message) not in judged:
                    gate.check_next(replace(request, messages=(command.message,)))
                writer.send(command.message, command.stamped)
                last, sent = command.message, sent + 1
            motion.sleep_until(command.due_s)
        failed = False
    except (RefusedError, StateError) as error:
        cause = error
    except NotReadyError as error:
        cause = _stop_behind(motion) or error
    finally:
        after_s = time.monotonic() - began_s
        if last is not None:
            ending = _end(motion, writer, last, joints, failed)
    if cause is not None and not sent:
        raise cause
    return MotionEnd(
        after_s=after_s,
        total_s=total_s,
        ending=ending,
        details=details() if cause is not None else "",
        cause=cause,
        sent=sent + int(ending in (Ending.STOP_MESSAGE, Ending.HOLD)),
    )


def _stop_behind(motion: ActiveMotion) -> RoboNeuronError | None:
    """The stop because of which something is not measured any more; None without one."""
    try:
        motion.check()
    except (RefusedError, StateError) as stop:
        return stop
    return None


def _end(
    motion: ActiveMotion,
    writer: TopicWriter,
    last: Any,
    joints: Callable[[], JointSample | None],
    moving: bool,
) -> Ending:
    """Send the end of the motion, if one is necessary and possible.

    The stop message was checked when the endpoint was exposed; neither it nor a hold passes the
    gate. Joints at the end of their command need none, unless it was a velocity command. Control
    holds the arm once actions stop.
    """
    exposed = motion.exposed
    message = stop_message(exposed, time.time_ns())
    if message is not None:
        writer.publish(message)
        return Ending.STOP_MESSAGE
    if exposed.control_input:
        return Ending.CONTROL
    if not exposed.endpoint.joint_limited or not (moving or _is_velocity(last)):
        return Ending.NONE
    message = _hold(last, joints(), exposed.profile)
    if message is None:
        return Ending.NONE
    writer.publish(message)
    return Ending.HOLD


def _is_velocity(message: Any) -> bool:
    """True if a joint command is a JointState of velocities only, which a robot follows until the
    next command.
    """
    return (
        hasattr(message, "velocity") and bool(len(message.velocity)) and not len(message.position)
    )


def _hold(message: Any, joints: JointSample | None, profile: RobotProfile | None) -> Any:
    """Create the command that keeps the joints of a command at their measured positions; None if
    one was not measured.

    Grippers keep their last command: fingers that are commanded to the position where an object
    blocks them lose their force.
    """
    if _is_velocity(message):
        return type(message)(name=list(message.name), velocity=[0.0] * len(message.name))
    fingers = {gripper.joint for gripper in profile.grippers} if profile is not None else set()
    named = message.joint_names if hasattr(message, "points") else message.name
    names = [name for name in named if name not in fingers]
    if joints is None or not names or any(name not in joints.names for name in names):
        return None
    position = [float(joints.position[joints.names.index(name)]) for name in names]
    if not hasattr(message, "points"):
        return type(message)(name=names, position=position)
    from roboneuron.ros import messages

    command = JointCommand(names=tuple(names), position=np.array(position), duration_s=_HOLD_S)
    return messages.to_joint_trajectory(command)

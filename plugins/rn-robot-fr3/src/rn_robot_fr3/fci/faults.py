"""Faults of the arm as states: one code, one sentence, and what a person does about it.

Facts: RobotMode and the error flags of libfranka (robot_state.h, errors.h); texts of its exceptions as seen with
franky-control 2.0.0 against franka-sim 1.1.7.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from roboneuron import ConfigurationError, NotReadyError, RoboNeuronError, UnsafeError

_RECOVER = "then call recover_robot"


@dataclass(frozen=True, kw_only=True, slots=True)
class Fault:
    """Why the arm does not move.

    Attributes:
        code: stable word.
        message: one sentence.
        hint: what a person does.
        stands: the cause is still there, so recovery is refused.
    """

    code: str
    message: str
    hint: str
    stands: bool = False

    def error(self) -> RoboNeuronError:
        """The error that every motion gets while this fault is not recovered."""
        return UnsafeError(f"The FR3 does not move ({self.code}): {self.message}", hint=self.hint)


USER_STOP = Fault(
    code="user_stop",
    message="the user stop is pressed.",
    hint=f"Release the external activation device or the stop button, {_RECOVER}.",
    stands=True,
)
GUIDING = Fault(
    code="guiding",
    message="somebody guides the arm by hand.",
    hint=f"Let go of the guiding button, {_RECOVER}.",
    stands=True,
)
NOT_OPERATIONAL = Fault(
    code="brakes_locked",
    message="the arm is not ready to move: its brakes are locked, or it is being configured.",
    hint=f"Unlock the joints and activate FCI in Desk, {_RECOVER}.",
    stands=True,
)

_BY_ERROR = {
    "communication_constraints_violation": Fault(
        code="communication_lost",
        message="too many commands in succession came late.",
        hint=f"Give the robot a network card of its own and the machine a real-time kernel and less load, {_RECOVER}.",
    ),
    "self_collision_avoidance_violation": Fault(
        code="self_collision",
        message="two links came too near to each other.",
        hint=f"Guide the arm apart by hand, {_RECOVER}.",
    ),
}
_LIMITS = ("joint_position_limits_violation", "joint_velocity_violation", "motion_generator_position_limits_violation")


def from_errors(errors: Iterable[str], mode: str) -> Fault:
    """The fault for the flags that are set, such as "joint_reflex", in a robot mode such as "Reflex"."""
    named = tuple(errors)
    for name in named:
        if name in _BY_ERROR:
            return _BY_ERROR[name]
    listed = ", ".join(named) or f"robot mode {mode}"
    if any(limit in name for name in named for limit in _LIMITS):
        return Fault(
            code="joint_limit",
            message=f"a joint reached a limit ({listed}).",
            hint=f"If it stands beyond its position limit, guide it back by hand; {_RECOVER}.",
        )
    return Fault(
        code="reflex",
        message=f"a reflex of the robot stopped it ({listed}).",
        hint=f"Make sure that nothing touches the arm, {_RECOVER}.",
    )


def from_mode(mode: str, errors: Iterable[str]) -> Fault | None:
    """The fault that a measured state shows, or None in a state in which the arm can move."""
    named = tuple(errors)
    if mode == "UserStopped":
        return USER_STOP
    if mode == "Guiding":
        return GUIDING
    if mode == "Other":
        return NOT_OPERATIONAL
    if mode == "Reflex" or named:
        return from_errors(named, mode)
    return None


def from_exception(error: Exception) -> Fault:
    """The fault that an exception of the client library means during operation."""
    kind, text = type(error).__name__, str(error).split("\n")[0]
    if "planner failed" in text:
        return Fault(
            code="planner_failed",
            message=f"the client library found no motion to the target, and the robot stopped ({text}).",
            hint=f"Lower dynamics_factor if it happens again; {_RECOVER}.",
        )
    if kind == "NetworkException":
        return Fault(
            code="communication_lost",
            message=f"the connection to the control box broke ({text}).",
            hint=f"Check the cable and that the control box runs, {_RECOVER}: it connects anew.",
        )
    flags = text[text.find("[") + 1 : text.rfind("]")] if "[" in text else ""
    return from_errors([flag.strip(' "') for flag in flags.split(",") if flag.strip()] or [text], "Reflex")


def while_connecting(error: Exception, host: str) -> RoboNeuronError:
    """The error for an exception of the client library while it connects to `host`."""
    kind, text = type(error).__name__, str(error).split("\n")[0]
    if kind == "RealtimeException":
        return ConfigurationError(
            f"This machine's kernel is not real-time: {text}",
            hint='Boot a PREEMPT_RT kernel, or set realtime = "ignored" for a simulator.',
        )
    if kind == "IncompatibleVersionException":
        return ConfigurationError(
            f"The robot at {host} speaks another protocol version: {text}",
            hint="Protocol 10 (robot system 5.9 or newer) is needed; update the robot, or install a matching client.",
        )
    return NotReadyError(
        f"The robot at {host} refused the connection: {text}",
        hint="Unlock the joints, activate FCI in Desk, and make sure that no other client is connected.",
    )


def unreachable(host: str, reason: str) -> NotReadyError:
    """Nobody answers at `host`."""
    return NotReadyError(
        f"Nobody answers at {host} on the FCI's port 1337: {reason}.",
        hint="Check cable, address and that FCI is activated in Desk; for a simulator start it first.",
    )


def silent(host: str, timeout_s: float) -> NotReadyError:
    """The control box accepts connections and says nothing."""
    return NotReadyError(
        f"The control box at {host} accepts the connection but did not answer within {timeout_s:g} s.",
        hint="Another client is connected, or FCI is not active: end the other client, activate FCI in Desk.",
    )

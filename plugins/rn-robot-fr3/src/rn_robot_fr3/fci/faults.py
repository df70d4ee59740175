"""Faults of the arm as states: a code, a sentence, and the remedy for a person.

Facts: RobotMode and the error flags of libfranka (robot_state.h, errors.h); texts of its exceptions
(robot_impl.h) as seen with pylibfranka 0.21.3 against franka-sim 1.1.7. The FCI gives no reason for
the mode "Other".
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from roboneuron import ConfigurationError, NotReadyError, RefusedError, RoboNeuronError, UnsafeError

_RECOVER = "then call recover_robot"


@dataclass(frozen=True, kw_only=True, slots=True)
class ArmFault:
    """Reason why the arm does not move.

    Attributes:
        code: stable word.
        message: one sentence.
        hint: what a person has to do.
        stands: the cause persists, so recovery is refused.
    """

    code: str
    message: str
    hint: str
    stands: bool = False

    def error(self) -> RoboNeuronError:
        """The error of every motion until this fault is recovered."""
        return UnsafeError(f"The FR3 does not move ({self.code}): {self.message}", hint=self.hint)


USER_STOP = ArmFault(
    code="user_stop",
    message="the user stop is pressed.",
    hint=f"Release the external activation device or the stop button, {_RECOVER}.",
    stands=True,
)
GUIDING = ArmFault(
    code="guiding",
    message="somebody guides the arm by hand.",
    hint=f"Let go of the guiding button, {_RECOVER}.",
    stands=True,
)
NOT_OPERATIONAL = ArmFault(
    code="brakes_locked",
    message='the arm is not ready to move (robot mode "Other"): its brakes are closed, FCI is not '
    "active, a self-test "
    "is due or running, or Desk is configuring it; the FCI does not say which.",
    hint="In Desk: run the self-test if one is due, unlock the joints, choose Execution and "
    f"activate FCI; {_RECOVER}. "
    "recover_robot itself opens no brakes.",
    stands=True,
)
RECOVERING = ArmFault(
    code="recovering",
    message="the control box is still recovering from an error.",
    hint=f"Wait a few seconds, {_RECOVER}.",
    stands=True,
)
_SAFETY_FUNCTION = ArmFault(
    code="safety_function",
    message="a safety function of the control box is active: a self-test is due, or a safety rule "
    "has stopped the arm.",
    hint="In Desk: look at the safety status, run the self-test or end what has triggered; "
    f"{_RECOVER}.",
)
_WRONG_MODE = ArmFault(
    code="not_possible_now",
    message="the control box says that this is not possible in its present mode.",
    hint=f"In Desk: joints unlocked, Execution chosen, FCI active, no error shown; {_RECOVER}.",
)
_MANUAL = ArmFault(
    code="manual_recovery",
    message="the control box wants a person to clear this error.",
    hint="In Desk: follow the shown steps, such as guiding the arm back into its limits; "
    f"{_RECOVER}.",
)
_STANDING = {"UserStopped": USER_STOP, "Guiding": GUIDING, "Other": NOT_OPERATIONAL}
_STANDING["AutomaticErrorRecovery"] = RECOVERING
_BY_TEXT = {
    "safety function": _SAFETY_FUNCTION,
    "manual error recovery": _MANUAL,
    "not possible in the current mode": _WRONG_MODE,
}

_BY_ERROR = {
    "communication_constraints_violation": ArmFault(
        code="communication_lost",
        message="too many commands in succession came late.",
        hint="Give the robot a network card of its own and the machine a real-time kernel and "
        f"less load, {_RECOVER}.",
    ),
    "self_collision_avoidance_violation": ArmFault(
        code="self_collision",
        message="two links came too near to each other.",
        hint=f"Guide the arm apart by hand, {_RECOVER}.",
    ),
}
_LIMITS = (
    "joint_position_limits_violation",
    "joint_velocity_violation",
    "motion_generator_position_limits_violation",
)


def from_errors(errors: Iterable[str], mode: str) -> ArmFault:
    """Return the fault for the set flags, such as "joint_reflex", in a robot mode such as
    "Reflex".
    """
    named = tuple(errors)
    for name in named:
        if name in _BY_ERROR:
            return _BY_ERROR[name]
    listed = ", ".join(named) or f"robot mode {mode}"
    if any(limit in name for name in named for limit in _LIMITS):
        return ArmFault(
            code="joint_limit",
            message=f"a joint reached a limit ({listed}).",
            hint=f"If it stands beyond its position limit, guide it back by hand; {_RECOVER}.",
        )
    if named and all(name.endswith("_discontinuity") for name in named):
        return ArmFault(
            code="commands_disordered",
            message=f"the arm counted a jump in its commands ({listed}). The driver sends none: "
            "packets came late, "
            "twice or out of order.",
            hint="Give the robot a network card of its own without a switch, run roboneuron robot "
            f"fr3 check, {_RECOVER}.",
        )
    return ArmFault(
        code="reflex",
        message=f"a reflex of the robot stopped it ({listed}).",
        hint=f"Make sure that nothing touches the arm, {_RECOVER}.",
    )


def from_mode(mode: str, errors: Iterable[str]) -> ArmFault | None:
    """Return the fault shown by a measured state, or None if the arm can move."""
    named = tuple(errors)
    if mode in _STANDING:
        return _STANDING[mode]
    if mode == "Reflex" or named:
        return from_errors(named, mode)
    return None


def from_exception(error: Exception) -> ArmFault:
    """Return the fault for an exception of the client library during operation."""
    kind, text = _named(error)
    if kind == "PlannerException":
        return ArmFault(
            code="planner_failed",
            message=f"no motion to the target was found, and the arm stopped ({text}).",
            hint=f"Lower dynamics_factor if it happens again; {_RECOVER}.",
        )
    if kind == "CommunicationLost":
        return ArmFault(
            code="communication_lost",
            message=f"{text}, so the motion was ended.",
            hint=_BY_ERROR["communication_constraints_violation"].hint,
        )
    if kind == "NetworkException":
        return ArmFault(
            code="communication_lost",
            message=f"the connection to the control box broke ({text}).",
            hint="Check the cable, that the control box runs and that FCI is still active in "
            f"Desk, {_RECOVER}: it "
            "connects anew.",
        )
    for words, fault in _BY_TEXT.items():
        if words in text:
            return fault
    flags = text[text.find("[") + 1 : text.rfind("]")] if "[" in text else ""
    return from_errors(
        [flag.strip(' "') for flag in flags.split(",") if flag.strip()] or [text], "Reflex"
    )


def settings_refused(text: str) -> ArmFault:
    """The control box refused its settings, with `text` from the client library."""
    return ArmFault(
        code="settings_refused",
        message=f"the control box does not take collision thresholds and load ({text}).",
        hint=f"If Desk shows an error, do what it says; {_RECOVER}: it clears errors first and "
        "sets them afterwards.",
    )


def still(fault: ArmFault, error: Exception) -> RefusedError:
    """The error for a recovery from `fault` that failed with `error`; the fault remains for any
    number of tries.
    """
    _, text = _named(error)
    reasons = (found.message for words, found in _BY_TEXT.items() if words in text)
    hint = next((found.hint for words, found in _BY_TEXT.items() if words in text), fault.hint)
    return RefusedError(
        f"The FR3 cannot be recovered ({fault.code}): {next(reasons, text)}",
        hint=hint,
        rule="recovery",
    )


def _named(error: Exception) -> tuple[str, str]:
    """Class and first line of an exception of the client library, raised here or in the control
    process.
    """
    return getattr(error, "kind", type(error).__name__), str(error).split("\n")[0]


def while_connecting(error: Exception, host: str) -> RoboNeuronError:
    """The error for an exception of the client library while connecting to `host`."""
    kind, text = _named(error)
    if kind == "RealtimeException":
        return ConfigurationError(
            f"This machine's kernel is not real-time: {text}",
            hint='Boot a PREEMPT_RT kernel, or set realtime = "ignored" for a simulator.',
        )
    if kind == "IncompatibleVersionException":
        return ConfigurationError(
            f"The robot at {host} speaks another protocol version: {text}",
            hint="Protocol 10 (robot system 5.9 or newer) is needed; update the robot, or install "
            "a matching client.",
        )
    return NotReadyError(
        f"The robot at {host} refused the connection: {text}",
        hint="Unlock the joints, activate FCI in Desk, and make sure that no other client is "
        "connected.",
    )


def unreachable(host: str, reason: str) -> NotReadyError:
    """The error if nothing answers at `host`."""
    return NotReadyError(
        f"Nobody answers at {host} on the FCI's port 1337: {reason}.",
        hint="Check the cable and the address. FCI is not active: activate it in Desk. A "
        "simulator: start it first.",
    )


def silent(host: str, timeout_s: float) -> NotReadyError:
    """The error if the control box accepts connections but does not answer."""
    return NotReadyError(
        f"The control box at {host} accepts the connection but did not answer within "
        f"{timeout_s:g} s.",
        hint="Another client is connected, or FCI is not active: end the other client, activate "
        "FCI in Desk.",
    )

"""What the limits made of one command: what was asked, what may be sent, and which limits acted."""

from __future__ import annotations

from dataclasses import dataclass

from roboneuron.contract import Hold, JointCommand


@dataclass(frozen=True, kw_only=True, slots=True)
class Motion:
    """One command in numbers.

    Attributes:
        step_m, step_rad: how far the TCP would go from where it is measured.
        speed_m_s, turn_rad_s: how fast it would go there from the posture commanded so far.
        joint_speed: velocity of the fastest joint [rad/s or m/s].
        smallest_singular_value: at the end of the step; None when the controller cannot tell.
    """

    step_m: float
    step_rad: float
    speed_m_s: float
    turn_rad_s: float
    joint_speed: float
    smallest_singular_value: float | None = None


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Verdict:
    """The answer to one command.

    Attributes:
        command: what to send, a reason to hold, or None: the action is refused, what was sent before goes on.
        acted: names of the limits that changed or stopped the command, from `LIMITS`; empty when it is as asked.
        reason: one sentence for the last of them, with the numbers; empty likewise.
        share: length of the sent way through joint space over that of the asked one; 1 when it is as asked.
        asked: None when the command made no sense (non-finite, unknown joints).
        sent: None when nothing is sent or the arm is to hold.
        reference_lost: the measured joints were not where the commands should have brought them.
    """

    command: JointCommand | Hold | None
    acted: tuple[str, ...] = ()
    reason: str = ""
    share: float = 1.0
    asked: Motion | None = None
    sent: Motion | None = None
    reference_lost: bool = False

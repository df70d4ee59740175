"""How a motion ended, as a value: one text for every way of moving a robot."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from roboneuron.errors import RoboNeuronError
from roboneuron.gate import Verdict


class Ending(StrEnum):
    """What brought a motion to its end; the values are words of messages."""

    NONE = "nothing could be sent to end it"
    STOP_MESSAGE = "the stop message was sent"
    HOLD = "the joints were told to hold"
    CONTROL = "control holds the arm"
    GOAL_ENDED = "the goal was ended"
    GOAL_UNCONFIRMED = "the goal was asked to end, but did not confirm"


@dataclass(frozen=True, kw_only=True, slots=True)
class MotionEnd:
    """How a motion ended.

    Attributes:
        after_s: how long it lasted.
        total_s: how long it was to last; None when nobody knows.
        ending: what ended it.
        details: more about that, such as where the arm is.
        cause: why it ended early; None when it came to its end.
        sent: messages, the one that ended it included.
    """

    after_s: float
    total_s: float | None = None
    ending: Ending = Ending.NONE
    details: str = ""
    cause: RoboNeuronError | None = None
    sent: int = 0

    def check(self) -> None:
        """Raise an error of the cause's kind that tells how the motion ended, unless it came to its end."""
        if self.cause is None:
            return
        total = "" if self.total_s is None else f" of {self.total_s:.2f}"
        details = f" ({self.details})" if self.details else ""
        raise type(self.cause)(
            f"Ended after {self.after_s:.2f}{total} s, {self.ending}{details}: {self.cause.message}",
            hint=self.cause.hint,
        ) from self.cause


@dataclass(frozen=True, kw_only=True, slots=True)
class Sent:
    """What was sent, to how many; nothing when `verdict` does not allow it.

    Attributes:
        verdict: the gate's answer.
        messages: repetitions and the stop message included.
        subscribers: how many were matched then.
        duration_s: how long it took.
        stopped: a message that stops was sent at the end.
    """

    verdict: Verdict
    messages: int = 0
    subscribers: int = 0
    duration_s: float = 0.0
    stopped: bool = False

"""Answers of the gate: what it allows, and what was sent."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class Clamp:
    """A value that was moved to a bound: path, requested value, sent value."""

    path: str
    asked: float
    sent: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Verdict:
    """The gate's answer.

    Attributes:
        allowed: no rule refuses it.
        simulated: nothing may be sent even if allowed.
        reason: reason of the refusal; empty when allowed.
        rule: the rule that refused ("allow_list", "role", "type", "finite", "bounds", "steering",
            "joints", the name of a limit of `[limits]`, "path", "rate", "emergency_stop", "audit");
            empty when allowed.
        clamped: values that were changed in the messages.
    """

    allowed: bool
    simulated: bool = False
    reason: str = ""
    rule: str = ""
    clamped: tuple[Clamp, ...] = ()

    @property
    def may_send(self) -> bool:
        """True if the messages have to be sent now."""
        return self.allowed and not self.simulated


@dataclass(frozen=True, kw_only=True, slots=True)
class Sent:
    """Sent messages and their number of subscribers; nothing if `verdict` does not allow it.

    Attributes:
        verdict: the gate's answer.
        messages: number of messages, with repetitions and the stop message.
        subscribers: number of matched subscribers.
        duration_s: duration of sending.
        stopped: a stop message was sent at the end.
    """

    verdict: Verdict
    messages: int = 0
    subscribers: int = 0
    duration_s: float = 0.0
    stopped: bool = False

"""Decision on the end and the outcome of a run, from successive statuses, without any input or
output.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

from rn_standard.console.status import ServerStatus, SimulatedObject, simulated_objects
from rn_standard.console.table import fault_text

HELD_S = 1.0
"""Time for which a simulated object has to be lifted to count as picked up."""
PATIENCE_S = 4.0
"""Duration of a fault that ends the run; shorter ones are, for example, a late image on a busy
machine or a module being restarted.
"""
DONE_METRIC = "done"
"""Metric of a backend's action chunks that reports its own end: 1 finished, 0 not yet."""


class RunOutcome(IntEnum):
    """Outcome of a run; the value is the exit status."""

    DONE = 0
    NOT_DONE = 1
    UNKNOWN = 3
    INTERRUPTED = 130


@dataclass(frozen=True, kw_only=True, slots=True)
class RunEnd:
    """The end of a run.

    Attributes:
        reason: one sentence, without its full stop.
    """

    outcome: RunOutcome
    reason: str


class RunJudge:
    """Evaluates each status of a run; used for one run only.

    The simulator's report takes precedence, if it knows the object in the instruction; otherwise
    the backend's own report is used.

    Args:
        instruction: instruction for the robot.
        timeout_s: longest duration of the run [s].
    """

    def __init__(self, instruction: str, timeout_s: float) -> None:
        words = instruction.lower().replace(",", " ").replace(".", " ").split()
        self._words = set(words)
        self._timeout_s = timeout_s
        self._faulty_since_s: dict[str, float] = {}
        self._claimed_since_s = math.inf

    def target(self, status: ServerStatus) -> tuple[str, SimulatedObject] | None:
        """The one simulated object named in the instruction, or None."""
        named = [
            (n, o)
            for n, o in simulated_objects(status.module("robot")).items()
            if n.lower() in self._words
        ]
        return named[0] if len(named) == 1 else None

    def look(self, status: ServerStatus, elapsed_s: float) -> RunEnd | None:
        """The verdict at `elapsed_s` after the first action, or None while the run continues."""
        if status.emergency_stop:
            cause = f" by {status.emergency_stop_cause}" if status.emergency_stop_cause else ""
            return _not_done(f"the emergency stop was latched{cause}")
        target = self.target(status)
        if target is not None and target[1].held_s >= HELD_S:
            lift = (
                f"lifted by {target[1].lifted_m * 100:.0f} cm and held for {target[1].held_s:.1f} s"
            )
            return RunEnd(
                outcome=RunOutcome.DONE, reason=f"the simulator says that {target[0]} is {lift}"
            )
        if (fault := self._fault(status, elapsed_s)) is not None:
            return fault
        inference = status.module("inference")
        claims = inference is not None and _is_one(inference.metrics.get(DONE_METRIC, ""))
        self._claimed_since_s = min(self._claimed_since_s, elapsed_s) if claims else math.inf
        if claims and target is None:
            return RunEnd(
                outcome=RunOutcome.DONE, reason="the backend reports that it has finished"
            )
        if elapsed_s - self._claimed_since_s > PATIENCE_S and target is not None:
            lift = f"lifted by {target[1].lifted_m * 100:.0f} cm"
            return _not_done(
                f"the backend reports that it has finished, the simulator that {target[0]} is "
                f"{lift}"
            )
        if elapsed_s < self._timeout_s:
            return None
        if target is not None:
            return _not_done(f"{self._timeout_s:g} s are over and {target[0]} is not lifted")
        if inference is not None and DONE_METRIC in inference.metrics:
            return _not_done(f"{self._timeout_s:g} s are over and the backend has not finished")
        reason = (
            f"{self._timeout_s:g} s are over; neither the backend nor a simulator tells "
            "whether it is done"
        )
        return RunEnd(outcome=RunOutcome.UNKNOWN, reason=reason)

    def _fault(self, status: ServerStatus, elapsed_s: float) -> RunEnd | None:
        for kind in ("robot", "perception", "control", "inference"):
            module = next((m for m in status.modules if m.module == kind), None)
            if module is None or not (module.is_faulty or module.health == "stopped"):
                self._faulty_since_s.pop(kind, None)
                continue
            since_s = self._faulty_since_s.setdefault(kind, elapsed_s)
            if elapsed_s - since_s > PATIENCE_S:
                return _not_done(f"{kind}: {fault_text(module).rstrip('.')}")
        return None


def _not_done(reason: str) -> RunEnd:
    return RunEnd(outcome=RunOutcome.NOT_DONE, reason=reason)


def _is_one(text: str) -> bool:
    try:
        return float(text) >= 0.5
    except ValueError:
        return False

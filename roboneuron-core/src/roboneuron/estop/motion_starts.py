"""Starts of motion: after a stop was released, motion begins again only when it is requested.

A module keeps still by itself after a stop (`ModuleNode.require_start`). The server does the same
for stops that a module cannot know: other modules that died, froze, were stopped or restarted. It
also records which caller gave the policy its instruction, so that the end of a task withdraws it
from every process.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Final

from roboneuron.errors import NotReadyError, RefusedError, RoboNeuronError, StateError
from roboneuron.estop import motion_stop
from roboneuron.estop.motion_claims import MotionClaims
from roboneuron.gate import StillReason
from roboneuron.modules.settings import (
    ARM_KINDS,
    EMERGENCY_STOP,
    INSTRUCTION_PARAMETER,
    START_PARAMETER,
    ModuleKind,
)
from roboneuron.supervisor.health import ModuleView
from roboneuron.supervisor.slot import Slot
from roboneuron.supervisor.supervisor import Supervisor

log = logging.getLogger(__name__)
_TOLD_S = 1.0
"""A policy that does not withdraw its instruction within this time is ended."""
_PERMITTED_S = 5.0
"""Timeout of a module's answer to a permission, and of its report of it."""
_SETTLED_S = 5.0
"""Timeout for withdrawals in progress; each ends within `_TOLD_S` or with its process."""


class MotionStarts:
    """Requests for motion, and the stops that ended them; usable from any thread.

    Attributes:
        stops: number of stops; requests from before the newest one are void.
        arm_stops: those that end every motion, also of agents; not the loss of a camera or of the
            policy.
        reason: the newest stop.
        claims: who may move each robot.
        ticket: number of the newest instruction or of its end, by which its caller sees whether it
            is still valid.
        AGAIN: hint for the client that releases a stop.
    """

    AGAIN: Final = (
        "Nothing moves by itself: give an instruction (set_instruction, run_task) or move the arm "
        "to go on."
    )

    def __init__(self, supervisor: Supervisor) -> None:
        """Args:
        supervisor: supervisor of the modules.
        """
        self._supervisor = supervisor
        # Guards the counts; no module is called while it is held.
        self._lock = threading.Lock()
        # by process id: stops that it has reported
        self._seen: dict[int, int] = {}
        # process ids of the modules whose loss was counted
        self._lost: dict[ModuleKind, int] = {}
        self._was_latched = False
        self._telling: list[threading.Thread] = []
        self.claims = MotionClaims(supervisor)
        self.stops = self.arm_stops = self.ticket = 0
        self.reason = ""

    @property
    def instruction(self) -> str:
        """The policy's newest instruction; empty if withdrawn."""
        return self.claims.instruction

    def look(self, is_latched: bool | None = None) -> Sequence[ModuleView]:
        """Return the modules; count the stops since the last call, which end the requests for
        motion.

        Args:
            is_latched: state of the emergency stop; None if it was not checked now.
        """
        views = self._supervisor.views()
        with self._lock:
            is_back = "inference" in {view.kind for view in views if self._is_back(view)}
            reasons = [(reason, view.kind) for view in views if (reason := self._news(view))]
            is_pressed = is_latched is True and not self._was_latched
            self._was_latched = self._was_latched if is_latched is None else is_latched
        if is_pressed:
            self.note_stop(EMERGENCY_STOP)
        for reason, kind in reasons:
            self.note_stop(reason, holds_arm=kind in ARM_KINDS)
        # a policy that was lost could not be told; it detects the other ones itself
        if is_back or any(
            kind != "inference" and reason != EMERGENCY_STOP for reason, kind in reasons
        ):
            self._take_back_soon()
        return views

    def note_stop(self, reason: str, *, holds_arm: bool = True, is_asked: bool = False) -> None:
        """Record a stop; does not wait.

        Args:
            reason: reason as text.
            holds_arm: it ends every motion; otherwise only that of the policy.
            is_asked: requested by a client that stopped a module and may start it again.
        """
        with self._lock:
            self.stops += 1
            self.reason, self.claims.instruction = reason, ""
            self.ticket += 1
            self.arm_stops += holds_arm
            if holds_arm and not is_asked:
                self._supervisor.needs_start = reason

    def stop(self, kind: ModuleKind, reason: str, *, is_asked: bool) -> None:
        """Record that a module was stopped or will be restarted automatically: the policy's
        instruction is withdrawn.
        """
        self.note_stop(reason, holds_arm=kind in ARM_KINDS, is_asked=is_asked)
        self._take_back()

    def stop_motion(self, reason: str) -> dict[ModuleKind, str]:
        """End all motion of the robot on a client's request. Nothing is latched: the next request
        for motion is obeyed. Blocks until each module has confirmed it.

        Args:
            reason: the stop as text.

        Returns:
            Why it is not confirmed, by the modules that were asked; empty texts if it is.
        """
        is_instructed = bool(self.instruction)
        self.note_stop(reason)
        if is_instructed:
            motion_stop.cancel_starting_policy(self._supervisor, reason)
        slots = [slot for kind in (*ARM_KINDS, "inference") for slot in self._running(kind)]
        failures = motion_stop.stop_modules(self._supervisor, slots, reason, self._set)
        self.look()  # their reports are of this stop, and void no later request
        return failures

    def are_needed(self) -> bool:
        """True if a stop keeps a module still until `permit`, or one is lost."""
        if not self._lost.keys().isdisjoint(ARM_KINDS):
            return True
        with self._supervisor.changes.lock:
            slots = [slot for kind in ARM_KINDS for slot in self._supervisor.slots[kind]]
            reports = [slot.report for slot in slots if slot.phase == "running"]
            return any(report is not None and report.needs_start for report in reports)

    def still_reason(self) -> StillReason | None:
        """Why nothing moves after a stop until it is asked for again; None if there was none."""
        with self._supervisor.changes.lock:
            slots = [slot for kind in ARM_KINDS for slot in self._supervisor.slots[kind]]
            told = [slot.report.needs_start for slot in slots if slot.report is not None]
        stop = self._supervisor.needs_start or next(filter(None, told), "")
        if not stop:
            return None
        return StillReason(
            rank="start",
            rule="new_start",
            message=f"Motion needs a new start after a stop: {stop}.",
            hint=self.AGAIN,
        )

    def permit(self, arm_stops: int | None = None) -> int:
        """Permit motion on a client's request: modules that a stop keeps still accept commands
        again. Return `stops`, see `check`.

        Args:
            arm_stops: the count when the request was made; None for now.

        Raises:
            RefusedError: a module reports another stop since.
            NotReadyError: a module does not answer, or is frozen.
            StateError: as `check`, or there was a stop since the request.
        """
        self.look()
        self.settle()
        # when the request was made: a stop since then voids it, and is not ended by it
        count = self.stops - (0 if arm_stops is None else self.arm_stops - arm_stops)
        self.check(count)
        self._arm()
        with self._lock:
            if self.stops == count:  # otherwise `check` raises, and the stop stays
                self._supervisor.needs_start = ""
        self.check(count)
        return count

    def arm_started(self) -> None:
        """Permit motion for modules started since `permit`; does nothing if there was a
        stop since.
        """
        self.look()
        if self._supervisor.needs_start:
            return
        try:
            self._arm()
        except RoboNeuronError as error:
            log.warning("What was started keeps still: %s", error)

    def _arm(self) -> None:
        """Permit motion in robot and control, and in their successors. Raises as `permit`."""
        for kind in ARM_KINDS:
            for slot in self._running(kind):
                slot.check_alive("motion is asked for")
                report = slot.report
                if report is None or not report.needs_start or slot.process is None:
                    continue
                # newer than the request
                if report.stops != self._seen.get(slot.process.pid):
                    raise RefusedError(
                        f"{kind} needs a new start meanwhile: {report.needs_start}.",
                        hint="Ask again.",
                        rule="new_start",
                    )
                if refused := self._set(slot, {START_PARAMETER: report.stops}, _PERMITTED_S):
                    raise RefusedError(
                        f"{kind} keeps still: {refused}.", hint="See get_status.", rule="new_start"
                    )
                self._await_obeying(slot, report.stops)

    def check(self, stops: int) -> None:
        """Raise if motion was forbidden since `permit`.

        Args:
            stops: returned by `permit`.

        Raises:
            StateError: there was one; the message names it.
        """
        if self.stops != stops:
            raise StateError(
                f"Motion was forbidden meanwhile: {self.reason}. Nothing moves.", hint="Ask again."
            )

    def begin(self, text: str) -> int:
        """Register the start or replacement of a policy; return the ticket of its instruction.

        Args:
            text: the instruction; empty for none.

        Raises:
            RefusedError: it is an instruction, and something else moves the robot.
        """
        with self.claims.admit(text), self._lock:
            self.claims.instruction = text
            self.ticket += 1
            return self.ticket

    def give(self, text: str, timeout_s: float) -> tuple[int, str]:
        """Send an instruction to the working policy and its successor; return the ticket, and the
        reason of a refusal.

        Args:
            text: the instruction.
            timeout_s: bound on each answer [s].

        Raises:
            RefusedError: as `begin`.
            StateError: no policy runs.
            NotReadyError: it does not answer; it is ended, because it may still obey later.
        """
        ticket = self.begin(text)
        try:
            slots = self._running("inference")
            if not slots:
                self._supervisor.require_running("inference")
            refused = [self._set(slot, {INSTRUCTION_PARAMETER: text}, timeout_s) for slot in slots]
        except RoboNeuronError:
            self.withdraw(ticket)
            raise
        if any(refused):
            self.withdraw(ticket)
        return ticket, "; ".join(filter(None, refused))

    def withdraw(self, ticket: int) -> None:
        """Withdraw an instruction from every process that has it; a process that does not answer is
        ended.

        Does nothing if another instruction was given since, or a stop has ended it.
        """
        with self._lock:
            is_ours = self.ticket == ticket
            if is_ours:
                self.claims.instruction = ""
                self.ticket += 1
        if is_ours:
            self._take_back()
        self.settle()

    def follow(self, slot: Slot, ticket: int) -> None:
        """Send the present instruction to a policy that has just started, if it changed during the
        start.

        Args:
            slot: slot of the policy.
            ticket: ticket of its start, see `begin`.

        Raises:
            StateError: it does not drop its instruction.
            NotReadyError: it does not answer.
        """
        if self.ticket != ticket and self._set(
            slot, {INSTRUCTION_PARAMETER: self.instruction}, _PERMITTED_S
        ):
            raise StateError("The policy did not drop its instruction.")

    def settle(self) -> None:
        """Wait until instructions ended by a stop are withdrawn."""
        with self._lock:
            telling = list(self._telling)
        for thread in telling:
            thread.join(_SETTLED_S)

    def _is_back(self, view: ModuleView) -> bool:
        """True if a lost process works again; the lock is held."""
        if view.process is None or view.loss():
            return False
        return self._lost.pop(view.kind, None) == view.process.pid

    def _news(self, view: ModuleView) -> str:
        """Stop by a module that is not counted yet, which it reports or which is its loss; the lock
        is held.
        """
        if view.process is None:
            return ""
        pid, report = view.process.pid, view.report
        if loss := view.loss():
            is_new = self._lost.get(view.kind) != pid
            self._lost[view.kind] = pid
            return f"{view.kind} {loss}" if is_new else ""
        if report is None:
            return ""
        before = self._seen.setdefault(pid, report.stops)
        self._seen[pid] = report.stops
        return (report.needs_start or "a stop") if report.stops > before else ""

    def _take_back_soon(self) -> None:
        """Withdraw the instruction on another thread, so that the caller does not wait for a
        module.
        """
        with self._lock:
            thread = threading.Thread(target=self._take_back, name="take-back", daemon=True)
            thread.start()  # before it is listed: `settle` joins it
            self._telling = [other for other in self._telling if other.is_alive()] + [thread]

    def _take_back(self) -> None:
        """Withdraw the instruction from every policy; one that cannot be reached is ended, because
        it would continue to move.
        """
        for slot in self._running("inference"):
            try:
                if self._set(slot, {INSTRUCTION_PARAMETER: ""}, _TOLD_S):
                    raise StateError("The policy did not drop its instruction.")
            except RoboNeuronError as error:
                log.error("The policy is ended, because it could not be told to stop: %s", error)
                with suppress(StateError):
                    self._supervisor.end(slot)

    def _running(self, kind: ModuleKind) -> list[Slot]:
        """Slots of the working module and of its successor."""
        with self._supervisor.changes.lock:
            return [slot for slot in self._supervisor.slots[kind] if slot.phase == "running"]

    def _set(self, slot: Slot, values: Mapping[str, str | int], timeout_s: float) -> str:
        """Set parameters of a module; return the reason of a refusal, empty if accepted."""
        client = self._supervisor.parameters(slot)
        return client.set(values, timeout_s, lambda: slot.check_alive("told what to do"))

    def _await_obeying(self, slot: Slot, stops: int) -> None:
        """Wait until a module reports that motion is permitted, or another stop, which `check`
        raises.

        Raises:
            NotReadyError: it reports neither.
        """

        def obeys() -> bool:
            report = slot.report
            return report is not None and (not report.needs_start or report.stops != stops)

        if not self._supervisor.changes.wait_for(obeys, _PERMITTED_S):
            raise NotReadyError(
                f"{slot.kind} has not confirmed that it accepts commands again.",
                hint="See get_status.",
            )

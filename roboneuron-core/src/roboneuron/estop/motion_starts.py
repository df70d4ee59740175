"""Starts of motion: a stop is over when it was released, and motion begins again only when somebody
asks for it.

The modules keep still by themselves after a stop (`ModuleNode.require_start`). Here the server
knows the same of what no module can know: others that have died, were stopped or restarted. And it
knows who has given the policy its instruction, so that whoever ends a task takes it back from every
process that holds it.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

from roboneuron.errors import NotReadyError, RefusedError, RoboNeuronError, StateError
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
"""What does not take its instruction back within this time is ended."""
_PERMITTED_S = 5.0
"""Bound on the answer of a module that is told to obey again, and on its report of that."""
_SETTLED_S = 5.0
"""Bound on the wait for instructions that are being taken back; each of them ends within `_TOLD_S`
or with its process.
"""


class MotionStarts:
    """What was asked for, and what has ended it since; usable from any thread.

    Attributes:
        stops: so many stops so far; what was asked for before the newest one is not carried out any
            more.
        arm_stops: those among them that end every motion, of agents too: not the loss of a camera
            or of the policy.
        reason: the newest stop.
        instruction: what the policy was told last; empty when that was taken back.
        ticket: number of the newest instruction or of its end; tells whoever has given one whether
            it still holds.
        AGAIN: what whoever releases a stop is told.
    """

    AGAIN: Final = (
        "Nothing moves by itself: give an instruction (set_instruction, run_task) or move the arm "
        "to go on."
    )

    def __init__(self, supervisor: Supervisor) -> None:
        """Args:
        supervisor: of the modules.
        """
        self._supervisor = supervisor
        # Guards the counts; nothing is asked of a module while it is held.
        self._lock = threading.Lock()
        # by process id: stops that it has reported, and whether its end was counted
        self._seen: dict[int, int] = {}
        self._gone: set[int] = set()
        self._was_latched = False
        self._telling: list[threading.Thread] = []
        self.stops = self.arm_stops = self.ticket = 0
        self.reason = self.instruction = ""

    def look(self, is_latched: bool | None = None) -> Sequence[ModuleView]:
        """The modules; stops that have come since the last look are counted, and end what was asked
        for.

        Args:
            is_latched: whether the emergency stop is; None when nobody has looked now.
        """
        views = self._supervisor.views()
        with self._lock:
            reasons = [(reason, view.kind) for view in views if (reason := self._news(view))]
            is_pressed = is_latched is True and not self._was_latched
            self._was_latched = self._was_latched if is_latched is None else is_latched
        if is_pressed:
            self.note_stop(EMERGENCY_STOP)
        for reason, kind in reasons:
            self.note_stop(reason, holds_arm=kind in ARM_KINDS)
        if any(kind != "inference" and reason != EMERGENCY_STOP for reason, kind in reasons):
            self._take_back_soon()  # the policy knows of the other ones itself
        return views

    def note_stop(self, reason: str, *, holds_arm: bool = True, is_asked: bool = False) -> None:
        """A stop has come; waits for nothing.

        Args:
            reason: in words.
            holds_arm: it ends every motion; otherwise only that of the policy.
            is_asked: by somebody who has stopped a module, and may start it again to use it.
        """
        with self._lock:
            self.stops += 1
            self.reason, self.instruction = reason, ""
            self.ticket += 1
            self.arm_stops += holds_arm
            if holds_arm and not is_asked:
                self._supervisor.needs_start = reason

    def stop(self, kind: ModuleKind, reason: str, *, is_asked: bool) -> None:
        """A module was stopped, or is to be started again by itself: the policy forgets its
        instruction.
        """
        self.note_stop(reason, holds_arm=kind in ARM_KINDS, is_asked=is_asked)
        self._take_back()

    @property
    def are_needed(self) -> bool:
        """Whether a stop keeps a module still until `permit`."""
        with self._supervisor.changes.lock:
            slots = [slot for kind in ARM_KINDS for slot in self._supervisor.slots[kind]]
            reports = [slot.report for slot in slots if slot.phase == "running"]
            return any(report is not None and report.needs_start for report in reports)

    def permit(self) -> int:
        """Somebody asks for motion: the modules that a stop keeps still obey again; returns
        `stops`, see `check`.

        Raises:
            RefusedError: a module says that there was another stop since.
            NotReadyError: a module does not answer.
            StateError: as `check`.
        """
        self.look()
        self.settle()
        count = self.stops
        self._arm()
        self._supervisor.needs_start = ""
        self.check(count)
        return count

    def arm_started(self) -> None:
        """Let what was started since `permit` obey too; does nothing when there was a stop
        since.
        """
        self.look()
        if self._supervisor.needs_start:
            return
        try:
            self._arm()
        except RoboNeuronError as error:
            log.warning("What was started keeps still: %s", error)

    def _arm(self) -> None:
        """Have robot and control obey again, and their successors. Raises as `permit`."""
        for kind in ARM_KINDS:
            for slot in self._running(kind):
                report = slot.report
                if report is None or not report.needs_start or slot.process is None:
                    continue
                # newer than what was asked for
                if report.stops != self._seen.get(slot.process.pid):
                    raise RefusedError(
                        f"{kind} was stopped meanwhile: {report.needs_start}.",
                        hint="Ask again.",
                        rule="new_start",
                    )
                if refused := self._set(slot, {START_PARAMETER: report.stops}, _PERMITTED_S):
                    raise RefusedError(
                        f"{kind} keeps still: {refused}.", hint="See get_status.", rule="new_start"
                    )
                self._await_obeying(slot, report.stops)

    def check(self, stops: int) -> None:
        """Do nothing unless a stop came since `permit`.

        Args:
            stops: what `permit` has returned.

        Raises:
            StateError: there was one; says which.
        """
        if self.stops != stops:
            raise StateError(
                f"There was a stop meanwhile: {self.reason}. Nothing moves.", hint="Ask again."
            )

    def begin(self, text: str) -> int:
        """A policy is about to be started or replaced; returns the ticket of its instruction.

        Args:
            text: the instruction; empty for none.
        """
        with self._lock:
            self.instruction = text
            self.ticket += 1
            return self.ticket

    def give(self, text: str, timeout_s: float) -> tuple[int, str]:
        """Tell the policy that works, and one that is about to replace it; returns the ticket and
        why it was refused.

        Args:
            text: the instruction.
            timeout_s: bound on each answer [s].

        Raises:
            StateError: none runs.
            NotReadyError: it does not answer.
        """
        ticket = self.begin(text)
        slots = self._running("inference")
        if not slots:
            self._supervisor.require_running("inference")
        refused = [self._set(slot, {INSTRUCTION_PARAMETER: text}, timeout_s) for slot in slots]
        if any(refused):
            self.withdraw(ticket)
        return ticket, "; ".join(filter(None, refused))

    def withdraw(self, ticket: int) -> None:
        """Take an instruction back from every process that holds it; one that does not answer is
        ended.

        Does nothing more when somebody else has given another one since, or a stop has ended it.
        """
        with self._lock:
            is_ours = self.ticket == ticket
            if is_ours:
                self.instruction = ""
                self.ticket += 1
        if is_ours:
            self._take_back()
        self.settle()

    def follow(self, slot: Slot, ticket: int) -> None:
        """Tell a policy that was being started what holds now, when that has changed since.

        Args:
            slot: of the policy.
            ticket: of its start, see `begin`.

        Raises:
            StateError: it does not drop its instruction.
            NotReadyError: it does not answer.
        """
        if self.ticket != ticket and self._set(
            slot, {INSTRUCTION_PARAMETER: self.instruction}, _PERMITTED_S
        ):
            raise StateError("The policy did not drop its instruction.")

    def settle(self) -> None:
        """Wait until instructions that a stop has ended are taken back."""
        with self._lock:
            telling = list(self._telling)
        for thread in telling:
            thread.join(_SETTLED_S)

    def _news(self, view: ModuleView) -> str:
        """Which stop a module tells of that is not counted yet; the lock is held."""
        if view.process is None:
            return ""
        pid, report = view.process.pid, view.report
        if view.phase == "exited":
            is_new = pid not in self._gone
            self._gone.add(pid)
            return f"{view.kind} has ended by itself" if is_new else ""
        if report is None:
            return ""
        before = self._seen.setdefault(pid, report.stops)
        self._seen[pid] = report.stops
        return (report.needs_start or "a stop") if report.stops > before else ""

    def _take_back_soon(self) -> None:
        """Take the instruction back on a thread of its own: whoever looks must not wait for a
        module.
        """
        with self._lock:
            thread = threading.Thread(target=self._take_back, name="take-back", daemon=True)
            thread.start()  # before it is listed: whoever settles joins it
            self._telling = [other for other in self._telling if other.is_alive()] + [thread]

    def _take_back(self) -> None:
        """Have every policy forget its instruction; one that cannot be told is ended, because it
        would go on moving.
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
        """The module that works, and one that is about to replace it."""
        with self._supervisor.changes.lock:
            return [slot for slot in self._supervisor.slots[kind] if slot.phase == "running"]

    def _set(self, slot: Slot, values: dict[str, str | int], timeout_s: float) -> str:
        """Set parameters of a module; returns why it refuses, empty when it does not."""
        client = self._supervisor.parameters(slot)
        return client.set(values, timeout_s, lambda: slot.check_alive("told what to do"))

    def _await_obeying(self, slot: Slot, stops: int) -> None:
        """Wait until a module reports that it obeys, or another stop: `check` tells of that.

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

"""Replacement of a running module between two of its outputs: the new module works in shadow until
the handover.

The handover is a moment on the time axis of their inputs (see `roboneuron.switching.handover`). It
lies far enough ahead that both processes know it beforehand, so neither acts on the other's inputs.
Until then nothing changes. If the new module does not act in time afterwards, the old one acts
again.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from roboneuron.errors import NotReadyError, RoboNeuronError, StateError
from roboneuron.modules.report import Report
from roboneuron.planning import Plan
from roboneuron.server.loop import ClosedLoop
from roboneuron.supervisor.changes import Stage
from roboneuron.supervisor.lifecycle import NodeClient
from roboneuron.supervisor.slot import Slot
from roboneuron.switching.beside import Standbys
from roboneuron.switching.gap import Gap
from roboneuron.switching.standby import (
    ACT_FROM,
    ACT_UNTIL,
    NEVER_NS,
    PLAY_FROM,
    PLAY_UNTIL,
    listeners,
    lower,
)
from roboneuron.switching.switch_checks import SwitchCheck

log = logging.getLogger(__name__)
_MARGIN_S, _MOST_MARGIN_S, _MARGIN_RATIO = 0.5, 5.0, 5.0
"""Lead of the moment: at least 0.5 s, or five times the present time of sending it to both
processes (2 to 50 ms, hundreds on an overloaded machine).
"""
_MARGIN_LATENCIES = 3.0
_HEARD_S = 0.005
"""Time for a last row of the old module to reach the new one; otherwise both could send a row at
once.
"""
_LATEST_S = 0.05
_MOMENTS = 3
"""Number of moments, each twice as far ahead as the previous one, proposed to a new module that
answers too late.
"""
_FIRST_S = 1.0
_TOLD_S = 4.0
"""Delay of the report that shows whether the new module has acted by the moment: without CPU time,
a process may act and report later.
"""
_FIND_S = 25.0
"""A killed subscriber counts as alive until its lease on the ROS graph ends, after up to 20 s."""
_LATE_S = 3.0
"""Time for which a module that is late in shadow counts as too slow; on a busy machine anything is
late at times.
"""
ARRIVAL_S = 0.5
"""A status may arrive this much before the action that it reports."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Change:
    """Result of a handover.

    Attributes:
        gap: None if nothing was sent before or after it.
        difference: largest difference between the two modules' outputs [m or rad]; None if the old
            one did not act.
    """

    gap: Gap | None
    difference: float | None


def check_goes_on(halt: threading.Event | None) -> None:
    """Raise StateError if the client has cancelled its call."""
    if halt is not None and halt.is_set():
        raise StateError("The call was cancelled; nothing was replaced.")


class WarmSwitch:
    """One switch; used once, on the caller's thread.

    Args:
        loop: the closed loop.
        plan: plan of the new module.
        check: check of its kind.
        on_stage: called with the progress.
        ticket: ticket of the instruction at the time of the request, see `MotionStarts`.
        halt: set when the client cancels its call.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        plan: Plan,
        check: SwitchCheck,
        on_stage: Stage,
        ticket: int = 0,
        halt: threading.Event | None = None,
    ) -> None:
        self._halt = halt
        self._starts = loop.starts
        self._ticket = ticket
        self._changes = loop.modules.changes
        self._loop = loop
        self._modules = loop.modules
        self._standbys = Standbys(loop)
        self._plan = plan
        self._check = check
        self._kind = check.kind
        self._on_stage = on_stage
        self._late_since_s = math.inf
        self._is_lowered = False

    def run(self) -> Change:
        """Start the new module in shadow, compare, hand over, end the old module.

        Raises:
            RoboNeuronError: the reason why nothing was replaced; the old module acts as before.
        """
        standby = self._standbys.start(self._plan, self._on_start, self._halt)
        try:
            self._on_stage(f"new {self._kind}: comparing it in shadow with the old one")
            difference = self._check.compare(lambda: self._healthy(standby))
            self._await_listeners(standby)
            self._follow_instruction(standby)
            check_goes_on(self._halt)
            old = self._hand_over(standby)
        except BaseException:
            self._standbys.discard(standby)
            self._check_instruction()  # the reason for missing outputs
            raise
        self._own_instruction()
        gap = self._measure(old, standby)
        self._on_stage(f"{self._kind}: ending the old {self._check.noun}")
        self._standbys.discard(old)
        return Change(gap=gap, difference=difference)

    def _check_instruction(self) -> None:
        """Raise StateError if the instruction was ended by a stop or its client since the
        request.
        """
        if (
            self._kind == "inference"
            and self._starts.ticket != self._ticket
            and not self._starts.instruction
        ):
            raise StateError(
                "The instruction was taken back meanwhile, by a stop or at the end of its task; "
                "nothing was replaced."
            )

    def _check_stops(self, standby: Slot) -> None:
        """Raise StateError if only the old control needs a new start, after a stop that the new one
        has not seen, such as the end of a lead. A policy needs an instruction anyway.
        """
        if self._kind != "control":
            return
        old, new = self._working().report, standby.report
        if old is not None and old.needs_start and new is not None and not new.needs_start:
            raise StateError(
                f"The running {self._check.noun} needs a new start: {old.needs_start}; nothing "
                "was replaced.",
                hint="Ask again.",
            )

    def _follow_instruction(self, standby: Slot) -> None:
        """Send the new module the instruction and the requests for motion that came while it was
        loaded.
        """
        if self._kind == "inference":
            self._check_instruction()
            self._starts.follow(standby, self._ticket)
        else:
            self._starts.arm_started()  # motion may have been requested while it was loaded

    def _own_instruction(self) -> None:
        """Apply the caller's own instruction, unless another one or an end came since."""
        section = self._plan.config.inference
        if self._kind != "inference" or section is None or self._starts.ticket != self._ticket:
            return
        if section.instruction != self._starts.instruction:
            self._starts.begin(section.instruction)

    def _on_start(self, stage: str) -> None:
        """Lower the priority of the new module right after its process was started, while
        it loads.
        """
        if not self._is_lowered:
            self._is_lowered = True
            _, *standbys = self._standbys.slots(self._kind)
            for slot in standbys:
                if slot.process is not None:
                    lower(slot.process.pid)
        self._on_stage(f"new {stage}")

    def _await_listeners(self, standby: Slot) -> None:
        """Wait until all subscribers of the old module have discovered the new one: otherwise its
        messages would be lost.
        """

        def lacking() -> dict[str, str]:
            old = self._working().report
            needed, found = _listeners(old), _listeners(self._healthy(standby))
            return {
                topic: f"{found[topic]} of {count} on {topic}"
                for topic, count in needed.items()
                if found.get(topic, count) < count
            }

        if not self._changes.wait_for(lambda: not lacking(), _FIND_S):
            raise NotReadyError(
                f"Too few subscribers discovered the new {self._check.noun} within {_FIND_S:g} s: "
                f"{', '.join(lacking().values())}. Nothing was replaced.",
                hint="Try again when the machine is less busy.",
            )

    def _measure(self, old: Slot, new: Slot) -> Gap | None:
        """Compute the gap from both modules' reports; None if there was no output before or
        after.
        """
        now_s = time.monotonic()

        def gap() -> Gap | None:
            last = old.report
            is_last = last is None or last.received_s > now_s
            return self._check.measure(last, new.report) if is_last else None

        return self._changes.wait_for(gap, ARRIVAL_S)

    def _hand_over(self, standby: Slot) -> Slot:
        """Agree on the moment, wait for the first output after it, and make the new module that of
        its kind.
        """
        old = self._working()
        clients = [self._loop.parameters(old), self._loop.parameters(standby)]
        latency_s = self._check.latency_s(self._healthy(standby))
        # A prediction in progress when the new module gets the moment ends before it.
        margin_s = min(
            _MOST_MARGIN_S, max(self._probe(clients, standby), _MARGIN_LATENCIES * latency_s)
        )
        self._on_stage(f"{self._kind}: changing over")
        try:
            # The old module gets the moment only after the new one, which may still die without an
            # effect. The old one plays until its chunk ends, or the new one's first output is due:
            # no gap between the two.
            bridged_ns = self._bridged_ns(latency_s)
            moment_ns, due_s = self._agree(clients[1], standby, margin_s, bridged_ns)
            leave = {ACT_UNTIL: moment_ns, PLAY_UNTIL: moment_ns + int(latency_s * 1e9)}
            self._check_stops(standby)
            self._tell(clients[0], leave, due_s - time.monotonic() - _LATEST_S, standby)
            if self._check.is_due():
                self._await_first_output(standby, due_s, latency_s)
            return self._standbys.adopt(standby)
        except BaseException as error:
            refused = self._roll_back(clients, old, error)
            if refused and isinstance(error, RoboNeuronError):
                raise error.with_hint(
                    f"The old one could not be told to go on either: {refused}"
                ) from error
            raise

    def _bridged_ns(self, latency_s: float) -> int:
        """Time after the moment for which the old module's rows are played, and the last of them
        reaches the new one.
        """
        return int((latency_s + _HEARD_S) * 1e9) if self._check.has_rows() else 0

    def _agree(
        self, new: NodeClient, standby: Slot, margin_s: float, bridged_ns: int
    ) -> tuple[int, float]:
        """Agree on the moment [ns] with the new module, in time for the old one, and return when it
        comes [monotonic s].
        """
        for proposal in range(_MOMENTS):
            moment_ns, due_s = time.time_ns() + int(margin_s * 1e9), time.monotonic() + margin_s
            try:
                values = {ACT_FROM: moment_ns, PLAY_FROM: moment_ns + bridged_ns}
                self._tell(new, values, margin_s / 2, standby)
                break
            except NotReadyError:
                self._healthy(standby)  # an ended or frozen module will not answer later either
                if proposal == _MOMENTS - 1:
                    raise
                margin_s = min(2 * margin_s, _MOST_MARGIN_S)
        return moment_ns, due_s

    def _tell(
        self, client: NodeClient, values: Mapping[str, int], within_s: float, standby: Slot
    ) -> None:
        refused = client.finish(
            client.send(values), max(0.0, within_s), lambda: self._healthy(standby)
        )
        if refused:
            raise StateError(f"The handover was refused: {refused}.")

    def _probe(self, clients: Sequence[NodeClient], standby: Slot) -> float:
        """Send both modules the present values, and return the margin [s] that this requires."""
        started_s = time.monotonic()
        for client, values in zip(
            clients, ({ACT_UNTIL: 0, PLAY_UNTIL: 0}, {ACT_FROM: NEVER_NS}), strict=True
        ):
            refused = client.set(values, _FIND_S, lambda: self._healthy(standby))
            if refused:
                raise StateError(
                    f"The handover was refused: {refused}.",
                    hint="To replace a module under another interpreter warm, install "
                    "rn-switching there too.",
                )
        return min(_MOST_MARGIN_S, max(_MARGIN_S, _MARGIN_RATIO * (time.monotonic() - started_s)))

    def _await_first_output(self, standby: Slot, due_s: float, latency_s: float) -> None:
        end_s = max(due_s, time.monotonic()) + _FIRST_S + 3 * latency_s

        def told() -> Report | None:
            report = self._healthy(standby)
            return (
                report if self._check.has_taken_over(report) or report.received_s > end_s else None
            )

        report = self._changes.wait_for(told, end_s + _TOLD_S - time.monotonic())
        if report is None or not self._check.has_taken_over(report):
            raise NotReadyError(
                f"The new {self._check.noun} did not act after the handover; the old one acts "
                "again.",
                hint=f"It was measured to need {latency_s * 1e3:.0f} ms; see its log.",
            )

    def _roll_back(self, clients: Sequence[NodeClient], slot: Slot, cause: BaseException) -> str:
        """Make the old module act again. The new one is stopped from acting, and the caller ends it
        in any case. Return the reason if the old one could not be reached, otherwise empty.
        """
        log.warning("The handover is undone: %s", cause)
        old, new = clients
        with suppress(RoboNeuronError):
            new.send({ACT_FROM: NEVER_NS})
        try:
            # Sent in any case: a frozen process reads it, after the earlier messages, when it
            # resumes.
            call = old.send({ACT_UNTIL: 0, PLAY_UNTIL: 0})
            refused = old.finish(call, _FIND_S, lambda: slot.check_alive("told to go on"))
        except RoboNeuronError as error:
            refused = error.message
        if refused:
            log.error("The old %s could not be told to go on: %s", self._check.noun, refused)
        return refused

    def _healthy(self, slot: Slot) -> Report:
        """Newest report of a working process; raises its error or that of the old module."""
        slot.check_alive("working in shadow")
        self._working().check_alive("being replaced")
        report = slot.report
        if report is None:
            raise NotReadyError(
                f"The new {self._check.noun} stopped reporting; nothing was replaced."
            )
        failure = report.failure()
        # it may still be in time for the next input
        is_late = isinstance(failure, NotReadyError)
        now_s = time.monotonic()
        self._late_since_s = min(self._late_since_s, now_s) if is_late else math.inf
        if failure is not None and (not is_late or now_s - self._late_since_s > _LATE_S):
            raise failure
        if self._working().phase != "running":
            raise StateError(
                f"The running {self._check.noun} has ended meanwhile; nothing was replaced."
            )
        return report

    def _working(self) -> Slot:
        """Slot of the working module."""
        return self._standbys.slots(self._kind)[0]


def _listeners(report: Report | None) -> Mapping[str, int]:
    return {} if report is None else listeners(report.metrics)

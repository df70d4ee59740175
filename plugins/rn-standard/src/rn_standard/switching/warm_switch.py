"""Replacement of a running module between two of its outputs: the new one works in shadow until the
handover.

The handover is a moment in the time of the inputs of both (see `rn_standard.switching.handover`).
It lies so far ahead that both processes know it beforehand, so neither acts on the other's inputs.
Until then nothing changes; if the new module does not act in time afterwards, the old one acts
again.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from rn_standard.switching.beside import Standbys
from rn_standard.switching.gap import Gap
from rn_standard.switching.standby import (
    ACT_FROM,
    ACT_UNTIL,
    LISTENERS,
    NEVER_NS,
    PLAY_FROM,
    PLAY_UNTIL,
    lower,
)
from rn_standard.switching.switch_checks import SwitchCheck
from roboneuron import NotReadyError, RoboNeuronError, StateError
from roboneuron.feature import ClosedLoop, NodeClient, Plan, Report, Slot, Stage

log = logging.getLogger(__name__)
_MARGIN_S, _MOST_MARGIN_S, _MARGIN_RATIO = 0.5, 5.0, 5.0
"""Both processes are told the moment this long before it comes: at least 0.5 s, or five times what
telling them takes now (2 to 50 ms, hundreds on an overloaded machine).
"""
_MARGIN_LATENCIES = 3.0
_HEARD_S = 0.005
"""A row that the old one sends in the last instant is heard within this time; else two rows could
come at once.
"""
_LATEST_S = 0.05
_MOMENTS = 3
"""So many moments, each twice as far ahead as the one before, are proposed to a new one that
answers too late.
"""
_FIRST_S = 1.0
_TOLD_S = 4.0
"""Whether the new one has acted by then is read from a report made after that, which may come so
much later: a process that is not given the processor acts, and has not told it yet.
"""
_FIND_S = 25.0
"""A listener that was killed is taken for alive until its lease on the ROS graph ends, after up to
20 s.
"""
_LATE_S = 3.0
"""A newcomer that is late for this long in shadow is too slow; now and then a busy machine makes
anything late.
"""
ARRIVAL_S = 0.5
"""A status may arrive before the action that it tells of."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Change:
    """How a handover went.

    Attributes:
        gap: None when nothing was sent before or after it.
        difference: largest difference between what the two wanted [m or rad]; None when the old one
            did not act.
    """

    gap: Gap | None
    difference: float | None


class WarmSwitch:
    """One switch; used once, on the thread of the caller.

    Args:
        loop: the closed loop.
        plan: what is to run.
        check: of its kind.
        on_stage: told how it goes.
        ticket: of the instruction that was in force when the caller asked, see `MotionStarts`.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        plan: Plan,
        check: SwitchCheck,
        on_stage: Stage,
        ticket: int = 0,
    ) -> None:
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
        """Start the new one in shadow, compare, change over, end the old one.

        Raises:
            RoboNeuronError: the reason why nothing was replaced; the old one acts as before.
        """
        standby = self._standbys.start(self._plan, self._on_start)
        try:
            self._on_stage(f"new {self._kind}: comparing it in shadow with the old one")
            difference = self._check.compare(lambda: self._healthy(standby))
            self._await_listeners(standby)
            self._follow_instruction(standby)
            old = self._hand_over(standby)
        except BaseException:
            self._standbys.discard(standby)
            self._check_instruction()  # why it showed nothing
            raise
        self._own_instruction()
        gap = self._measure(old, standby)
        self._on_stage(f"{self._kind}: ending the old {self._check.noun}")
        self._standbys.discard(old)
        return Change(gap=gap, difference=difference)

    def _check_instruction(self) -> None:
        """Raise StateError when a stop, or whoever had given the instruction, has ended it since
        the caller asked.
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

    def _follow_instruction(self, standby: Slot) -> None:
        """What was asked for while the new one was loaded is asked of the new one too."""
        if self._kind == "inference":
            self._check_instruction()
            self._starts.follow(standby, self._ticket)
        else:
            self._starts.arm_started()  # motion may have been asked for while it was loaded

    def _own_instruction(self) -> None:
        """The caller's own instruction is in force from now on, unless another came, or an end."""
        section = self._plan.config.inference
        if self._kind != "inference" or section is None or self._starts.ticket != self._ticket:
            return
        if section.instruction != self._starts.instruction:
            self._starts.begin(section.instruction)

    def _on_start(self, stage: str) -> None:
        """Right after its process was started, the new one is made to give way to the old one while
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
        """Whoever hears the old one has to have found the new one too: what is sent to nobody is
        lost.
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
        """From what both tell afterwards; None when there was no output before or after."""
        now_s = time.monotonic()

        def gap() -> Gap | None:
            last = old.report
            is_last = last is None or last.received_s > now_s
            return self._check.measure(last, new.report) if is_last else None

        return self._changes.wait_for(gap, ARRIVAL_S)

    def _hand_over(self, standby: Slot) -> Slot:
        """Agree on the moment, wait for the first output after it, and make the new one the module
        of its kind.
        """
        old = self._working()
        clients = [self._loop.parameters(old), self._loop.parameters(standby)]
        latency_s = self._check.latency_s(self._healthy(standby))
        # A prediction that the new one has begun when it is told of the moment ends before it.
        margin_s = min(
            _MOST_MARGIN_S, max(self._probe(clients, standby), _MARGIN_LATENCIES * latency_s)
        )
        self._on_stage(f"{self._kind}: changing over")
        try:
            # The old one is told only when the new one knows: one that dies now disturbs nobody.
            # Until the old one's chunk would end, or the new one's first output is due: no hole
            # between the two.
            bridged_ns = self._bridged_ns(latency_s)
            moment_ns, due_s = self._agree(clients[1], standby, margin_s, bridged_ns)
            leave = {ACT_UNTIL: moment_ns, PLAY_UNTIL: moment_ns + int(latency_s * 1e9)}
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
        """How long after the moment the old one's rows are played, and the last of them is heard by
        the new one.
        """
        return int((latency_s + _HEARD_S) * 1e9) if self._check.has_rows() else 0

    def _agree(
        self, new: NodeClient, standby: Slot, margin_s: float, bridged_ns: int
    ) -> tuple[int, float]:
        """The moment [ns] that the new one knows, in time to tell the old one too, and when it
        comes [monotonic s].
        """
        for proposal in range(_MOMENTS):
            moment_ns, due_s = time.time_ns() + int(margin_s * 1e9), time.monotonic() + margin_s
            try:
                values = {ACT_FROM: moment_ns, PLAY_FROM: moment_ns + bridged_ns}
                self._tell(new, values, margin_s / 2, standby)
                break
            except NotReadyError:
                self._healthy(standby)  # what has ended or freezes will not answer later either
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
        """Tell both what they know already, and return the margin [s] that this needs."""
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
        """The old one acts again; the new one is told not to, and ended by the caller in any case.
        Returns why the old one could not be told, empty when it was.
        """
        log.warning("The handover is undone: %s", cause)
        old, new = clients
        with suppress(RoboNeuronError):
            new.send({ACT_FROM: NEVER_NS})
        try:
            # Sent in any case: one that is frozen reads it, after what it was told before, when it
            # continues.
            call = old.send({ACT_UNTIL: 0, PLAY_UNTIL: 0})
            refused = old.finish(call, _FIND_S, lambda: slot.check_alive("told to go on"))
        except RoboNeuronError as error:
            refused = error.message
        if refused:
            log.error("The old %s could not be told to go on: %s", self._check.noun, refused)
        return refused

    def _healthy(self, slot: Slot) -> Report:
        """The newest report of a process that works; raises what is wrong with it, or with the old
        one.
        """
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
        """The slot of the module that works now."""
        return self._standbys.slots(self._kind)[0]


def _listeners(report: Report | None) -> dict[str, int]:
    """Number of subscriptions that a module's outputs have found, by topic."""
    metrics = {} if report is None else report.metrics
    return {
        key.removeprefix(LISTENERS): int(value)
        for key, value in metrics.items()
        if key.startswith(LISTENERS)
    }

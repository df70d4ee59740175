"""Replacing the running backend between two actions: the new one works in shadow until its moment comes.

The moment is a point in the images' time (see `roboneuron.modules.turn`): it lies so far ahead that both processes know
of it before, so neither acts on the other's images. Until then nothing changes; if the new one does not act in time
afterwards, the old one does again.
"""

from __future__ import annotations

import logging
import statistics
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from roboneuron.errors import NotReadyError, RefusedError, RoboNeuronError, StateError
from roboneuron.modules.settings import ACT_FROM, ACT_UNTIL, NEVER_NS, PLAY_UNTIL
from roboneuron.server.stream import ActionStream, Gap
from roboneuron.supervisor.health import Report
from roboneuron.supervisor.parameters import ParameterClient
from roboneuron.supervisor.slot import Slot
from roboneuron.supervisor.supervisor import Stage, Supervisor

if TYPE_CHECKING:
    from roboneuron.server.selection import Selection

log = logging.getLogger(__name__)
_LOOKS = 3
"""So many reports with a new shadow action are compared, one each 0.2 s."""
_SHADOW_S = 5.0
_MARGIN_S, _MOST_MARGIN_S, _MARGIN_RATIO = 0.5, 5.0, 5.0
"""Both processes are told the moment this long before it comes: at least 0.5 s, or five times what telling them takes
now (2 to 50 ms, hundreds on an overloaded machine)."""
_LATEST_S = 0.05
_FIRST_ACTION_S = 1.0
_FIND_S = 5.0
_ARRIVAL_S = 0.5
"""A status may arrive before the action that it tells of."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Change:
    """How a change-over went.

    Attributes:
        gap: None when no action was sent before or after it.
        difference: largest difference between what the two wanted [m or rad]; None when the old one did not act.
    """

    gap: Gap | None
    difference: float | None


class WarmSwitch:
    """One change-over; used once, on the thread of the caller."""

    def __init__(self, supervisor: Supervisor, selection: Selection, stream: ActionStream, on_stage: Stage) -> None:
        self._supervisor = supervisor
        self._stream = stream
        self._selection = selection
        self._on_stage = on_stage
        section = selection.config.inference
        assert section is not None
        self._bound = section.switch_max_difference
        self._has_instruction = bool(section.instruction)

    def run(self) -> Change:
        """Start the new backend in shadow, compare, change over, end the old one.

        Raises:
            RoboNeuronError: the reason why nothing was replaced; the old backend acts as before.
        """
        selection, supervisor = self._selection, self._supervisor
        standby = supervisor.start_standby(
            "inference",
            selection.config,
            python=selection.python,
            names=selection.names,
            on_stage=lambda text: self._on_stage(f"new {text}"),
        )
        try:
            difference = self._compare(standby) if self._has_instruction else None
            old = self._hand_over(standby)
        except BaseException:
            supervisor.discard(standby)
            raise
        self._on_stage("inference: ending the old backend")
        supervisor.discard(old)
        return Change(gap=measure_gap(supervisor, self._stream, supervisor.report_of(standby)), difference=difference)

    def _compare(self, standby: Slot) -> float | None:
        """How far the shadow's actions lie from those on the topic; raises when beyond the bound."""
        self._on_stage("new inference: comparing its actions in shadow")
        started_ns = time.time_ns()
        seen: dict[str, tuple[float, ...]] = {}

        def enough() -> bool:
            report = self._healthy(standby)
            if "shadow_action" in report.metrics:
                values = tuple(float(value) for value in report.metrics["shadow_action"].split(","))
                seen[report.metrics["shadow_count"]] = values
            return len(seen) >= _LOOKS

        if not self._supervisor.changes.wait_for(enough, _SHADOW_S) and not seen:
            raise NotReadyError(
                f"The new backend predicted nothing within {_SHADOW_S:g} s in shadow; nothing was replaced.",
                hint="Do images come? See get_status.",
            )
        difference = _difference(list(seen.values()), self._stream.since(started_ns))
        if difference is not None and difference > self._bound:
            raise RefusedError(
                f"In shadow the new backend's actions differ by {difference:.3g} m or rad from those of the running "
                f"one, at most {self._bound:g} is allowed; nothing was replaced.",
                hint="Check that both were made for this robot, or raise switch_max_difference in [inference].",
            )
        return difference

    def _hand_over(self, standby: Slot) -> Slot:
        """Agree on the moment, wait for the first action after it, and make the new one the inference module."""
        old = self._supervisor.slot("inference")
        clients = [self._client(old), self._client(standby)]
        margin_s = self._probe(clients)
        report = self._healthy(standby)
        latency_s = (report.latency_p99_ms or report.latency_ms or 0.0) / 1e3
        moment_ns = time.time_ns() + int(margin_s * 1e9)
        self._on_stage("inference: changing over")
        try:
            # Until the old one's chunk would end, or the new one's first action is due: no hole between the two.
            leave = {ACT_UNTIL: moment_ns, PLAY_UNTIL: moment_ns + int(latency_s * 1e9)}
            calls = [clients[1].send({ACT_FROM: moment_ns}), clients[0].send(leave)]
            for client, call in zip(reversed(clients), calls, strict=True):
                left_s = (moment_ns - time.time_ns()) / 1e9 - _LATEST_S
                try:
                    refused = client.finish(call, max(0.0, left_s))
                except NotReadyError:
                    self._healthy(standby)  # a better reason, if there is one
                    raise
                if refused:
                    raise StateError(f"A change-over was refused: {refused}.")
            if self._has_instruction:
                self._await_first_action(standby, moment_ns, latency_s)
            return self._supervisor.adopt(standby)
        except BaseException as error:
            self._roll_back(clients, error)
            raise

    def _probe(self, clients: Sequence[ParameterClient]) -> float:
        """Tell both what they know already, and return the margin [s] that this needs."""
        started_s = time.monotonic()
        for client, values in zip(clients, ({ACT_UNTIL: 0, PLAY_UNTIL: 0}, {ACT_FROM: NEVER_NS}), strict=True):
            refused = client.set(values, _FIND_S)
            if refused:
                raise StateError(f"A change-over was refused: {refused}.")
        return min(_MOST_MARGIN_S, max(_MARGIN_S, _MARGIN_RATIO * (time.monotonic() - started_s)))

    def _await_first_action(self, standby: Slot, moment_ns: int, latency_s: float) -> None:
        bound_s = (moment_ns - time.time_ns()) / 1e9 + _FIRST_ACTION_S + 3 * latency_s

        def acts() -> bool:
            return "first_action_ns" in self._healthy(standby).metrics

        if not self._supervisor.changes.wait_for(acts, bound_s):
            raise NotReadyError(
                "The new backend did not act when its turn came; the old one acts again.",
                hint=f"It was measured to need {latency_s * 1e3:.0f} ms; see its log.",
            )

    def _roll_back(self, clients: Sequence[ParameterClient], cause: BaseException) -> None:
        """The old one acts again; the new one is told not to, and ended by the caller in any case."""
        log.warning("The change-over is undone: %s", cause)
        old, new = clients
        with suppress(RoboNeuronError):
            new.send({ACT_FROM: NEVER_NS})
        try:
            refused = old.set({ACT_UNTIL: 0, PLAY_UNTIL: 0}, _FIND_S)
        except RoboNeuronError as error:
            refused = error.message
        if refused:
            log.error("The old backend could not be told to go on: %s", refused)
            if isinstance(cause, RoboNeuronError):
                cause.hint = f"{cause.hint} The old backend could not be told to go on either: {refused}".strip()

    def _healthy(self, slot: Slot) -> Report:
        """The newest report of a process that works; raises what it says is wrong."""
        slot.check_alive("working in shadow")
        report = self._supervisor.report_of(slot)
        if report is None:
            raise NotReadyError("The new backend has fallen silent; nothing was replaced.")
        failure = report.failure()
        if failure is not None:
            raise failure
        if self._supervisor.slot("inference").phase != "running":
            raise StateError("The running backend has ended meanwhile; nothing was replaced.")
        return report

    def _client(self, slot: Slot) -> ParameterClient:
        assert slot.choice is not None
        node = f"/{slot.choice.settings.status_name}"
        return ParameterClient(self._supervisor.link, self._supervisor.changes, node)


def measure_gap(supervisor: Supervisor, stream: ActionStream, report: Report | None) -> Gap | None:
    """The gap before the first action that `report` tells of; None when there was no action before or after it."""
    first_ns = int(report.metrics.get("first_action_ns", "0")) if report is not None else 0
    return supervisor.changes.wait_for(lambda: stream.gap(first_ns), _ARRIVAL_S) if first_ns else None


def _difference(shadow: Sequence[tuple[float, ...]], acting: Sequence[tuple[float, ...]]) -> float | None:
    """Largest difference of the medians over translation [m] and rotation [rad]; the gripper may differ."""
    if not shadow or not acting:
        return None
    return max(
        abs(statistics.median(a[axis] for a in shadow) - statistics.median(a[axis] for a in acting))
        for axis in range(6)
    )

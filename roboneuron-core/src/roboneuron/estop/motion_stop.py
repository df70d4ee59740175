"""End of all motion on a client's request: every module that moves the robot is told at once, and
confirms it.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

from roboneuron.errors import RoboNeuronError, StateError
from roboneuron.modules.settings import STOP_PARAMETER, ModuleKind
from roboneuron.supervisor.slot import Slot
from roboneuron.supervisor.supervisor import Supervisor

log = logging.getLogger(__name__)
_STOPPED_S = 2.0
"""Timeout of a module's confirmation that it has ended its motion."""
SetParameters = Callable[[Slot, Mapping[str, str | int], float], str]
"""Sets parameters of a module within a time [s]; returns the reason of a refusal, empty for none.
Raises RoboNeuronError.
"""


def cancel_starting_policy(supervisor: Supervisor, reason: str) -> None:
    """Cancel the start of a policy; with an instruction it would move the arm."""
    with supervisor.changes.lock:
        slots = [slot for slot in supervisor.slots["inference"] if slot.phase == "starting"]
    for slot in slots:
        slot.cancel(reason)


def stop_modules(
    supervisor: Supervisor, slots: Sequence[Slot], reason: str, set_parameters: SetParameters
) -> dict[ModuleKind, str]:
    """Stop the motion of modules in parallel; blocks until each has confirmed it. A policy that
    does not is ended.

    Args:
        supervisor: theirs.
        slots: of the running modules.
        reason: the stop as text.
        set_parameters: see `SetParameters`.

    Returns:
        Why it is not confirmed, by kind; empty texts if it is.
    """
    failures: dict[ModuleKind, str] = {}

    def stop(slot: Slot) -> None:
        failure = _stop(supervisor, slot, reason, set_parameters)
        failures[slot.kind] = failure or failures.get(slot.kind, "")

    threads = [threading.Thread(target=stop, args=(slot,), name="stop") for slot in slots]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return failures


def _stop(supervisor: Supervisor, slot: Slot, reason: str, set_parameters: SetParameters) -> str:
    before = 0 if slot.report is None else slot.report.stops

    def is_told() -> bool:
        report = slot.report
        return slot.phase != "running" or (report is not None and report.stops > before)

    try:
        failure = set_parameters(slot, {STOP_PARAMETER: reason}, _STOPPED_S)
    except RoboNeuronError as error:
        failure = error.message
    if not failure and not supervisor.changes.wait_for(is_told, _STOPPED_S):
        failure = "it has not reported the stop"
    if failure and slot.kind == "inference":
        log.error("The policy is ended, because it did not stop: %s", failure)
        # it has ended by itself, which is as good
        with suppress(StateError):
            supervisor.end(slot)
        return ""
    return failure

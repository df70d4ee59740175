"""New instruction for the running policy, up to its first action."""

from __future__ import annotations

import threading
import time

from roboneuron.errors import InvalidInputError, NotReadyError, StateError
from roboneuron.modules.report import Report
from roboneuron.server.loop import ClosedLoop

_PARAMETER_S = 5.0


def give_instruction(
    loop: ClosedLoop, text: str, timeout_s: float, halt: threading.Event | None = None
) -> tuple[Report, float]:
    """Send the backend a new instruction; return after its first action for it was published, with
    the elapsed time [s]. If it raises, the instruction is withdrawn: what failed moves nothing
    later.

    Args:
        halt: set when the client cancels its call.

    Raises:
        InvalidInputError: the instruction is empty or refused by the module.
        StateError: no backend is running, a stop came meanwhile, or the call was cancelled.
        RefusedError: the emergency stop is latched, so nothing would happen.
        UngroundedError: the backend cannot act on it; nothing moves.
        NotReadyError: no action in time; the message says what is missing.
    """
    view = loop.modules.require_running("inference")
    loop.emergency_stop.check()
    before = view.report
    count = before.instruction_count if before is not None else 0
    errors = before.error_count if before is not None else 0
    started_s = time.monotonic()
    stops = loop.starts.permit()
    halt = halt or threading.Event()
    if halt.is_set():
        raise StateError("The call was cancelled; no instruction was given.")
    ticket, refused = loop.starts.give(text, _PARAMETER_S)
    if refused:
        raise InvalidInputError(
            f"The backend refused the instruction: {refused}.", path="instruction"
        )

    def settled() -> Report | None:
        if halt.is_set():
            raise StateError("The call was cancelled; its instruction was withdrawn.")
        loop.starts.check(stops)
        report = loop.modules.require_running("inference").report
        if report is None or report.instruction_count <= count:
            return None
        if report.actions_for_instruction > 0:
            return report
        failure = report.failure()
        if failure is not None and report.error_count > errors:
            raise failure
        return None

    try:
        report = loop.modules.changes.wait_for(settled, timeout_s)
        if report is None:
            newest = loop.modules.view("inference").report
            missing = newest.waiting_for or newest.note if newest is not None else "its status"
            raise NotReadyError(
                f"The backend has published no action for {text!r} within {timeout_s:g} s; it "
                f"waits for: {missing or 'its first inference'}.",
                hint="The instruction was withdrawn. Give it again, with a longer timeout_s if the "
                "policy is slow; see get_status.",
            )
    except BaseException:
        loop.starts.withdraw(ticket)
        raise
    return report, time.monotonic() - started_s

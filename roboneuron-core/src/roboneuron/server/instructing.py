"""A new instruction for the running backend, believed only when its first action for it is out."""

from __future__ import annotations

import time

from roboneuron.errors import InvalidInputError, NotReadyError
from roboneuron.modules.settings import INSTRUCTION_PARAMETER
from roboneuron.supervisor.health import Report
from roboneuron.supervisor.supervisor import Supervisor

_PARAMETER_S = 5.0


def instruct(supervisor: Supervisor, text: str, timeout_s: float) -> tuple[Report, float]:
    """Hand over `text`, which is not blank; returns the report with the first action for it, and after how long.

    Raises:
        InvalidInputError: the module refuses it.
        StateError: no backend is running.
        RoboNeuronError: what the backend says is wrong, such as UngroundedError; nothing moves.
        NotReadyError: no action within the time; the message says what is missing.
    """
    view = supervisor.require_running("inference")
    before = view.report
    count = before.instruction_count if before is not None else 0
    errors = before.error_count if before is not None else 0
    started_s = time.monotonic()
    assert view.choice is not None
    assert view.process is not None
    node = f"/{view.choice.settings.status_name}"
    parameters = supervisor.parameters(node, view.process)
    refused = parameters.set({INSTRUCTION_PARAMETER: text}, _PARAMETER_S)
    if refused:
        raise InvalidInputError(f"The backend refused the instruction: {refused}.", path="instruction")

    def settled() -> Report | None:
        report = supervisor.require_running("inference").report
        if report is None or report.instruction_count <= count:
            return None
        if report.actions_for_instruction > 0:
            return report
        failure = report.failure()
        if failure is not None and report.error_count > errors:
            raise failure
        return None

    report = supervisor.changes.wait_for(settled, timeout_s)
    if report is None:
        newest = supervisor.view("inference").report
        missing = newest.waiting_for or newest.note if newest is not None else "its status"
        raise NotReadyError(
            f"The backend has published no action for {text!r} within {timeout_s:g} s; it waits for: "
            f"{missing or 'its first inference'}.",
            hint="The instruction stays set; see get_status, or give another one.",
        )
    return report, time.monotonic() - started_s

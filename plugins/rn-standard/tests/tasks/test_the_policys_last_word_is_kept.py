"""What a policy said of its own end is known when the arm was stopped, too: success is confirmed
with the arm at rest.
"""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest

from rn_standard.tasks.live import LiveCell
from roboneuron import StateError
from roboneuron.feature import Report
from roboneuron.server.clock import RobotClock

WORDS = "pick up the red cube"


def made_cell(starts: Any = None) -> tuple[LiveCell, Any]:
    """A cell, and the inference module's view."""
    process = SimpleNamespace(pid=7)
    view = SimpleNamespace(phase="running", process=process, report=Report(), kind="inference")
    starts = starts or SimpleNamespace(
        arm_stops=0,
        permit=lambda arm_stops: arm_stops,
        check=lambda stops: None,
        give=lambda words, wait_s: (1, ""),
        withdraw=lambda ticket: None,
    )
    modules = SimpleNamespace(
        view=lambda kind: view, views=lambda: [view], require_running=lambda kind: view
    )
    stop = SimpleNamespace(is_latched=lambda: False, check=lambda: None)
    host: Any = SimpleNamespace(
        config=SimpleNamespace(namespace="arm"),
        clock=lambda namespace: RobotClock(),
        loop=SimpleNamespace(starts=starts, emergency_stop=stop, camera_roles=dict),
        modules=modules,
    )
    return LiveCell(host, None, "operator", print, threading.Event(), str, {}, []), view


def instructed_cell() -> tuple[LiveCell, Any]:
    """A cell that has given its instruction, and the inference module's view."""
    cell, view = made_cell()
    cell.begin(WORDS)
    return cell, view


@pytest.mark.parametrize(("said", "known"), [("1", True), ("0", False), (None, None)])
def test_the_last_word_outlives_the_instruction(said: str | None, known: bool | None) -> None:
    cell, view = instructed_cell()
    metrics = {} if said is None else {"done": said}
    view.report = Report(
        instruction=WORDS, instruction_count=1, actions_for_instruction=3, metrics=metrics
    )
    assert cell.look().policy_done is known
    cell.end()
    view.report = Report(instruction_count=2)
    assert cell.look().policy_done is known


def test_a_stop_before_the_task_begins_is_one_of_the_task() -> None:
    starts: Any = SimpleNamespace(arm_stops=3)

    def permit(arm_stops: int) -> int:
        if arm_stops != starts.arm_stops:
            raise StateError("There was a stop since the request.")
        return 0

    starts.permit = permit
    cell, _ = made_cell(starts)
    starts.arm_stops = 4
    with pytest.raises(StateError):
        cell.begin(WORDS)


def test_an_attempt_begins_without_a_word() -> None:
    cell, view = instructed_cell()
    view.report = Report(
        instruction=WORDS, instruction_count=1, actions_for_instruction=3, metrics={"done": "1"}
    )
    cell.end()
    cell.begin(WORDS)
    assert cell.look().policy_done is None

"""However `set_instruction` ends without an action, its instruction is withdrawn."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from roboneuron import NotReadyError, RoboNeuronError, StateError, UngroundedError
from roboneuron.feature import ClosedLoop, Report
from roboneuron.tools.loop.instructing import give_instruction

TICKET = 7


class Policy:
    """A closed loop with a policy that got an instruction and reports what a test lets happen.

    Attributes:
        report: of the policy, once it has the instruction.
        then: what happens after that.
        withdrawn: tickets of withdrawn instructions.
    """

    def __init__(self, then: Callable[[Policy], object], **report: Any) -> None:
        self.then = then
        self.report: Report | None = Report()
        self.answer = Report(instruction_count=1, **report)
        self.withdrawn: list[int] = []
        self.halt = threading.Event()
        self.stop = ""
        self.modules = self.starts = self.changes = self
        self.emergency_stop = SimpleNamespace(check=lambda: None)

    def view(self, kind: str) -> Policy:
        return self

    require_running = view

    def permit(self) -> int:
        return 0

    def check(self, stops: int) -> None:
        if self.stop:
            raise StateError(self.stop)

    def give(self, text: str, timeout_s: float) -> tuple[int, str]:
        self.report = self.answer
        self.then(self)
        return TICKET, ""

    def withdraw(self, ticket: int) -> None:
        self.withdrawn.append(ticket)

    def wait_for(self, look: Callable[[], Any], timeout_s: float) -> Any:
        return look()

    def instruct(self) -> None:
        give_instruction(cast(ClosedLoop, self), "move on", 1.0, self.halt)


def nothing(policy: Policy) -> None:
    """Nothing happens."""


def stop(policy: Policy) -> None:
    policy.stop = "a stop"


FAILURES: dict[str, tuple[Policy, type[RoboNeuronError]]] = {
    "cancelled": (Policy(lambda policy: policy.halt.set()), StateError),
    "stopped": (Policy(stop), StateError),
    "no action in time": (Policy(nothing), NotReadyError),
    "no images": (Policy(nothing, error_code="not_ready", error="x", error_count=1), NotReadyError),
    "not in sight": (
        Policy(nothing, error_code="ungrounded", error="x", error_count=1),
        UngroundedError,
    ),
}


@pytest.mark.parametrize(("policy", "error"), FAILURES.values(), ids=FAILURES)
def test_an_instruction_without_an_action_is_withdrawn(
    policy: Policy, error: type[RoboNeuronError]
) -> None:
    with pytest.raises(error):
        policy.instruct()
    assert policy.withdrawn == [TICKET]


def test_an_instruction_that_is_acted_on_stays() -> None:
    policy = Policy(nothing, actions_for_instruction=1)
    policy.instruct()
    assert policy.withdrawn == []

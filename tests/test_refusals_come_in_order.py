"""Which refusal a client gets when several things forbid its call: always the one that comes first
in the order of the call's phases. An emergency stop passes all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import combinations
from typing import Any

import anyio
import pytest
from mcp import types

from rn_standard.http.feature import HttpFeature
from rn_standard.http.plugin import FEATURE as HTTP
from rn_standard.ops.maintenance import MaintenanceFeature, MaintenanceFile
from rn_standard.ops.plugin import CLIENTS, MAINTENANCE, REAL_ROBOT
from rn_standard.tasks.feature import TasksFeature
from rn_standard.tasks.plugin import FEATURE as TASKS
from rn_testing.fakes import fake_registry
from roboneuron import DriverSpec, RobotSpec
from roboneuron.config import parse_config
from roboneuron.errors import StateError
from roboneuron.selection.plugin import FEATURE as SELECTION
from roboneuron.server.app import Application
from roboneuron.server.registry import ERROR_META
from roboneuron.supervisor.changes import Stage

ARM = RobotSpec(
    name="arm",
    summary="An arm.",
    target="rn_testing.fakes.robot:gantry_profile",
    drivers=(
        DriverSpec(
            name="network", summary="For tests.", target="rn_testing.fakes.robot:FakeDriver"
        ),
    ),
)
CONFIG = """
[robot]
name = "arm"
driver = "network"
[server]
max_concurrent_calls = 1
"""
EXPECTED = {
    "tool": ("invalid_input", ""),
    "role": ("refused", "role"),
    "load": ("not_ready", ""),
    "maintenance": ("refused", "maintenance"),
    "operator": ("refused", "operator"),
    "task": ("refused", "ownership"),
    "arguments": ("invalid_input", ""),
    "person": ("refused", "person"),
    "handler": ("wrong_state", ""),
}
"""What is wrong with a call, in the order of the phases: the code and the rule of the refusal."""
PAIRS = [
    pair
    for pair in combinations(EXPECTED, 2)
    # only start_robot asks a person, and only set_instruction is refused during a task
    if pair != ("task", "person")
] + [("handler",)]


class Caller:
    """CallContext of a client whose user does not agree to anything, or does not answer."""

    def __init__(self, who: str = "agent", role: str = "operator", answer: str = "yes") -> None:
        self.who, self.role, self.simulated = who, role, False
        self._answer = answer

    async def run(self, work: Callable[[Stage], Any], **_: Any) -> Any:
        """See CallContext."""
        return work(lambda stage: None)

    async def ask(self, question: str, what: str = "") -> str | None:
        """See CallContext."""
        if self._answer == "silence":
            await anyio.sleep_forever()
        return self._answer


class Cell:
    """A server of a real arm, in which anything may be wrong."""

    def __init__(self, application: Application) -> None:
        self.application = application
        self.maintenance = application.host.feature("maintenance", MaintenanceFeature)
        self.tasks = application.host.feature("tasks", TasksFeature)
        self._file = MaintenanceFile(application.host.state_directory)

    def take_out_of_service(self) -> None:
        """Let a person do so."""
        self._file.begin("person", "admin", "oiling", self.application.host.audit)
        self.maintenance.look()

    def forget(self) -> None:
        """Put the robot back in service, without an operator."""
        self._file.path.unlink(missing_ok=True)
        self.maintenance.look()
        lease = self.application.host.feature("http", HttpFeature).lease
        assert lease is not None
        for who in ("agent", "someone"):
            lease.release(who)

    def task(self) -> Any:
        """The block in which a task runs."""
        assert self.tasks._arbiter is not None
        return self.tasks._arbiter.claim("a task", anyio.Event())  # type: ignore[arg-type]

    async def refusal(self, wrong: tuple[str, ...]) -> tuple[str, str]:
        """The code and the rule of a call with which all of that is wrong."""
        is_for_task = "task" in wrong
        name = "set_instruction" if is_for_task else "start_robot"
        arguments: dict[str, Any] = {"instruction": "go"} if is_for_task else {}
        if "arguments" in wrong:
            arguments = {"nonsense": 1}
        call = self.application.tools.call
        async with anyio.create_task_group() as group:
            # the operator is whoever acts first
            first = "someone" if "operator" in wrong else "agent"
            await call("start_robot", {}, Caller(first, answer=""))
            if "load" in wrong:
                role = "viewer" if "role" in wrong else "operator"
                tool = "start_robot" if role == "operator" else "get_status"
                group.start_soon(call, tool, {}, Caller(first, role, answer="silence"))
                await anyio.wait_all_tasks_blocked()
            if "maintenance" in wrong:
                self.take_out_of_service()
            caller = Caller(
                role="viewer" if "role" in wrong else "operator",
                answer="" if "person" in wrong else "yes",
            )
            if is_for_task:
                with self.task():
                    answer = await call("fly" if "tool" in wrong else name, arguments, caller)
            else:
                answer = await call("fly" if "tool" in wrong else name, arguments, caller)
            group.cancel_scope.cancel()
        self.forget()
        return failure(answer)


def failure(answer: types.CallToolResult) -> tuple[str, str]:
    """The code and the rule of a failed call."""
    assert answer.is_error
    details = (answer.meta or {})[ERROR_META]
    return details["code"], details.get("rule", "")


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    registry = fake_registry(ARM, CLIENTS, HTTP, MAINTENANCE, REAL_ROBOT, SELECTION, TASKS)
    application = Application(
        parse_config(CONFIG, registry=registry),
        plugins=lambda: registry,
        directory=tmp_path_factory.mktemp("state"),
        command=lambda python: pytest.fail("nothing may be spawned"),
    )

    def refuse(*_: Any, **__: Any) -> None:
        raise StateError("the robot would be spawned now")

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(application.loop, "start_selected", refuse)
        # maintenance latches the stop; whether emergency_stop does so is looked at in its file
        patched.setattr(application.loop.emergency_stop, "latch", lambda *_, **__: ([], 0.0))
        yield Cell(application)
    application.close()


@pytest.mark.parametrize("wrong", PAIRS, ids="-".join)
def test_of_two_refusals_the_one_of_the_earlier_phase_answers(
    cell: Cell, wrong: tuple[str, ...]
) -> None:
    found = anyio.run(cell.refusal, wrong)
    assert found == EXPECTED[wrong[0]]


def test_an_emergency_stop_needs_a_role(cell: Cell) -> None:
    call = cell.application.tools.call
    answer = anyio.run(call, "emergency_stop", {}, Caller(role=""))
    assert failure(answer) == EXPECTED["role"]
    assert not cell.application.loop.emergency_stop.is_latched()


def test_an_emergency_stop_passes_every_refusal(cell: Cell) -> None:
    stop = cell.application.loop.emergency_stop

    async def press() -> types.CallToolResult:
        call = cell.application.tools.call
        async with anyio.create_task_group() as group:
            await call("start_robot", {}, Caller("someone", answer=""))
            group.start_soon(
                call, "start_robot", {}, Caller("someone", role="viewer", answer="silence")
            )
            cell.take_out_of_service()
            with cell.task():
                answer = await call("emergency_stop", {"nonsense": 1}, Caller(role="viewer"))
            group.cancel_scope.cancel()
        return answer

    assert not stop.is_latched()
    assert failure(anyio.run(press)) == EXPECTED["arguments"]
    assert stop.is_latched()

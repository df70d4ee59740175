"""The recovery of a robot module: asked for by a parameter, done by the driver, answered in the module's status."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import pytest
from rclpy.parameter import Parameter

from roboneuron.errors import RefusedError, StateError
from roboneuron.modules.settings import RECOVER_PARAMETER

pytestmark = pytest.mark.ros


@pytest.fixture
def robot(world: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Return a function that starts a robot whose driver is recovered with these outcomes, one after the other."""

    def start(*outcomes: str | Exception) -> Any:
        plugin = importlib.import_module("loop_plugin")
        left = list(outcomes)

        class Recoverable(plugin.Driver):  # type: ignore[misc, name-defined]
            def recover(self) -> str:
                outcome = left.pop(0)
                if isinstance(outcome, Exception):
                    raise outcome
                return outcome

        monkeypatch.setattr(plugin, "Driver", Recoverable)
        return world.start("robot")

    return start


def ask(world: Any, robot: Any, value: object) -> Any:
    return world.run(lambda: robot.set_parameters([Parameter(RECOVER_PARAMETER, value=value)]))[0]


@pytest.mark.parametrize(
    ("outcome", "told"),
    [
        ("user_stop", "recovered user_stop"),
        (RefusedError("The stop is pressed.", hint="Release it."), "refused The stop is pressed. Release it."),
        (StateError("The arm has no fault."), "wrong_state The arm has no fault."),
        (RuntimeError("the client library broke"), "plugin_contract RuntimeError: the client library broke"),
    ],
    ids=["recovered", "refused", "no-fault", "broken"],
)
def test_what_the_driver_answers_is_reported_with_the_number_of_the_request(
    world: Any,
    robot: Callable[..., Any],
    wait_until: Callable[..., bool],
    status_of: Any,
    outcome: str | Exception,
    told: str,
) -> None:
    node = robot(outcome)
    assert ask(world, node, 41).successful
    assert wait_until(lambda: status_of(node).get("recovery", "").startswith("41 ")), status_of(node)
    assert status_of(node)["recovery"] == f"41 {told}"


def test_a_second_request_is_answered_with_its_own_number(
    world: Any, robot: Callable[..., Any], wait_until: Callable[..., bool], status_of: Any
) -> None:
    node = robot("reflex", StateError("The arm has no fault."))
    for number, word in ((1, "recovered"), (2, StateError.code)):
        assert ask(world, node, number).successful
        assert wait_until(lambda n=number: status_of(node).get("recovery", "").startswith(f"{n} "))
        assert word in status_of(node)["recovery"]


def test_a_request_that_is_no_number_is_refused(world: Any, robot: Callable[..., Any]) -> None:
    answer = ask(world, robot("reflex"), "now")
    assert not answer.successful
    assert "INTEGER" in answer.reason


def test_a_driver_that_cannot_be_recovered_has_no_such_parameter(world: Any) -> None:
    assert not world.start("robot").has_parameter(RECOVER_PARAMETER)

"""The recovery of a robot module: asked for by a parameter, done by the driver, answered in the
module's status.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any

import pytest

from rn_standard.ops.recovery_parameter import RECOVER_PARAMETER, RecoverableDriver, join
from roboneuron.errors import RefusedError, StateError
from roboneuron.modules.status import StatusWriter


class Driver:
    """Is recovered with these outcomes, one after the other."""

    def __init__(self, *outcomes: str | Exception) -> None:
        self._left = list(outcomes)

    def recover(self) -> str:
        outcome = self._left.pop(0)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome


class Module:
    """The process of a module, as far as a feature sees it.

    Attributes:
        host: what `join` gets.
        parameters: by name, the first value and what is called with later ones.
    """

    def __init__(self, kind: str, driver: object) -> None:
        self.parameters: dict[str, tuple[Any, ...]] = {}
        self.stops: list[str] = []
        self.status = StatusWriter("fake/robot")
        self.host = SimpleNamespace(
            settings=SimpleNamespace(kind=kind),
            status=self.status,
            resources=ExitStack(),
            on_configured=[],
            add_parameter=self._add_parameter,
            require_start=self.stops.append,
        )
        join(self.host)  # type: ignore[arg-type]
        for extend in self.host.on_configured:
            extend(SimpleNamespace(driver=driver))

    def _add_parameter(self, name: str, *more: Any) -> Callable[[], None]:
        self.parameters[name] = more
        return lambda: self.parameters.pop(name) and None

    def ask(self, number: int) -> str:
        """Set the parameter as the server does; the answer of the driver."""
        self.parameters[RECOVER_PARAMETER][1](number)
        end_s = time.monotonic() + 10.0
        while time.monotonic() < end_s:
            told = str(self.status.report().metrics.get("recovery", ""))
            if told.startswith(f"{number} "):
                return told
            self.status.changed.wait(0.01)
        raise AssertionError("the driver did not answer")


@pytest.mark.parametrize(
    ("outcome", "told"),
    [
        ("user_stop", "recovered user_stop"),
        (
            RefusedError("The stop is pressed.", hint="Release it."),
            "refused The stop is pressed. Release it.",
        ),
        (StateError("The arm has no fault."), "wrong_state The arm has no fault."),
        (
            RuntimeError("the client library broke"),
            "plugin_contract RuntimeError: the client library broke",
        ),
    ],
    ids=["recovered", "refused", "no-fault", "broken"],
)
def test_what_the_driver_answers_is_reported_with_the_number_of_the_request(
    outcome: str | Exception, told: str
) -> None:
    driver = Driver(outcome)
    assert isinstance(driver, RecoverableDriver)
    assert Module("robot", driver).ask(41) == f"41 {told}"


def test_a_second_request_is_answered_with_its_own_number() -> None:
    module = Module("robot", Driver("reflex", StateError("The arm has no fault.")))
    assert module.ask(1) == "1 recovered reflex"
    assert module.ask(2) == "2 wrong_state The arm has no fault."


def test_the_parameter_ends_with_the_driver() -> None:
    module = Module("robot", Driver())
    assert module.parameters[RECOVER_PARAMETER][0] == 0
    module.host.resources.close()
    assert not module.parameters


@pytest.mark.parametrize(("kind", "driver"), [("robot", object()), ("control", Driver())])
def test_what_cannot_be_recovered_has_no_such_parameter(kind: str, driver: object) -> None:
    assert not Module(kind, driver).parameters

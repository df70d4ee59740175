"""A stop or a reset succeeds if every running module has reported it since."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from roboneuron.errors import NotReadyError, UnsafeError
from roboneuron.estop.emergency import CONFIRM_S, EmergencyStop

NEW, OLD = 1.0, -1.0
"""When a module reports, relative to the stop [s]."""


def stop_beside(folder: Path, **modules: tuple[str, float | None, bool]) -> EmergencyStop:
    """The emergency stop of a server whose modules are in a phase, and have reported a latch at a
    time, or never (None).
    """
    pytest.importorskip("rclpy")
    link = SimpleNamespace(
        advertise=lambda *_: lambda message: None,
        subscribe=lambda *_: None,
        on_executor=lambda task: task(),
    )
    begun_s = time.monotonic()
    views = [
        SimpleNamespace(
            kind=kind,
            phase=phase,
            report=None
            if at_s is None
            else SimpleNamespace(received_s=begun_s + at_s, emergency_stop=is_latched),
        )
        for kind, (phase, at_s, is_latched) in modules.items()
    ]
    waited: list[float] = []

    def wait_for(condition: Callable[[], bool], timeout_s: float) -> bool:
        waited.append(timeout_s)
        return condition()

    supervisor = SimpleNamespace(
        state_directory=folder,
        link=link,
        views=lambda: views,
        changes=SimpleNamespace(wait_for=wait_for),
        waited=waited,
    )
    return EmergencyStop(cast(Any, supervisor))


CONFIRMED = {
    "all have": {"robot": ("running", NEW, True), "control": ("running", NEW, True)},
    "one does not run": {"robot": ("running", NEW, True), "control": ("stopped", OLD, False)},
    "one is being started": {"robot": ("running", NEW, True), "control": ("starting", None, False)},
    "none runs": {},
}


@pytest.mark.parametrize("modules", CONFIRMED.values(), ids=CONFIRMED)
def test_a_stop_names_the_running_modules_that_confirm_it(
    tmp_path: Path, modules: dict[str, Any]
) -> None:
    confirmed, _ = stop_beside(tmp_path, **modules).latch("arm", who="ann", reason="smoke")
    assert confirmed == [kind for kind, (phase, *_) in modules.items() if phase == "running"]


UNCONFIRMED = {
    "one reports the other state": ("running", NEW, False),
    "one reported the state before": ("running", OLD, True),
    "one has never reported": ("running", None, True),
}


@pytest.mark.parametrize("control", UNCONFIRMED.values(), ids=UNCONFIRMED)
def test_a_stop_that_a_running_module_does_not_confirm_is_an_error_and_stays(
    tmp_path: Path, control: tuple[str, float | None, bool]
) -> None:
    stop = stop_beside(tmp_path, gantry=("running", NEW, True), control=control)
    with pytest.raises(UnsafeError) as caught:
        stop.latch("arm", who="ann", reason="smoke")
    assert "control" in str(caught.value)
    assert "gantry" not in str(caught.value)
    assert stop.file.is_latched()
    assert caught.value.hint


@pytest.mark.parametrize("control", UNCONFIRMED.values(), ids=UNCONFIRMED)
def test_a_reset_that_a_running_module_does_not_confirm_is_an_error(
    tmp_path: Path, control: tuple[str, float | None, bool]
) -> None:
    phase, at_s, is_latched = control
    stop = stop_beside(tmp_path, control=(phase, at_s, not is_latched))
    stop.file.press(who="ann", reason="smoke")
    with pytest.raises(NotReadyError) as caught:
        stop.reset("arm", who="ann", role="admin")
    assert "control" in str(caught.value)


def test_the_confirmation_is_waited_for_within_its_bound(tmp_path: Path) -> None:
    stop = stop_beside(tmp_path, robot=("running", NEW, True))
    _, took_s = stop.latch("arm", who="ann", reason="smoke")
    assert 0.0 <= took_s < CONFIRM_S

"""The thread in which a simulation runs keeps its rate and publishes; its failures reach the caller
of the driver.
"""

from __future__ import annotations

import threading
import time
from contextlib import nullcontext

import pytest

from rn_simulation.pace import Pace
from rn_simulation.real_time import RealTimeThread
from rn_testing.waiting import wait_until
from roboneuron.errors import ConfigurationError, NotReadyError, StateError, UnsafeError

STEP_S = 1.0 / 240.0


def made(rate_hz: float = 60.0) -> RealTimeThread:
    return RealTimeThread("toy", step_s=STEP_S, publish_rate_hz=rate_hz)


def test_steps_are_made_and_only_some_of_them_are_published() -> None:
    calls: list[tuple[int, bool]] = []
    thread = made(rate_hz=20.0)
    thread.start(nullcontext(), lambda steps, factor, publish: calls.append((steps, publish)))
    assert calls[0] == (0, True)
    wait_until(lambda: sum(publish for _, publish in calls) > 3)
    thread.stop()
    assert all(steps > 0 for steps, _ in calls[1:])
    assert sum(publish for _, publish in calls) < len(calls)
    number = len(calls)
    time.sleep(0.03)  # to show that nothing happens
    assert len(calls) == number


def test_it_is_started_once_and_can_be_started_again() -> None:
    thread, before = made(), set(threading.enumerate())
    thread.stop()
    for _ in range(2):
        thread.start(nullcontext(), lambda steps, factor, publish: None)
        assert thread.is_running
        thread.check_running()
        with pytest.raises(StateError, match="toy is open already"):
            thread.start(nullcontext(), lambda steps, factor, publish: None)
        thread.stop()
        thread.stop()
        assert not thread.is_running
        with pytest.raises(StateError, match="toy is not open"):
            thread.check_running()
    assert set(threading.enumerate()) <= before


@pytest.mark.parametrize(
    ("error", "raised", "text"),
    [
        (ConfigurationError("no display"), ConfigurationError, "no display"),
        (KeyError("leg"), NotReadyError, "leg"),
    ],
)
def test_what_fails_at_the_start_is_raised_by_start(
    error: Exception, raised: type[Exception], text: str
) -> None:
    def fail(steps: int, factor: float, publish: bool) -> None:
        raise error

    thread = made()
    with pytest.raises(raised, match=text):
        thread.start(nullcontext(), fail)
    thread.check_stopped()


def test_what_fails_later_is_told_whenever_it_is_asked() -> None:
    def fail_later(steps: int, factor: float, publish: bool) -> None:
        if steps:
            raise ValueError("the cube exploded")

    thread = made()
    thread.start(nullcontext(), fail_later)
    wait_until(lambda: not thread.is_running)
    with pytest.raises(UnsafeError, match="the cube exploded"):
        thread.check_running()
    thread.stop()


def test_pace_counts_what_is_due_and_drops_what_cannot_be_caught_up() -> None:
    pace = Pace(step_s=0.01, factor=1.0)
    assert pace.due_steps(100.0) == 0
    assert pace.due_steps(100.025) == 2
    assert pace.until_next_s(100.025) == pytest.approx(0.005, abs=1e-9)
    assert pace.due_steps(103.0) == 5
    assert pace.due_steps(103.0) == 0
    assert pace.achieved_factor < 0.1


def test_pace_catches_up_as_much_as_it_may() -> None:
    pace = Pace(step_s=0.01, catch_up_s=0.2)
    assert pace.due_steps(100.0) == 0
    assert pace.due_steps(100.15) == 15
    assert pace.due_steps(103.0) == 20
    assert pace.due_steps(103.0) == 0

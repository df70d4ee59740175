"""Watchdogs of two FR3s that share one control and one driver, in their real processes: whatever
fails, both stand within the bounds of one arm.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

pytestmark = [pytest.mark.ros, pytest.mark.timing, pytest.mark.timeout(240)]

Wait = Callable[[Callable[[], bool], float, str], float]
BRAKING_S = 0.5
"""Time from a hold to a standstill, including a busy machine's delay."""


@pytest.fixture
def moving(pair: Any, wait: Wait) -> Iterator[None]:
    """Both arms move to and fro by actions of a foreign node."""
    pair.start("robot", "control")
    pair.permit()
    wait(lambda: pair.actions.get_subscription_count() >= 2, 5.0, "control listens")
    with pair.waving():
        wait(pair.is_moving, 5.0, "both arms move")
        yield


def check_standing(pair: Any) -> None:
    """Check that neither arm moves for half a second."""
    since_s = time.monotonic()
    time.sleep(0.5)  # to show that nothing happens
    velocities = np.abs(pair.velocities(since_s))
    assert velocities.shape[1] == 14
    assert velocities.max() < 0.05


def test_both_arms_hold_when_actions_cease(pair: Any, wait: Wait) -> None:
    pair.start("robot", "control")
    wait(lambda: pair.actions.get_subscription_count() >= 2, 5.0, "control listens")
    with pair.waving():
        wait(pair.is_moving, 5.0, "both arms move")
    took_s = wait(pair.is_still, 3.0, "both arms stand")
    assert took_s <= pair.config.control.action_timeout_s + BRAKING_S
    check_standing(pair)


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "frozen"])
def test_both_arms_hold_when_control_is_gone(
    pair: Any, wait: Wait, moving: None, end: signal.Signals
) -> None:
    pid = pair.pid("control")
    os.kill(pid, end)
    try:
        took_s = wait(pair.is_still, 3.0, "both arms stand")
        assert took_s <= pair.config.robot.command_timeout_s + BRAKING_S
        wait(
            lambda: pair.note("robot") == "holding: no command", 3.0, "the driver was told to hold"
        )
        check_standing(pair)
    finally:
        if end == signal.SIGSTOP:
            os.kill(pid, signal.SIGCONT)
            wait(lambda: pair.needs_start("control"), 5.0, "control knows that it was frozen")
        else:
            wait(
                lambda: pair.supervisor.view("control").phase == "exited",
                5.0,
                "the death is noticed",
            )


def test_control_commands_neither_arm_when_the_robot_is_killed(
    pair: Any, wait: Wait, moving: None
) -> None:
    os.kill(pair.pid("robot"), signal.SIGKILL)
    wait(
        lambda: pair.metric("control", "hold_code") == "stale_joint_state",
        3.0,
        "control has noticed",
    )
    since_s = time.monotonic()
    time.sleep(0.5)  # to show that nothing happens
    assert not [at for at in pair.command_times if at > since_s + 0.1]
    wait(lambda: pair.supervisor.view("robot").phase == "exited", 5.0, "the death is noticed")

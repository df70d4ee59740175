"""Layers of watchdogs, judged by the simulated FR3's joints: each layer holds while the layer above
it is dead or frozen.
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
"""Time from a hold to a standstill: from 2.6 rad/s with 10 rad/s^2, plus a busy machine's delay."""


def after_silence(arm: Any, since_s: float) -> np.ndarray:
    """Measured joint velocities from this time on, which must be those of a standing arm."""
    time.sleep(0.5)  # to show that nothing happens
    return np.abs(arm.velocities(since_s))


@pytest.fixture
def moving(arm: Any, wait: Wait) -> Iterator[None]:
    """The arm moves to and fro by actions of a foreign node."""
    arm.start("robot", "control")
    arm.permit()
    wait(lambda: arm.actions.get_subscription_count() >= 2, 5.0, "control listens")
    with arm.waving():
        wait(arm.is_moving, 5.0, "the arm moves")
        yield


def test_control_holds_when_actions_cease(arm: Any, wait: Wait) -> None:
    arm.start("robot", "control")
    wait(lambda: arm.actions.get_subscription_count() >= 2, 5.0, "control listens")
    with arm.waving():
        wait(arm.is_moving, 5.0, "the arm moves")
    took_s = wait(arm.is_still, 3.0, "the arm stands")
    assert took_s <= arm.config.control.action_timeout_s + BRAKING_S
    wait(
        lambda: arm.metric("control", "hold_code") == "no_action",
        2.0,
        "the status says that actions ceased",
    )
    assert after_silence(arm, time.monotonic()).max() < 0.05


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "frozen"])
def test_robot_holds_when_control_is_gone(
    arm: Any, wait: Wait, moving: None, end: signal.Signals
) -> None:
    pid = arm.pid("control")
    os.kill(pid, end)
    try:
        took_s = wait(arm.is_still, 3.0, "the arm stands")
        assert took_s <= arm.config.robot.command_timeout_s + BRAKING_S
        wait(lambda: arm.note("robot") == "holding: no command", 3.0, "the driver was told to hold")
        assert after_silence(arm, time.monotonic()).max() < 0.05
    finally:
        if end == signal.SIGSTOP:
            os.kill(pid, signal.SIGCONT)
        else:
            wait(
                lambda: arm.supervisor.view("control").phase == "exited",
                5.0,
                "the death is noticed",
            )


def test_control_that_wakes_up_drops_what_it_slept_through(arm: Any, wait: Wait) -> None:
    arm.start("robot", "control")
    arm.permit()
    wait(lambda: arm.actions.get_subscription_count() >= 2, 5.0, "control listens")
    # an action of the previous test may still be in transit
    time.sleep(2 * arm.config.control.action_timeout_s)
    wait(arm.is_still, 5.0, "the arm stands")
    pid = arm.pid("control")
    os.kill(pid, signal.SIGSTOP)
    try:
        arm.act([0.0, 0.0, 0.03, 0.0, 0.0, 0.0, 1.0])
        time.sleep(arm.config.control.action_timeout_s + 0.2)
        since_s = time.monotonic()
    finally:
        os.kill(pid, signal.SIGCONT)
    wait(
        lambda: arm.needs_start("control") == "the control process was frozen",
        3.0,
        "the status says that it was frozen",
    )
    arm.act([0.0, 0.0, 0.03, 0.0, 0.0, 0.0, 1.0])
    assert after_silence(arm, since_s).max() < 0.05
    arm.permit()
    with arm.waving():
        wait(arm.is_moving, 5.0, "the arm moves again")


def test_inference_stops_when_perception_freezes_and_the_arm_stands(arm: Any, wait: Wait) -> None:
    arm.start("robot", "control", "perception", "inference")
    try:
        wait(arm.is_moving, 20.0, "the policy moves the arm")
        pid = arm.pid("perception")
        os.kill(pid, signal.SIGSTOP)
        frozen_s = time.monotonic()
        try:
            took_s = wait(arm.is_still, 5.0, "the arm stands")
            bound_s = (
                arm.config.inference.max_image_age_s
                + arm.config.control.action_timeout_s
                + BRAKING_S
            )
            assert took_s <= bound_s
            assert arm.action_times[-1] - frozen_s <= arm.config.inference.max_image_age_s + 0.5
            since_s = time.monotonic()
            assert after_silence(arm, since_s).max() < 0.05
            assert not [at for at in arm.action_times if at > since_s]
        finally:
            os.kill(pid, signal.SIGCONT)
        count = len(arm.action_times)
        wait(lambda: len(arm.action_times) > count + 3, 10.0, "actions flow again with new images")
    finally:
        for kind in ("inference", "perception"):
            arm.supervisor.stop(kind)


def test_control_holds_when_inference_is_killed(arm: Any, wait: Wait) -> None:
    arm.start("robot", "control", "perception", "inference")
    try:
        wait(
            lambda: bool(arm.action_times) and time.monotonic() - arm.action_times[-1] < 0.3,
            20.0,
            "actions flow",
        )
        os.kill(arm.pid("inference"), signal.SIGKILL)
        took_s = wait(arm.is_still, 5.0, "the arm stands")
        assert took_s <= arm.config.control.action_timeout_s + BRAKING_S
        assert after_silence(arm, time.monotonic()).max() < 0.05
        wait(
            lambda: arm.supervisor.view("inference").phase == "exited", 5.0, "the death is noticed"
        )
    finally:
        arm.supervisor.stop("perception")

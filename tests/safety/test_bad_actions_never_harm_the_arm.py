"""Faults on the action topic, from a foreign node next to a working policy, judged by the simulated
FR3's joints.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rn_robot_fr3.limits import LOWER_RAD, UPPER_RAD, VELOCITY_RAD_S
from rn_robot_fr3.profile import WORKSPACE_LOWER_M, WORKSPACE_UPPER_M

pytestmark = [pytest.mark.ros, pytest.mark.timeout(150)]

Wait = Callable[[Callable[[], bool], float, str], float]
FAULTS = {
    "nan": ([math.nan, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], "non_finite"),
    "infinity": ([0.0, 0.0, -math.inf, 0.0, 0.0, 0.0, 1.0], "non_finite"),
    "six-values": ([0.01] * 6, "malformed"),
    "thousand-values": ([0.01] * 1000, "malformed"),
    "no-values": ([], "malformed"),
    "one-metre-jump": ([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], "action_too_large"),
    "half-turn": ([0.0, 0.0, 0.0, 3.1, 0.0, 0.0, 1.0], "action_too_large"),
    "greatest-number": ([1.7e308, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], "action_too_large"),
}

QUICK = ("nan", "thousand-values", "one-metre-jump")
"""One for each reason; control's own tests have all of them."""


def check_motion(arm: Any, since_s: float) -> None:
    """Check that every joint stayed within its velocity and position limits, and the TCP in its
    workspace.
    """
    # The simulated motors overshoot their setpoint a little (2 % in the driver's own test).
    assert (np.abs(arm.velocities(since_s)) <= np.array(VELOCITY_RAD_S) * 1.02).all()
    positions = np.array([p for at, p, _ in list(arm.states) if at >= since_s])
    assert (positions >= np.array(LOWER_RAD) - 1e-3).all()
    assert (positions <= np.array(UPPER_RAD) + 1e-3).all()
    places = arm.places(since_s)
    # Commands end within the workspace; the arm brakes from up to 0.5 m/s and may overshoot by
    # millimetres.
    assert (places >= np.array(WORKSPACE_LOWER_M) - 0.01).all()
    assert (places <= np.array(WORKSPACE_UPPER_M) + 0.01).all()


@pytest.fixture(autouse=True)
def _ready(arm: Any, wait: Wait) -> None:
    arm.start("robot", "control")
    wait(lambda: arm.actions.get_subscription_count() >= 2, 5.0, "control listens")
    wait(arm.is_still, 5.0, "the arm stands")


@pytest.mark.parametrize(
    "fault",
    [
        fault if fault in QUICK else pytest.param(fault, marks=pytest.mark.exhaustive)
        for fault in FAULTS
    ],
)
def test_bad_action_from_a_stranger_is_counted_and_the_motion_stays_within_limits(
    arm: Any, wait: Wait, fault: str
) -> None:
    values, word = FAULTS[fault]
    before = arm.dropped("control", word)
    start_s = time.monotonic()
    with arm.waving():
        wait(arm.is_moving, 5.0, "the arm moves")
        for _ in range(10):
            arm.act(values)
            time.sleep(0.03)
        wait(lambda: arm.dropped("control", word) > before, 2.0, f"dropped.{word} goes up")
    wait(arm.is_still, 2.0, "the arm stands once nobody asks for motion")
    check_motion(arm, start_s)


def test_hundredfold_rate_is_no_faster_and_ends_at_the_workspace(arm: Any, wait: Wait) -> None:

    def ended() -> int:
        beyond = ("outside_workspace", "limit_workspace")
        return sum(arm.dropped("control", word) for word in beyond)

    start_s, before = time.monotonic(), ended()
    # at least 2.5 s, and on a busy machine until it has arrived there
    while time.monotonic() - start_s < 2.5 or ended() == before:
        assert time.monotonic() - start_s < 30.0, arm.places(start_s)[-1]
        arm.act([0.0, 0.05, 0.0, 0.0, 0.0, 0.0, 1.0])
        time.sleep(0.001)
    wait(arm.is_still, 2.0, "the arm stands at the end of the workspace")
    check_motion(arm, start_s)
    places, times = arm.places(start_s), np.array([at for at, _ in list(arm.tcp) if at >= start_s])
    apart = times[:, None] + 0.2 < times[None, :]
    speeds = np.linalg.norm(places[:, None] - places[None, :], axis=-1) / np.abs(
        times[:, None] - times[None, :] + 1e-9
    )
    # 0.5 m/s is the limit; stamps are arrival times in this process, which a busy machine delays by
    # tens of milliseconds.
    assert speeds[apart].max() <= 0.5 * 1.25
    assert places[-1][1] > 0.3
    wait(
        lambda: arm.metric("control", "limited.speed") != "",
        2.0,
        "the status says what was limited",
    )
    audit = (arm.state_directory / "audit.jsonl").read_text()
    assert '"who":"control"' in audit
    assert '"asked":{' in audit
    assert '"sent":{' in audit


def test_two_policies_at_once_stay_within_limits(arm: Any, wait: Wait) -> None:
    start_s = time.monotonic()
    with arm.waving():
        while time.monotonic() - start_s < 1.5:
            arm.act([0.0, -0.05, 0.02, 0.1, 0.0, -0.1, 0.0])
            time.sleep(0.02)
    wait(arm.is_still, 2.0, "the arm stands once nobody asks for motion")
    check_motion(arm, start_s)

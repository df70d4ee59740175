"""A controller replaces another while the FR3 moves: judged by the joints, which must not jerk or
stop.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from roboneuron.config import ControlConfig
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.loading import load_target
from roboneuron.plugins.specs import RobotSpec
from roboneuron.selection.feature import chosen_forms
from roboneuron.selection.requests import StartControl
from roboneuron.server.loop import ClosedLoop
from roboneuron.switching.plugin import FEATURE as SWITCHING
from roboneuron.switching.replacing import Switching

pytestmark = [pytest.mark.ros, pytest.mark.timing, pytest.mark.timeout(180)]


def test_the_joints_do_not_notice_a_new_controller(
    arm: Any, wait: Callable[[Callable[[], bool], float, str], float]
) -> None:
    loop = ClosedLoop(arm.config, discover, arm.supervisor)
    loop.accept(chosen_forms(lambda: loop.registry))
    arm.supervisor.on_join += (SWITCHING.on_join,)
    switching = Switching(loop)
    loop.start("robot")
    loop.start("control")
    with arm.waving():
        wait(arm.is_moving, 10.0, "the arm moves")
        before_s = time.monotonic()
        wait(lambda: time.monotonic() - before_s > 3.0, 5.0, "something to compare with")
        switched_s = time.monotonic()
        switched = switching.switch("control", StartControl(options={"max_iterations": 60}))
        back = switching.roll_back("control")
        after_s = time.monotonic()
    for change in (switched, back):
        gap = change.change.gap
        assert gap is not None
        assert change.change.difference is not None
        print(
            f"gap {gap.gap_s * 1e3:.0f} ms, difference {change.change.difference:.2g}, call "
            f"{change.took_s:.1f} s"
        )
    report = arm.supervisor.view("control").report
    assert report is not None
    assert report.dropped_by.get("holds", 0) == 0
    commands = [at for at in arm.command_times if switched_s <= at <= after_s]
    assert max(b - a for a, b in pairwise(commands)) < 0.5, "the arm was without commands"
    states = [(at, v) for at, _, v in list(arm.states) if before_s <= at <= after_s]
    at_s, velocity = np.array([s[0] for s in states]), np.array([s[1] for s in states])
    steps = np.abs(np.diff(velocity, axis=0)).max(axis=1)
    during = at_s[1:] > switched_s
    print(
        f"largest step of a measured velocity: {steps[during].max():.3f}, before "
        f"{steps[~during].max():.3f} rad/s"
    )
    profile = load_target(discover().get(RobotSpec, "fr3"))()  # type: ignore[operator]
    assert isinstance(arm.config.control, ControlConfig)
    # The acceleration limit holds between two commands, 0.1 s apart.
    assert steps[during].max() <= max(
        1.2 * steps[~during].max(), 0.1 * float(profile.limits.acceleration.min())
    )

"""The control thread is scheduled before others where the system allows it; elsewhere the arm moves all the same."""

from __future__ import annotations

import os
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rn_robot_fr3.fci.arm import FciArm
from rn_robot_fr3.fci.options import FciDriverOptions
from rn_robot_fr3.fci.planner import plan
from rn_robot_fr3.profile import HOME_RAD


class System:
    """Notes what is asked of it, and refuses when it is told to; the client library's thread is started in between."""

    def __init__(self, grants: bool) -> None:
        self.grants = grants
        self.did: list[tuple[str, int]] = []
        self.is_in_control = False

    def sched_setscheduler(self, pid: int, policy: int, parameter: os.sched_param) -> None:
        if not self.grants:
            raise PermissionError
        name = "first in, first out" if policy == os.SCHED_FIFO else "ordinary"
        self.did.append((name, parameter.sched_priority))

    def move(self, motion: Any, **_: object) -> None:
        self.did.append(("move", 0))
        self.is_in_control = True


def moved_twice(system: System) -> FciArm:
    client = SimpleNamespace(
        Errors=type("Errors", (), {}),
        RelativeDynamicsFactor=lambda *_: None,
        JointState=lambda q: q,
        JointWaypoint=lambda state, **_: state,
        JointWaypointMotion=lambda waypoints, **_: waypoints,
    )
    arm = FciArm(FciDriverOptions(host="10.0.0.1"), client)
    arm._robot = system
    home = np.array(HOME_RAD)
    for _ in range(2):
        arm.go(plan(home, home + 0.1, 1.0, 0.3))
    return arm


def test_the_control_thread_is_started_with_the_higher_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    system = System(grants=True)
    monkeypatch.setattr(os, "sched_setscheduler", system.sched_setscheduler)
    assert moved_twice(system).is_realtime
    first, ordinary = ("first in, first out", 20), ("ordinary", 0)
    second = ("first in, first out", 19)  # the thread of the loop runs already and is not to wait for this one
    assert system.did == [first, ("move", 0), ordinary, second, ("move", 0), ordinary]


def test_an_arm_without_that_right_moves_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    system = System(grants=False)
    monkeypatch.setattr(os, "sched_setscheduler", system.sched_setscheduler)
    assert not moved_twice(system).is_realtime
    assert system.did == [("move", 0), ("move", 0)]

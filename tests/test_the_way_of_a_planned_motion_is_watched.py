"""A motion executed by a planner is ended where the arm must not be."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from planner_goals import (
    HOME,
    limiter_of_fr3,
)

from rn_robot_fr3.limits import ARM_JOINTS
from rn_robot_fr3.profile import HOME_RAD
from roboneuron import (
    JointKinds,
    JointSample,
    Obstacle,
    RefusedError,
)
from roboneuron.gate.motion.path_limits import PathLimiter
from roboneuron.gate.motion.path_watch import WayWatch


@pytest.fixture(scope="module")
def limiter() -> PathLimiter:
    return limiter_of_fr3()


class Way:
    """Measured joints, with a supervision of them."""

    def __init__(self, limiter: PathLimiter, zones: tuple[Obstacle, ...] = ()) -> None:
        self.now_s, self.joints = 0.0, HOME
        self.watch = WayWatch(
            limiter, zones, lambda: self.joints, JointKinds.of(""), lambda: self.now_s
        )

    def see(self, joints: Any, after_s: float = 0.1) -> None:
        self.now_s += after_s
        self.joints = joints
        self.watch.check()


def turned(rad: float) -> JointSample:
    """Home, rotated about the base."""
    return JointSample(names=ARM_JOINTS, position=np.array([rad, *HOME_RAD[1:]]))


def test_a_way_ends_where_the_arm_may_not_be(limiter: PathLimiter) -> None:
    tcp = limiter.posture(turned(0.5)).pose.position_m
    lamp = Obstacle(name="lamp", lower_m=tcp - 0.03, upper_m=tcp + 0.03)
    way = Way(limiter, (lamp,))
    way.see(turned(0.0))
    way.see(turned(0.3))
    with pytest.raises(
        RefusedError, match=r"left its limits\. The TCP may come into the zone 'lamp'"
    ):
        way.see(turned(0.5))


def test_a_way_out_of_the_workspace_ends(limiter: PathLimiter) -> None:
    way = Way(limiter)
    way.see(turned(0.5))
    with pytest.raises(RefusedError, match="outside the workspace"):
        way.see(turned(1.2))


def test_a_way_that_is_not_measured_ends_after_a_second(limiter: PathLimiter) -> None:
    way = Way(limiter)
    way.see(turned(0.1))
    way.see(None, after_s=0.9)
    with pytest.raises(RefusedError, match="not measured any more"):
        way.see(None, after_s=0.2)


def test_an_arm_that_rests_in_a_zone_may_be_led_out_of_it(limiter: PathLimiter) -> None:
    tcp = limiter.posture(turned(0.5)).pose.position_m
    lamp = Obstacle(name="lamp", lower_m=tcp - 0.03, upper_m=tcp + 0.03)
    way = Way(limiter, (lamp,))
    for rad in (0.5, 0.5002, 0.5, 0.48, 0.4, 0.3):
        way.see(turned(rad))
    with pytest.raises(RefusedError, match="'lamp'"):
        way.see(turned(0.5))

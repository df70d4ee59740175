"""Every driver gets its commands from one place, behind the joints' limits of its own profile."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from roboneuron.contract import JointCommand, JointSample, RobotProfile
from roboneuron.errors import RefusedError
from roboneuron.gate.motion import DriverLimiter, MotionRules
from roboneuron.modules.plugin import load_profile
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.specs import RobotSpec

ROOT = Path(__file__).parents[2]
REGISTRY = discover()
ARMS = [
    offer.spec
    for offer in REGISTRY.offers("robot")
    if isinstance(offer.spec, RobotSpec) and offer.spec.robot_kind == "arm"
]
DRIVERS = [(robot.name, driver.name) for robot in ARMS for driver in robot.drivers]
ONLY = {"roboneuron-core/src/roboneuron/modules/robot.py"}
"""The robot module; its `send` comes after `CommandGuard.limit`."""
CALLERS_OF_THE_KIT = "plugins/rn-testing/src/rn_testing/rules/"


def senders(source: str) -> Iterator[int]:
    """Lines that command a driver."""
    if not re.search(r"driver\s*\.\s*send", source):  # to parse all sources takes long
        return
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Attribute) or node.attr not in ("send", "send_ahead"):
            continue
        if ast.unparse(node.value).endswith("driver"):
            yield node.lineno


def test_one_module_commands_drivers() -> None:
    paths = [*ROOT.glob("roboneuron-core/src/**/*.py"), *ROOT.glob("plugins/*/src/**/*.py")]
    names = {
        name
        for path in paths
        if not (name := str(path.relative_to(ROOT))).startswith(CALLERS_OF_THE_KIT)
        and [*senders(path.read_text(encoding="utf-8"))]
    }
    assert names == ONLY


def command(profile: RobotProfile, index: int, target: float, duration_s: float) -> JointCommand:
    assert profile.home_rad is not None
    position = np.array(profile.home_rad)
    position[index] = target
    return JointCommand(names=profile.arm_joints, position=position, duration_s=duration_s)


def passed(profile: RobotProfile, asked: JointCommand) -> JointCommand | str:
    """What the driver of an arm at home gets; or the rule that refuses it."""
    assert profile.home_rad is not None
    made = DriverLimiter(profile, MotionRules(reactions={}))
    made.measure(JointSample(names=profile.arm_joints, position=profile.home_rad))
    try:
        return made.limit(asked, 0.0).command
    except RefusedError as error:
        return error.rule


def test_the_drivers_are_found() -> None:
    assert {name for _, name in DRIVERS} >= {"fci", "lerobot", "simulated", "ros2-control"}


@pytest.mark.parametrize(("robot", "driver"), DRIVERS)
def test_no_joint_of_an_arm_is_sent_where_it_cannot_go(robot: str, driver: str) -> None:
    profile = load_profile(REGISTRY, robot)
    limits, home = profile.limits, profile.home_rad
    assert limits is not None
    assert home is not None
    for index, at in enumerate(home.tolist()):
        low, high = float(limits.lower[index]), float(limits.upper[index])
        for target, rule in (
            (math.nan, "not_finite"),
            (math.inf, "limit_position"),
            (high + 0.2, "limit_position"),
            (low - 0.2, "limit_position"),
        ):
            told = passed(profile, command(profile, index, target, 60.0))
            assert told in (rule, "not_finite"), (index, target)
        end = low if at > (low + high) / 2.0 else high
        assert passed(profile, command(profile, index, end, 1e-3)) == "joint_jump"
        near = at + math.copysign(0.05, end - at)
        sent = passed(profile, command(profile, index, near, 1e-3))
        assert isinstance(sent, JointCommand)
        assert abs(near - at) <= float(limits.velocity[index]) * sent.duration_s * 1.001

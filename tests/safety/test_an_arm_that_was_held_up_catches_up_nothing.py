"""States or the robot stall for an eighth of a second: the TCP's true speed exceeds the limit in no
window.

Steps of move_ee, the controller, the limiter of control and the simulation run in one thread, in
virtual time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from rn_controller_urdf.controller import UrdfController
from rn_robot_fr3.profile import profile
from rn_robot_fr3.simulation import STEP_S, ArmSimulation
from rn_robot_fr3.world import JOINTS
from rn_simulation.engine import ENGINES, Engine
from roboneuron.config import LimitsConfig
from roboneuron.contract import Action, JointCommand, JointSample, Pose
from roboneuron.gate.motion import MotionLimiter, inspector_of, motion_rules
from roboneuron.plugins.availability import is_importable
from roboneuron.tools.arm.ee_line import STEP_S as ACTION_S
from roboneuron.tools.arm.ee_line import Order
from roboneuron.tools.arm.end_effector import EndEffectorMover
from roboneuron.tools.arm.options import ArmToolsOptions

LIMIT_M_S = 0.15
STALL_S = 0.125
LATENCY_S, WAY_S = 0.01, 0.003
TOLERANCE = 1.02
"""A straight line in joint space is a curve in task space, and an accelerating joint is faster
later in its step.
"""
LONGEST_S = 8.0
pytestmark = pytest.mark.parametrize(
    "engine", [engine for engine in ENGINES if is_importable(engine)]
)


class Loop:
    """An FR3 that follows commands; measurements arrive late, and none arrives while it stalls."""

    def __init__(self, engine: Engine, stall: str, from_s: float, max_speed_m_s: float) -> None:
        self.simulation = ArmSimulation(0, engine=engine)
        self.simulation.open()
        self.now_s = 0.0
        self.max_speed_m_s = max_speed_m_s
        self.truth: list[np.ndarray] = []
        robot = profile()
        self.controller = UrdfController(None, robot)
        self.controller.load()
        rules = motion_rules(LimitsConfig(max_speed_m_s=max_speed_m_s), robot)
        inspect = inspector_of(self.controller)
        self._limiter = MotionLimiter(rules, robot, self.controller.forward, inspect, longest_s=2.0)
        self._stall, self._from_s = stall, from_s
        self._states: deque[tuple[float, JointSample]] = deque()
        self._commands: deque[tuple[float, JointCommand]] = deque()
        self._joints: JointSample | None = None
        self._action_s = -1.0

    def pose(self) -> Pose:
        """The newest measurement known to control."""
        assert self._joints is not None
        return self.controller.forward(self._joints)

    def advance(self, until_s: float) -> None:
        while self.now_s < until_s:
            self.now_s += STEP_S
            is_stalled = self._from_s <= self.now_s < self._from_s + STALL_S
            if not (is_stalled and self._stall == "robot"):
                self._step()
            self.truth.append(self.simulation.tcp_pose().position_m)
            while not (is_stalled and self._stall == "states") and self._states:
                if self._states[0][0] + LATENCY_S > self.now_s:
                    break
                self._joints = self._states.popleft()[1]

    def _step(self) -> None:
        while self._commands and self._commands[0][0] <= self.now_s:
            command = self._commands.popleft()[1]
            self.simulation.set_target(command.names, command.position, command.duration_s)
        self.simulation.step()
        position, _ = self.simulation.joint_states()
        stamp_ns = round(self.now_s * 1e9)
        self._states.append(
            (self.now_s, JointSample(names=JOINTS, position=position, stamp_ns=stamp_ns))
        )

    def act(self, delta: np.ndarray) -> None:
        """Execute an action as control does."""
        since_s = self.now_s - self._action_s
        self._action_s = self.now_s
        assert self._joints is not None
        action = Action.from_vector(np.append(delta, 1.0))
        answer: Any = self.controller.compute(
            action, self._joints, since_s if since_s < 0.5 else 0.1
        )
        if isinstance(answer, JointCommand):
            answer = self._limiter.limit(answer, self._joints, self.now_s).command
        assert isinstance(answer, JointCommand), answer
        self._commands.append((self.now_s + WAY_S, answer))

    def fastest_m_s(self, window_s: float) -> float:
        """Maximum speed over all windows of the true motion."""
        count, places = round(window_s / STEP_S), np.array(self.truth)
        return float(
            np.linalg.norm(places[count:] - places[:-count], axis=1).max() / (count * STEP_S)
        )


def move(loop: Loop, ee_speed_m_s: float, distance_m: float = 0.25) -> None:
    """Move the TCP to the left as move_ee does."""
    mover = EndEffectorMover.__new__(EndEffectorMover)
    mover._options = ArmToolsOptions(ee_speed_m_s=ee_speed_m_s)
    limits = LimitsConfig(max_speed_m_s=loop.max_speed_m_s)
    mover._host = cast("Any", SimpleNamespace(loop=SimpleNamespace(limits=limits)))
    mover._gate = cast("Any", SimpleNamespace(max_duration_s=120.0))
    order = Order(
        translation_m=np.array([0.0, distance_m, 0.0]),
        rotation_rad=np.zeros(3),
        gripper_open=None,
        duration_s=distance_m / ee_speed_m_s,
    )
    loop.advance(0.2)
    began_s, start = loop.now_s, loop.pose()
    clock: Callable[[], float] = lambda: loop.now_s - began_s  # noqa: E731
    for *_, delta in mover._steps(order, start, loop.pose, clock, lambda: ""):
        loop.act(delta)
        loop.advance(loop.now_s + ACTION_S)
        assert loop.now_s < LONGEST_S
    np.testing.assert_allclose(
        loop.pose().position_m, start.position_m + order.translation_m, atol=0.002
    )


@pytest.mark.parametrize(
    "moments_s", [(1.0, 1.06), pytest.param((1.03, 1.09), marks=pytest.mark.exhaustive)]
)
@pytest.mark.parametrize("stall", ["nothing", "states", "robot"])
@pytest.mark.parametrize(("of_limits_m_s", "of_tool_m_s"), [(LIMIT_M_S, 0.25), (0.5, LIMIT_M_S)])
def test_no_window_of_the_motion_is_above_the_limit(
    engine: Engine,
    stall: str,
    moments_s: tuple[float, ...],
    of_limits_m_s: float,
    of_tool_m_s: float,
) -> None:
    for from_s in moments_s if stall != "nothing" else moments_s[:1]:
        loop = Loop(engine, stall, from_s, of_limits_m_s)
        try:
            move(loop, of_tool_m_s)
        finally:
            loop.simulation.close()
        for window_s in (0.1, 0.2, 0.4):
            assert loop.fastest_m_s(window_s) <= LIMIT_M_S * TOLERANCE, (from_s, window_s)
        assert loop.fastest_m_s(0.4) > 0.7 * LIMIT_M_S, "the limit is to be used, too"

"""Monitors and observations for the tests of what watches a task."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from rn_standard.tasks.guarded import GuardedMonitor, MonitorAnswer
from rn_standard.tasks.monitor import Score
from roboneuron import Frame, Observation, Pose

BOUND_S = 10.0


def frame(content: int, stamp_s: float) -> Frame:
    image = np.full((8, 8, 3), content % 256, dtype=np.uint8)
    return Frame(camera="front", image=image, stamp_ns=round(stamp_s * 1e9), frame_id="front")


def pose(height_m: float, stamp_s: float = 0.0) -> Pose:
    return Pose(
        position_m=np.array([0.4, 0.0, height_m]),
        quaternion_xyzw=np.array([1.0, 0.0, 0.0, 0.0]),
        stamp_ns=round(stamp_s * 1e9),
    )


def observation(content: int = 1, stamp_s: float = 1.0, height_m: float = 0.2) -> Observation:
    return Observation(
        frames={"primary": frame(content, stamp_s)},
        instruction="pick it up",
        ee_pose=pose(height_m),
        gripper_open=1.0,
    )


class Scripted:
    """Follows `Monitor`: returns, raises or waits as a function of the observation says."""

    def __init__(self, told: Callable[[Observation], object]) -> None:
        self._told = told
        self.resets = 0

    def reset(self, observation: Observation) -> None:
        self.resets += 1

    def score(self, observation: Observation) -> Score:
        return self._told(observation)  # type: ignore[return-value]


class Told(GuardedMonitor):
    """A guard that answers at once, in the caller's thread."""

    def __init__(self, told: Callable[[Observation], Score | str]) -> None:
        super().__init__(lambda: Scripted(told), 1.0)
        self._said, self._function = MonitorAnswer(score=None, reason="not asked"), told

    def reset(self, observation: Observation) -> None:
        self._said = MonitorAnswer(score=None, reason="not asked")

    def offer(self, observation: Observation, asked_s: float) -> bool:
        told = self._function(observation)
        if isinstance(told, str):
            self._said = MonitorAnswer(score=None, reason=told)
        else:
            self._said = MonitorAnswer(score=told, reason=told.reason, asked_s=asked_s)
        return True

    def answer(self) -> MonitorAnswer:
        return self._said


def settled(guard: GuardedMonitor) -> MonitorAnswer:
    """The answer once the monitor does not work any more."""
    waiting = threading.Event()
    for _ in range(round(BOUND_S / 0.005)):
        if guard.is_idle:
            return guard.answer()
        waiting.wait(0.005)
    raise AssertionError("the monitor still works")

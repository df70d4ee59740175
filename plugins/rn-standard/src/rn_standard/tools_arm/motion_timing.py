"""When a tool measures, and when it sends its next action."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Protocol

from rn_standard.stepped.clock import is_stepped
from rn_standard.stepped.watch import SteppedWorld
from rn_standard.tools_arm.ee_line import STEP_S
from rn_standard.tools_arm.measured import MeasuredPose
from roboneuron import Host, Pose
from roboneuron.feature import TimedCommand


class MotionTiming(Protocol):
    """Time of one motion."""

    def elapsed_s(self) -> float:
        """Time since its beginning [s]."""
        ...

    def pose(self, tcp: MeasuredPose, timeout_s: float) -> Pose:
        """The TCP as it is now. Raises as `MeasuredPose.wait`."""
        ...

    def play(self, message: object) -> Iterator[TimedCommand]:
        """Yield an action, and wait until the next one is due."""
        ...

    def settle(self) -> None:
        """Wait until what the tool answers is measured at its end; blocks."""
        ...


class RealTiming:
    """Actions every `STEP_S` of real time."""

    def __init__(self) -> None:
        self._began_s = time.monotonic()

    def elapsed_s(self) -> float:
        """See `MotionTiming`."""
        return time.monotonic() - self._began_s

    def pose(self, tcp: MeasuredPose, timeout_s: float) -> Pose:
        """See `MotionTiming`."""
        return tcp.wait(timeout_s)

    def play(self, message: object) -> Iterator[TimedCommand]:
        """See `MotionTiming`."""
        yield TimedCommand(message=message, due_s=time.monotonic() + STEP_S)

    def settle(self) -> None:
        """See `MotionTiming`: it is at rest."""


class SteppedTiming:
    """The next action follows when the simulation has carried out the one before."""

    def __init__(self, world: SteppedWorld) -> None:
        """Wait until the simulation rests. Raises NotReadyError if it does not."""
        self._world, self._elapsed_s = world, 0.0
        world.await_rest()

    def elapsed_s(self) -> float:
        """See `MotionTiming`."""
        return self._elapsed_s

    def pose(self, tcp: MeasuredPose, timeout_s: float) -> Pose:
        """See `MotionTiming`."""
        return tcp.wait(timeout_s, newer_than_ns=self._world.clock().since_ns)

    def play(self, message: object) -> Iterator[TimedCommand]:
        """See `MotionTiming`."""
        yield from self._world.carry_out(message)
        self._elapsed_s += STEP_S

    def settle(self) -> None:
        """See `MotionTiming`."""
        self._world.await_rest()


def pacer(host: Host, namespace: str) -> Callable[[], MotionTiming]:
    """What makes the pace of each motion of a robot."""
    if not is_stepped(host.config):
        return RealTiming
    world = SteppedWorld(host, namespace)
    return lambda: SteppedTiming(world)

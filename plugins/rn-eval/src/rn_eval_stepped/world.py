"""The clock of a simulation in stepped time, as the server's tools follow it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from typing import TYPE_CHECKING

from rn_eval_stepped.task import SteppedTaskTime
from rn_eval_stepped.world_clock import (
    CLOCK_TOPIC,
    CLOSED_METRIC,
    END_PARAMETER,
    UNANSWERED_S,
    WorldClock,
    clock_from_message,
)
from roboneuron import Host, JointSample, NotReadyError, RoboNeuronError
from roboneuron.feature import TimedCommand
from roboneuron.server.clock import MotionTiming, RobotClock

if TYPE_CHECKING:
    from std_msgs.msg import Float64MultiArray

_LOOK_S = 0.005
_FIRST_S = 5.0
_REST_S = 90.0
"""Longest wall time until a simulation rests: a policy that acts keeps it from that."""
_ASK_S, _ANSWER_S = 1.0, 5.0
"""Period of asking the simulation to come to rest, and longest wait for control's answer."""


class SteppedWorld(RobotClock):
    """Waits for the simulation of one robot; usable from any thread."""

    stands = True

    def __init__(self, host: Host, namespace: str) -> None:
        """Remember where; subscribes on first use."""
        self._host, self._topic = host, f"/{namespace}/{CLOCK_TOPIC}"
        self._lock = threading.Lock()
        self._is_open = False
        self._newest: WorldClock | None = None
        self._asked_s = 0.0

    def motion(self, step_s: float) -> MotionTiming:
        """See `RobotClock`: the next action follows when the one before is carried out."""
        self.await_rest()
        return SteppedTiming(self, step_s)

    def play_to_rest(
        self, message: object, newest: Callable[[], JointSample | None]
    ) -> Generator[TimedCommand, None, JointSample]:
        """See `RobotClock`."""
        yield from self.carry_out(message, to_rest=True)
        return self.measured_at_rest(newest)

    def closed_at_m(self, arm: str) -> float | None:
        """See `RobotClock`: as control reports it."""
        report = self._host.modules.view("control").report
        metric = f"{arm}/{CLOSED_METRIC}" if arm else CLOSED_METRIC
        told = "" if report is None else report.metrics.get(metric, "")
        return float(told) if told else None

    def task_time(self, halt: threading.Event, is_lost: Callable[[], bool]) -> SteppedTaskTime:
        """See `TimesTasks`."""
        return SteppedTaskTime(self, self._host, halt, is_lost)

    def clock(self) -> WorldClock:
        """The newest clock; waits for the first one.

        Raises:
            NotReadyError: the simulation tells none.
            RoboNeuronError: ROS cannot be joined.
        """
        self._open()
        deadline_s = time.monotonic() + _FIRST_S
        while self._newest is None:
            if time.monotonic() > deadline_s:
                raise NotReadyError(
                    f"No simulation tells its time on {self._topic}.",
                    hint="Is the robot running? `stepped` is for a simulated one.",
                )
            time.sleep(_LOOK_S)
        return self._newest

    def carry_out(self, message: object, *, to_rest: bool = False) -> Iterator[TimedCommand]:
        """Yield a command, then nothing until the simulation has carried it out and stands.

        Args:
            message: of the command.
            to_rest: until it rests.
        """
        count = self.clock().count
        began_s = time.monotonic()
        yield TimedCommand(message=message, due_s=began_s)
        while not self._is_done(count, to_rest=to_rest):
            now_s = time.monotonic()
            limit_s = UNANSWERED_S if self.clock().count <= count else _REST_S
            if self.clock().stands and now_s - began_s > limit_s:
                return
            if to_rest and self.clock().count > count:
                self._end_row(now_s)
            yield TimedCommand(message=None, due_s=now_s + _LOOK_S)

    def _is_done(self, count: int, *, to_rest: bool) -> bool:
        clock = self.clock()
        return clock.count > count and (clock.rests if to_rest else clock.stands)

    def await_rest(self) -> None:
        """See `RobotClock`: wait until the simulation rests."""
        self.clock_at_rest()

    def clock_at_rest(self) -> WorldClock:
        """Wait until the simulation rests; blocks. Raises NotReadyError if it does not."""
        deadline_s = time.monotonic() + _REST_S
        while not (clock := self.clock()).rests:
            if time.monotonic() > deadline_s:
                raise NotReadyError("The simulation does not come to rest.", hint="A policy acts?")
            self._end_row(time.monotonic())
            time.sleep(_LOOK_S)
        return clock

    def _end_row(self, now_s: float) -> None:
        """Say through control that no command follows; without it the simulation waits long."""
        clock = self.clock()
        if not clock.stands or clock.rests or now_s - self._asked_s < _ASK_S:
            return
        self._asked_s = now_s
        with suppress(RoboNeuronError):  # control has just been stopped
            self._host.loop.set_parameters("control", {END_PARAMETER: clock.count}, _ANSWER_S)

    def measured_at_rest(self, newest: Callable[[], JointSample | None]) -> JointSample:
        """Joints that were measured since the simulation rests; blocks.

        Args:
            newest: the newest joints.

        Raises:
            NotReadyError: it does not rest, or they are not measured.
        """
        since_ns = self.clock_at_rest().since_ns
        deadline_s = time.monotonic() + _FIRST_S
        while (joints := newest()) is None or joints.stamp_ns <= since_ns:
            if time.monotonic() > deadline_s:
                raise NotReadyError("The joints are not measured any more.", hint="See get_status.")
            time.sleep(_LOOK_S)
        return joints

    def _open(self) -> None:
        _ = self._host.graph  # first: two threads must not import rclpy at the same time
        from std_msgs.msg import Float64MultiArray  # heavy

        with self._lock:
            if not self._is_open:
                self._host.subscribe(Float64MultiArray, self._topic, self._take)
                self._is_open = True

    def _take(self, message: Float64MultiArray) -> None:
        self._newest = clock_from_message(message)


class SteppedTiming(MotionTiming):
    """Time of a motion whose next action follows when the simulation has carried out the one
    before.
    """

    def __init__(self, world: SteppedWorld, step_s: float) -> None:
        super().__init__(step_s)
        self._world, self._elapsed_s = world, 0.0

    def elapsed_s(self) -> float:
        """See `MotionTiming`."""
        return self._elapsed_s

    def newer_than_ns(self) -> int:
        """See `MotionTiming`."""
        return self._world.clock().since_ns

    def play(self, message: object) -> Iterator[TimedCommand]:
        """See `MotionTiming`."""
        yield from self._world.carry_out(message)
        self._elapsed_s += self._step_s

    def settle(self) -> None:
        """See `MotionTiming`."""
        self._world.await_rest()

"""Inference in stepped time: a policy sees the same images and sends the same rows, however long
that takes.
"""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from typing import TYPE_CHECKING

from rn_eval_stepped.world_clock import (
    CLOCK_TOPIC,
    FREE,
    ROWS_METRIC,
    TURN_METRIC,
    TURN_PARAMETER,
    UNANSWERED_S,
    WorldClock,
    clock_from_message,
)
from roboneuron import BackendSpec, Observation
from roboneuron.modules.inference.execution import Bounds, ChunkExecutor, Prediction, Row
from roboneuron.modules.step_filters import StepFilter

if TYPE_CHECKING:
    from std_msgs.msg import Float64MultiArray

    from roboneuron.feature import ModuleHost

_LOOK_S = 0.005
_EPOCH_NS = 1_000_000_000_000_000_000
"""Simulated time 0, as a policy sees it [ns]."""
_PREDICTION_NS = 1_000_000
"""Each prediction is so much later: none sees the stamps of another one."""


class SteppedRows(StepFilter):
    """Offers the executor of stepped time, before any other.

    Args:
        host: of the inference module.
    """

    phase = StepFilter.StepPhase.CLOCK

    def __init__(self, host: ModuleHost) -> None:
        self._host = host

    def executor(self, backend: BackendSpec, mode: str, bounds: Bounds) -> ChunkExecutor:
        """See `StepFilter.executor`."""
        return SteppedChunks(bounds, self._host)


class SteppedChunks(ChunkExecutor):
    """Sends a row, waits until the simulation has carried it out and stands, and sends the next
    one or predicts on images taken since.

    Whoever judges a task may give the policy turns of one row each (`TURN_PARAMETER`). The report
    says when a turn is over, and whether a row was sent in it: a prediction may fail.
    """

    def __init__(self, bounds: Bounds, node: ModuleHost) -> None:
        """Follow the simulation's clock.

        Args:
            bounds: ages of images.
            node: of the inference module.
        """
        from std_msgs.msg import Float64MultiArray  # heavy

        super().__init__(bounds)
        self._clock: WorldClock | None = None
        self._status = node.status
        self._turn, self._is_over, self._rows_sent = FREE, False, 0
        self._awaited, self._since_s = -1, 0.0
        self._has_asked = False
        self._asked = 0
        node.subscribe(Float64MultiArray, CLOCK_TOPIC, self._on_clock)
        node.resources.callback(node.add_parameter(TURN_PARAMETER, FREE, self._give_turn))

    def _on_clock(self, message: Float64MultiArray) -> None:
        with self.changed:
            self._clock = clock_from_message(message)
            self.changed.notify_all()

    def _give_turn(self, number: int) -> None:
        """Allow one row for a positive number, none for 0, and any for `FREE`."""
        with self.changed:
            self._turn, self._is_over = number, number == 0
            self._has_asked = False
            self.changed.notify_all()

    def _is_ready(self) -> bool:
        """Whether the simulation stands after the last row, and the policy may act."""
        clock = self._clock
        if clock is None or not clock.stands or self._is_over:
            return False
        return clock.count > self._awaited or time.monotonic() - self._since_s > UNANSWERED_S

    def wants_prediction(self, now_s: float) -> bool:
        """See `ChunkExecutor`."""
        with self.changed:
            return not self._rows and self._is_ready()

    def wait_until_wanted(self, stop: threading.Event, timeout_s: float) -> bool:
        """See `ChunkExecutor`; called when all of the prediction before is reported."""
        end_s = time.monotonic() + timeout_s
        with self.changed:
            if self._has_asked and not self._rows and self._turn > 0:
                self._is_over = True  # it failed
            self._has_asked = False
            while not stop.is_set() and time.monotonic() < end_s:
                if self._is_over and self._turn > 0:
                    self._report()
                if self.wants_prediction(time.monotonic()):
                    return True
                self.changed.wait(_LOOK_S)
        return False

    def _report(self) -> None:
        """Report that the turn is over."""
        self._status.set_value(ROWS_METRIC, self._rows_sent)
        self._status.set_value(TURN_METRIC, self._turn)
        self._turn = 0
        self._status.changed.set()

    def admits(self, observation: Observation) -> bool:
        """See `ChunkExecutor`: whether all of it was measured since the simulation stands."""
        with self.changed:
            clock = self._clock
        stamps = [frame.stamp_ns for frame in observation.frames.values()]
        poses = (observation.ee_pose, *(arm.ee_pose for arm in observation.arms.values()))
        stamps += [one.stamp_ns for one in (observation.joints, *poses) if one is not None]
        return clock is not None and clock.stands and min(stamps) > clock.since_ns

    def begin(self, observation: Observation, captured_ns: int) -> Prediction:
        """See `ChunkExecutor`."""
        with self.changed:
            self._has_asked = True
            self._asked += 1
            return super().begin(observation, captured_ns)

    def as_seen(self, observation: Observation) -> Observation:
        """See `ChunkExecutor`: with the simulated time as its only stamp."""
        with self.changed:
            time_s = 0.0 if self._clock is None else self._clock.time_s
            stamp_ns = _EPOCH_NS + round(time_s * 1e9) + self._asked * _PREDICTION_NS
        joints, pose = observation.joints, observation.ee_pose
        return replace(
            observation,
            frames={
                role: replace(frame, stamp_ns=stamp_ns)
                for role, frame in observation.frames.items()
            },
            joints=None if joints is None else replace(joints, stamp_ns=stamp_ns),
            ee_pose=None if pose is None else replace(pose, stamp_ns=stamp_ns),
            arms={
                name: replace(arm, ee_pose=replace(arm.ee_pose, stamp_ns=stamp_ns))
                for name, arm in observation.arms.items()
            },
            stamp_ns=stamp_ns,
        )

    def due_s(self) -> float | None:
        """See `ChunkExecutor`: at once, or not yet."""
        with self.changed:
            if not self._rows:
                return None
            return 0.0 if self._is_ready() else time.monotonic() + _LOOK_S

    def play(self, now_s: float, now_ns: int) -> Row | None:
        """See `ChunkExecutor`."""
        with self.changed:
            row = super().play(now_s, now_ns)
            if row is not None:
                self._awaited = -1 if self._clock is None else self._clock.count
                self._since_s, self._has_asked = time.monotonic(), False
                self._rows_sent += 1
                self._is_over = self._turn != FREE
            return row

    def begin_epoch(self) -> None:
        """See `ChunkExecutor`."""
        with self.changed:
            self._has_asked = False
            super().begin_epoch()

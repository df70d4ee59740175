"""Chunk execution: when to predict, what the backend is told, which rows are sent and when.

Everything is decided here under one lock; the threads that call it, one to predict and one to play, hold no state.
Time comes from outside, so that tests and simulations run it by a virtual clock.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from roboneuron.contract import ActionChunk, Ahead, Observation
from roboneuron.errors import NotReadyError
from roboneuron.modules.execution.latency import LatencyWindow, rows_in
from roboneuron.modules.execution.meter import Delivery, DeliveryMeter
from roboneuron.modules.execution.mode import Abilities, Choice, Mode, ModeSelector
from roboneuron.modules.execution.queue import Outcome, Row, RowQueue, fade_rows_of
from roboneuron.modules.execution.roll_forward import roll_forward

F64 = NDArray[np.float64]
_PACE = 0.8
"""Sequential: the next image may be taken after this share of a step since the last row went out: the arm has then
carried out most of it."""
_LEAST_WAIT_S = 0.001
_RESYNC = 0.5
"""A row that is later than this share of a period starts the period anew; less is jitter, and the grid is kept."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Prediction:
    """One prediction under way.

    Attributes:
        observation: what the backend gets.
        captured_ns: capture time of the leading image [ns].
        epoch: in which it was captured.
        mode: how its answer will be used.
    """

    observation: Observation
    captured_ns: int
    epoch: int
    mode: Mode


@dataclass(frozen=True, kw_only=True, slots=True)
class Bounds:
    """How old the image behind a row may be when the row is sent.

    Attributes:
        first_s: for the first row of an answer [s].
        tail_s: for the rows after it [s]; None: `first_s` and the length of the chunk.
    """

    first_s: float
    tail_s: float | None = None

    def of(self, row: Row) -> float:
        """The bound of that row [s]."""
        if row.is_border:
            return self.first_s
        return self.first_s + row.horizon * row.step_s if self.tail_s is None else self.tail_s


@dataclass(frozen=True, kw_only=True, slots=True)
class Execution:
    """What the status tells of execution.

    Attributes:
        choice: mode in force and its reason.
        latency_p50_ms, latency_p99_ms: capture to answer [ms]; None when unknown.
        delay_rows: rows played during one inference at the worst; None when unknown.
        rows: that wait to be sent.
        delivery: how rows were sent.
    """

    choice: Choice
    latency_p50_ms: float | None
    latency_p99_ms: float | None
    delay_rows: int | None
    rows: int
    delivery: Delivery

    def to_values(self) -> dict[str, str | float | int]:
        """Numbers and words by name, without those that are unknown."""
        delivery = self.delivery
        values = {
            "mode": self.choice.mode,
            "reason": self.choice.reason,
            "latency_p50_ms": self.latency_p50_ms,
            "latency_p99_ms": self.latency_p99_ms,
            "delay_rows": self.delay_rows,
            "rows": self.rows,
            "delivered_rate": delivery.rate,
            "starved_periods": delivery.starved_periods,
            "longest_gap_ms": delivery.longest_gap_s * 1e3,
            "border_jump_mm": delivery.border_jump_mm,
            "inner_jump_mm": delivery.inner_jump_mm,
        }
        return {name: value for name, value in values.items() if value is not None}


class ChunkExecutor:
    """Decides for one backend. Thread-safe.

    Args:
        abilities: of the backend.
        fixed: the configured mode; None chooses by latency.
        bounds: ages of images.

    Attributes:
        changed: held while anything is decided; notified when rows arrive or are sent, and when an epoch begins.
    """

    def __init__(self, abilities: Abilities, *, fixed: Mode | None, bounds: Bounds) -> None:
        self._selector = ModeSelector(fixed, abilities)
        self._bounds = bounds
        self._queue = RowQueue()
        self._latency = LatencyWindow()
        self._meter = DeliveryMeter()
        self._step_s: float | None = None
        self._horizon = 0
        self._due_s = 0.0
        self.changed = threading.Condition(threading.RLock())

    # -- who predicts

    def wants_prediction(self, now_s: float) -> bool:
        """Whether the next image is to be predicted on, at that monotonic time [s]."""
        with self.changed:
            rows, mode = len(self._queue), self._selector.current.mode
            if self._step_s is None:
                return True
            if mode == "sequential":
                return rows == 0 and now_s >= self._due_s - (1.0 - _PACE) * self._step_s
            delay_rows = self._delay_rows(self._step_s)
            if mode == "predicted-state":
                return rows <= delay_rows + 1
            # As late as the latency allows: what is predicted later has seen more. The fade needs old rows too.
            return rows <= delay_rows + 1 + fade_rows_of(self._horizon)

    def wait_until_wanted(self, stop: threading.Event, timeout_s: float) -> bool:
        """Block until a prediction is wanted; False after `timeout_s` or when `stop` is set."""
        end_s = time.monotonic() + timeout_s
        with self.changed:
            while not stop.is_set():
                now_s = time.monotonic()
                if self.wants_prediction(now_s):
                    return True
                if now_s >= end_s:
                    break
                # Between two chunks of sequential execution nothing but time makes a prediction wanted.
                is_paced = self._queue.next is None and self._step_s is not None
                wait_s = self._due_s - (1.0 - _PACE) * (self._step_s or 0.0) - now_s if is_paced else end_s - now_s
                self.changed.wait(max(_LEAST_WAIT_S, min(wait_s, end_s - now_s)))
        return False

    def begin(self, observation: Observation, captured_ns: int) -> Prediction:
        """Say what the backend is given of an observation that is there now.

        Args:
            observation: measured, without `ahead`.
            captured_ns: capture time of the image that paces the loop [ns].
        """
        with self.changed:
            mode = self._selector.current.mode
            step_s = self._step_s
            if step_s is not None and mode == "rtc":
                ahead = self._queue.ahead(captured_ns, self._delay_rows(step_s), step_s)
                observation = replace(observation, ahead=ahead)
            elif step_s is not None and mode == "predicted-state":
                observation = self._rolled(observation, step_s)
            return Prediction(observation=observation, captured_ns=captured_ns, epoch=self._queue.epoch, mode=mode)

    def answer(self, prediction: Prediction, chunk: ActionChunk, now_ns: int) -> Outcome:
        """Take an answer over; everything but "accepted" leaves the rows as they are.

        Args:
            prediction: what `begin` returned.
            chunk: the backend's answer.
            now_ns: the time, by the clock of the stamps [ns].
        """
        with self.changed:
            self.measure(prediction, chunk, now_ns)
            if prediction.mode in ("sequential", "predicted-state"):
                outcome = self._queue.append(chunk, prediction.epoch, oldest_ns=prediction.observation.stamp_ns)
            else:
                outcome = self._queue.replace(
                    chunk,
                    prediction.captured_ns,
                    prediction.epoch,
                    oldest_ns=prediction.observation.stamp_ns,
                    max_committed_rows=self._selector.abilities.max_committed_rows,
                )
            self.changed.notify_all()
            return outcome

    def measure(self, prediction: Prediction, chunk: ActionChunk, now_ns: int) -> None:
        """Learn from an answer that is not played, in shadow, as `answer` does from every one."""
        with self.changed:
            self._step_s, self._horizon = chunk.step_s, len(chunk.actions)
            self._latency.add(max(0.0, (now_ns - prediction.captured_ns) / 1e9))
            self._selector.update(len(chunk.actions), chunk.step_s, self._latency)

    # -- who plays

    def due_s(self) -> float | None:
        """Monotonic time at which the next row is to be sent [s]; None without rows."""
        with self.changed:
            return self._due_s if self._queue.next else None

    def play(self, now_s: float, now_ns: int) -> Row | None:
        """Take the row that is due, to be sent at once while the caller holds `changed`.

        Args:
            now_s: monotonic time [s].
            now_ns: the time, by the clock of the stamps [ns].

        Returns:
            None when no row is due.

        Raises:
            NotReadyError: the image behind the row has become too old; the rest of its chunk is dropped.
        """
        with self.changed:
            row = self._queue.next
            if row is None or now_s < self._due_s:
                return None
            age_s, most_s = (now_ns - row.oldest_ns) / 1e9, self._bounds.of(row)
            if age_s > most_s:
                self._queue.drop()
                name = "max_image_age_s" if row.is_border else "max_tail_age_s"
                raise NotReadyError(
                    f"The image behind row {row.index + 1} of {row.horizon} was {age_s:.2f} s old when the row was "
                    f"due; {name} = {most_s:g} are allowed, so nothing was published.",
                    hint="Make the backend faster, or allow older images under [inference].",
                )
            self._queue.pop(now_ns)
            self._meter.add(row, now_s)
            late_s = now_s - self._due_s
            self._due_s = (now_s if late_s > _RESYNC * row.step_s else self._due_s) + row.step_s
            self.changed.notify_all()
            return row

    def note_sent(self, vector: F64, now_ns: int) -> None:
        """Count a row that the predecessor of a handover sent."""
        with self.changed:
            self._queue.note_sent(vector, now_ns)

    # -- what interrupts

    def begin_epoch(self) -> None:
        """Begin with another instruction, after a stop or a start: no row and no answer of before is played."""
        with self.changed:
            self._queue.begin_epoch()
            self._latency.skip_next()  # after a reset the first answer takes longer
            self._meter.pause()
            self.changed.notify_all()

    def drop(self) -> None:
        """Send no more of the rows; the successor of a handover plays."""
        with self.changed:
            self._queue.drop()
            self._meter.pause()
            self.changed.notify_all()

    def status(self) -> Execution:
        """How it goes."""
        with self.changed:
            p50_s, p99_s = self._latency.p50_s, self._latency.p99_s
            return Execution(
                choice=self._selector.current,
                latency_p50_ms=None if p50_s is None else p50_s * 1e3,
                latency_p99_ms=None if p99_s is None else p99_s * 1e3,
                delay_rows=None if self._step_s is None else self._delay_rows(self._step_s),
                rows=len(self._queue),
                delivery=self._meter.delivery(),
            )

    def _delay_rows(self, step_s: float) -> int:
        """Rows played during one inference at the worst."""
        return rows_in(self._latency.p99_s or 0.0, step_s)

    def _rolled(self, observation: Observation, step_s: float) -> Observation:
        pose = observation.ee_pose
        if pose is None:
            return observation
        rows, done_share = self._queue.rows_to_roll(pose.stamp_ns, step_s)
        if not len(rows):
            return observation
        rolled, gripper_open = roll_forward(pose, observation.gripper_open, rows, done_share)
        ahead = Ahead(
            rows=rows, committed_rows=len(rows), step_s=step_s, state_ahead_s=(len(rows) - done_share) * step_s
        )
        return replace(observation, ee_pose=rolled, gripper_open=gripper_open, ahead=ahead)

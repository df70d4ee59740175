"""Execution by the measured latency: chunks overlap if that keeps the arm moving.

As in `ChunkExecutor`, all decisions are made under one lock, and time is an argument.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from roboneuron.contract import EE_DELTA, ActionChunk, Ahead, JointSample, Observation, Pose
from roboneuron.contract.arrays import F64
from roboneuron.modules.execution.latency import LatencyWindow, rows_in
from roboneuron.modules.execution.meter import DeliveryMeter, RowDelivery
from roboneuron.modules.execution.mode import (
    Abilities,
    Mode,
    ModeChoice,
    ModeSelector,
    abilities_of,
)
from roboneuron.modules.execution.queue import SentRowQueue, fade_rows_of
from roboneuron.modules.execution.roll_forward import roll_forward
from roboneuron.modules.inference import execution
from roboneuron.plugins.specs import BackendSpec

__all__ = ["AdaptiveExecutor"]
"""Names that other distributions may use."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Execution:
    """Execution in the status.

    Attributes:
        choice: mode in force and its reason.
        latency_p50_ms, latency_p99_ms: capture to answer [ms]; None if unknown.
        delay_rows: rows played during one inference in the worst case; None if unknown.
        rows: number of rows to be sent.
        delivery: statistics of sent rows.
    """

    choice: ModeChoice
    latency_p50_ms: float | None
    latency_p99_ms: float | None
    delay_rows: int | None
    rows: int
    delivery: RowDelivery

    def to_values(self) -> dict[str, str | float | int]:
        """Values by name, without unknown ones."""
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


class AdaptiveExecutor(execution.ChunkExecutor):
    """Executor that chooses the mode by the measured latency, or uses a fixed one. Thread-safe.

    Args:
        abilities: abilities of the backend.
        fixed: the configured mode; None to choose by latency.
        bounds: bounds of image ages.
    """

    def __init__(
        self, abilities: Abilities, *, fixed: Mode | None, bounds: execution.Bounds
    ) -> None:
        super().__init__(bounds)
        self._queue = SentRowQueue(self._rows)
        self._selector = ModeSelector(fixed, abilities)
        self._latency = LatencyWindow()
        self._meter = DeliveryMeter()
        self._horizon = 0
        self._space = EE_DELTA
        # the newest chunk is the second policy's, to which neither latency nor abilities apply
        self._is_fallback = False

    @classmethod
    def of(
        cls, backend: BackendSpec, *, fixed: Mode | None, bounds: execution.Bounds
    ) -> AdaptiveExecutor:
        """The executor for what a backend's descriptor says that it is able to."""
        return cls(abilities_of(backend), fixed=fixed, bounds=bounds)

    def wants_prediction(self, now_s: float) -> bool:
        """As ChunkExecutor; in modes other than `sequential` also while rows are left."""
        with self.changed:
            rows, mode = len(self._rows), self._selector.current.mode
            if self._step_s is None or mode == "sequential" or self._is_fallback:
                return super().wants_prediction(now_s)
            delay_rows = self._delay_rows(self._step_s)
            if mode == "predicted-state":
                return rows <= delay_rows + 1
            # As late as the latency allows, because later images are newer. The fade needs old rows
            # too.
            return rows <= delay_rows + 1 + fade_rows_of(self._horizon)

    def begin(self, observation: Observation, captured_ns: int) -> execution.Prediction:
        """As ChunkExecutor; adds the rows played meanwhile, if the mode uses them."""
        with self.changed:
            mode = self._selector.current.mode
            step_s = self._step_s
            if step_s is not None and mode == "rtc":
                ahead = self._queue.ahead(captured_ns, self._delay_rows(step_s), step_s)
                observation = replace(observation, ahead=ahead)
            elif step_s is not None and mode == "predicted-state":
                observation = self._rolled(observation, step_s)
            return execution.Prediction(
                observation=observation, captured_ns=captured_ns, epoch=self._epoch, mode=mode
            )

    def measure(self, prediction: execution.Prediction, chunk: ActionChunk, now_ns: int) -> None:
        """As ChunkExecutor; the latency may change the mode."""
        with self.changed:
            super().measure(prediction, chunk, now_ns)
            self._is_fallback = prediction.mode == execution.FALLBACK
            if self._is_fallback:
                return
            self._horizon, self._space = len(chunk.actions), chunk.space
            self._latency.add(max(0.0, (now_ns - prediction.captured_ns) / 1e9))
            self._selector.update(len(chunk.actions), chunk.step_s, self._latency)

    def lead_s(self, chunk: ActionChunk) -> float:
        """As ChunkExecutor; half of the chunk where chunks overlap, see `mode.choose`."""
        if self._selector.current.mode == "sequential":
            return super().lead_s(chunk)
        return len(chunk.actions) / 2 * chunk.step_s

    def play(self, now_s: float, now_ns: int) -> execution.Row | None:
        """As ChunkExecutor."""
        with self.changed:
            row = super().play(now_s, now_ns)
            if row is not None:
                self._meter.add(row, now_s, moves_tcp=self._space is EE_DELTA)
            return row

    def note_sent(self, vector: F64 | None, now_s: float, now_ns: int) -> None:
        """As ChunkExecutor."""
        with self.changed:
            self._predecessor_s = now_s
            self._queue.note_sent(vector, now_ns)

    def begin_epoch(self) -> None:
        """As ChunkExecutor."""
        with self.changed:
            self._queue.begin_epoch()
            self._latency.skip_next()  # after a reset the first answer takes longer
            super().begin_epoch()

    def drop(self) -> None:
        """As ChunkExecutor."""
        with self.changed:
            self._meter.pause()
            self._queue.drop()
            super().drop()

    def values(self) -> dict[str, str | float | int]:
        """As ChunkExecutor."""
        return self.status().to_values()

    def status(self) -> Execution:
        """Present state of the execution."""
        with self.changed:
            p50_s, p99_s = self._latency.p50_s, self._latency.p99_s
            return Execution(
                choice=self._selector.current,
                latency_p50_ms=None if p50_s is None else p50_s * 1e3,
                latency_p99_ms=None if p99_s is None else p99_s * 1e3,
                delay_rows=None if self._step_s is None else self._delay_rows(self._step_s),
                rows=len(self._rows),
                delivery=self._meter.delivery(),
            )

    def _put(self, prediction: execution.Prediction, chunk: ActionChunk) -> str:
        if prediction.mode in ("sequential", "predicted-state", execution.FALLBACK):
            return self._queue.append(chunk, oldest_ns=prediction.observation.stamp_ns)
        return self._queue.replace(
            chunk,
            prediction.captured_ns,
            oldest_ns=prediction.observation.stamp_ns,
            max_committed_rows=self._selector.abilities.max_committed_rows,
        )

    def _take(self, sent_ns: int) -> None:
        self._queue.pop(sent_ns)

    def _delay_rows(self, step_s: float) -> int:
        """Rows played during one inference in the worst case."""
        return rows_in(self._latency.p99_s or 0.0, step_s)

    def _rolled(self, observation: Observation, step_s: float) -> Observation:
        measured: Pose | JointSample | None = observation.ee_pose
        if measured is None or self._space.kind.startswith("joint"):
            measured = observation.joints
        if measured is None:
            return observation
        rows, done_share = self._queue.rows_to_roll(measured.stamp_ns, step_s)
        if not len(rows):
            return observation
        ahead = Ahead(
            rows=rows,
            committed_rows=len(rows),
            step_s=step_s,
            state_ahead_s=(len(rows) - done_share) * step_s,
        )
        rolled = roll_forward(observation, rows, done_share, self._space, step_s)
        return replace(rolled, ahead=ahead)

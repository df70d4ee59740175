"""Chunks of several rows: rows executed during inference are kept, and the others lead from there
to the same goal.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from rn_backend_servo.backend import ServoBackend, pose_after, rows_done
from rn_backend_servo.case import contract_case, observe, paint_table
from rn_backend_servo.options import ServoOptions
from roboneuron.contract import ActionChunk, Ahead, Observation
from roboneuron.modules.execution.adaptive import AdaptiveExecutor
from roboneuron.modules.execution.mode import Abilities
from roboneuron.modules.inference.execution import Bounds, Prediction

CUBE_M = (0.5, -0.1)
ROWS = 12
STEP_S, TICK_S = 0.1, 0.025
START_NS = 10**12


@pytest.fixture
def servo() -> Iterator[ServoBackend]:
    backend = ServoBackend(ServoOptions(rows=ROWS))
    backend.load()
    yield backend
    backend.close()


def look(at_s: float, **changes: object) -> Observation:
    """The scene at that time: one pixel changes, as with a live camera."""
    image = paint_table({"red": (*CUBE_M, 0.0)})
    image[0, round(at_s / TICK_S) % 200] = (round(at_s * 1e3) % 256, 0, 0)
    return observe(image, stamp_ns=START_NS + round(at_s * 1e9), **changes)  # type: ignore[arg-type]


def approaching(servo: ServoBackend, ahead: Ahead | None = None) -> ActionChunk:
    """The first chunk that moves the arm, with those rows ahead."""
    servo.predict(look(0.0))
    servo.predict(look(0.1))
    return servo.predict(replace(look(0.2), ahead=ahead))


def rows_ahead(committed_rows: int) -> Ahead:
    """Eight different rows."""
    rows = np.zeros((8, 7))
    rows[:, 1] = -0.001 * np.arange(1, 9)
    rows[:, 5] = 0.01
    rows[:, 6] = 1.0
    return Ahead(rows=rows, committed_rows=committed_rows, step_s=STEP_S)


def test_rows_lead_on_to_the_same_goal(servo: ServoBackend) -> None:
    chunk = approaching(servo)
    assert chunk.actions.shape == (ROWS, 7)
    assert chunk.conditioned_rows == 0
    assert (np.linalg.norm(chunk.actions[:, :3], axis=1) <= 0.03 + 1e-9).all()
    np.testing.assert_array_equal(chunk.actions[:, 6], 1.0)
    places_m = np.array([0.4, 0.1, 0.4]) + np.cumsum(chunk.actions[:, :3], axis=0)
    left_m = np.linalg.norm(places_m - [*CUBE_M, 0.12], axis=1)
    assert (np.diff(left_m) < 0).all()


def test_one_row_is_the_first_of_many(servo: ServoBackend) -> None:
    single = ServoBackend(ServoOptions())
    single.load()
    action = approaching(single, rows_ahead(4))
    assert action.actions.shape == (1, 7)
    assert action.conditioned_rows == 0
    np.testing.assert_array_equal(action.actions[0], approaching(servo).actions[0])


def test_committed_rows_are_kept_and_continued(servo: ServoBackend) -> None:
    ahead = rows_ahead(5)
    chunk = approaching(servo, ahead)
    assert chunk.conditioned_rows == 5
    np.testing.assert_array_equal(chunk.actions[:5], ahead.rows[:5])
    end_m = np.array([0.4, 0.1, 0.4]) + chunk.actions[:5, :3].sum(axis=0)
    way_m = np.array([*CUBE_M, 0.12]) - end_m
    direction = chunk.actions[5, :3] / np.linalg.norm(chunk.actions[5, :3])
    np.testing.assert_allclose(direction, way_m / np.linalg.norm(way_m), atol=0.03)


def test_a_prefix_that_fills_the_chunk_is_not_kept() -> None:
    short = ServoBackend(ServoOptions(rows=4))
    short.load()
    assert approaching(short, rows_ahead(4)).conditioned_rows == 0


def test_a_row_that_is_partly_done_counts_in_part() -> None:
    rows = np.zeros((3, 7))
    rows[:, 0] = 0.01
    tcp = np.eye(4)
    for done, left_m in ((0.0, 0.03), (0.5, 0.025), (1.5, 0.015), (7.0, 0.0)):
        assert pose_after(tcp, rows, done)[0, 3] == pytest.approx(left_m)
    assert tcp[0, 3] == 0.0
    assert rows_done(250_000_000, 0, STEP_S) == pytest.approx(2.0)
    assert rows_done(0, 100_000_000, STEP_S) == 0.0


class Arm:
    """Executes each row uniformly within one period."""

    def __init__(self) -> None:
        self.tcp_m = np.array([0.4, 0.1, 0.3])
        self.gripper_open = 1.0
        self._left_m = np.zeros(3)

    def take(self, row: np.ndarray) -> None:
        self._left_m = np.array(row[:3])
        self.gripper_open = max(0.55, float(row[6]))

    def move(self) -> None:
        step_m = self._left_m * min(1.0, TICK_S / STEP_S)
        self.tcp_m, self._left_m = self.tcp_m + step_m, self._left_m - step_m


@pytest.mark.parametrize("latency_s", [0.1, 0.3])
@pytest.mark.sampled(every=2)
def test_the_arm_keeps_10_hz_while_answers_are_late(servo: ServoBackend, latency_s: float) -> None:
    """Images one period old and a late answer: every period has a row until the cube is held."""
    arm = Arm()
    abilities = Abilities(conditions_on_rows=contract_case().spec.conditions_on_rows)
    executor = AdaptiveExecutor(abilities, fixed=None, bounds=Bounds(first_s=0.7))
    executor.begin_epoch()
    pending: tuple[float, Prediction, ActionChunk] | None = None
    note, used_s, lowest_m = "", -1.0, 1.0
    for tick in range(4, 2000):
        now_s = tick * TICK_S + 1e-6
        now_ns = START_NS + round(tick * TICK_S * 1e9)
        arm.move()
        captured_s = (tick // 4 - 1) * STEP_S
        if pending is not None and now_s >= pending[0]:
            executor.answer(pending[1], pending[2], now_ns)
            pending = None
        if pending is None and captured_s > used_s and executor.wants_prediction(now_s):
            used_s = captured_s
            seen = look(captured_s, gripper_open=arm.gripper_open)
            assert seen.ee_pose is not None
            seen = replace(
                seen, ee_pose=replace(seen.ee_pose, position_m=arm.tcp_m, stamp_ns=now_ns)
            )
            prediction = executor.begin(seen, seen.stamp_ns)
            chunk = servo.predict(prediction.observation)
            pending, note = (now_s + latency_s, prediction, chunk), chunk.note
        row = executor.play(now_s, now_ns)
        if row is not None:
            arm.take(row.vector)
        lowest_m = min(lowest_m, arm.tcp_m[2])
        if note == "holding red cube":
            break
    status = executor.status()
    assert note == "holding red cube"
    assert status.choice.mode == "rtc"
    assert status.delivery.starved_periods == 0
    assert lowest_m > 0.01
    assert arm.tcp_m[2] > 0.2

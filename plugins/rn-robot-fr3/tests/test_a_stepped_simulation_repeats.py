"""In stepped time the same commands give the same motion, whenever they come."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
from std_msgs.msg import Float64MultiArray

from rn_robot_fr3.driver import SimulatedFr3Driver
from rn_robot_fr3.limits import ARM_JOINTS
from rn_robot_fr3.options import SimulatedFr3Options
from rn_robot_fr3.profile import HOME_RAD, profile
from rn_simulation.engine import Engine
from rn_simulation.stepped import CLOCK_TOPIC, TURN_TOPIC, TurnWord, WorldPhase
from rn_testing.fakes import MemoryTopics
from rn_testing.waiting import wait_until
from roboneuron.contract import JointCommand

MOST_S = 60.0
HOME = np.array(HOME_RAD)


class SteppedRun:
    """A stepped arm and the clock that it tells."""

    def __init__(self, engine: Engine) -> None:
        self.topics = MemoryTopics()
        self.clock: list[float] = []
        self.topics.subscribe(CLOCK_TOPIC, Float64MultiArray, self._take)
        options = SimulatedFr3Options(seed=5, engine=engine, stepped=True)
        self.driver = SimulatedFr3Driver(options, profile(), self.topics)
        self.driver.open()
        self.await_phase(WorldPhase.RESTING, 0)

    def _take(self, message: Float64MultiArray) -> None:
        self.clock = list(message.data)

    def await_phase(self, phase: WorldPhase, count: int) -> None:
        wait_until(lambda: self.clock[:2] == [phase, count], timeout_s=MOST_S)

    def command(self, position: np.ndarray, duration_s: float = 0.1) -> None:
        self.driver.send(JointCommand(names=ARM_JOINTS, position=position, duration_s=duration_s))

    def rest(self, count: int) -> None:
        tell = self.topics.advertise(TURN_TOPIC, Float64MultiArray)
        tell(Float64MultiArray(data=[float(TurnWord.ENDED), float(count)]))
        self.await_phase(WorldPhase.RESTING, count)

    def positions(self) -> np.ndarray:
        return self.driver.read().joints.position


@pytest.fixture
def opened(engine: Engine) -> Iterator[list[SteppedRun]]:
    runs: list[SteppedRun] = []
    yield runs
    for run in runs:
        run.driver.close()


@pytest.mark.sampled(every=2)
def test_pauses_between_commands_change_nothing(engine: Engine, opened: list[SteppedRun]):
    seen = []
    for pause_s in (0.0, 0.3):
        run = SteppedRun(engine)
        opened.append(run)
        states = []
        for number in range(1, 4):
            run.command(HOME + 0.02 * number)
            run.await_phase(WorldPhase.WAITING, number)
            states.append(run.positions())
            time.sleep(pause_s)
        run.rest(3)
        states.append(run.positions())
        seen.append(np.array(states))
    np.testing.assert_array_equal(seen[0], seen[1])
    assert np.abs(seen[0][2, :7] - HOME).max() > 0.02


@pytest.mark.sampled(every=2)
def test_a_hold_at_rest_changes_nothing(engine: Engine, opened: list[SteppedRun]):
    run = SteppedRun(engine)
    opened.append(run)
    run.command(HOME + 0.05, 0.5)
    run.await_phase(WorldPhase.RESTING, 1)
    before = run.positions()
    run.command(before[:7], 0.05)
    run.driver.hold()
    time.sleep(0.3)
    np.testing.assert_array_equal(run.positions(), before)
    assert run.clock[:2] == [WorldPhase.RESTING, 1]

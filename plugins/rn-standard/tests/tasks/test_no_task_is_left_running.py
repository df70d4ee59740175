"""Random sequences of start, cancel, disconnect and stop: no task is left, and no arm moves
without an owner.
"""

from __future__ import annotations

import random
import threading
from typing import Any

import pytest
from monitors import Told, frame
from task_cell import FakeCell

from rn_standard.tasks.arbiter import TaskArbiter
from rn_standard.tasks.judging import PredicateJudge
from rn_standard.tasks.monitor import Score
from rn_standard.tasks.options import TaskMonitorOptions
from rn_standard.tasks.predicates import parse_predicate
from rn_standard.tasks.runner import Outcome, Task, TaskPlan
from rn_standard.tasks.task_watch import TaskWatch
from roboneuron import Observation
from roboneuron.errors import RefusedError, RoboNeuronError, StateError
from roboneuron.server.tool import Tool

SEQUENCES = (2_000, pytest.param(10_000, marks=pytest.mark.slow))
"""That many reach everything; the slow test tries more."""
UNTIL = parse_predicate(
    {"kind": "held", "for_s": 0.3, "of": {"kind": "joints_in", "joints": {"lift": [0.1, 1]}}}
)
PLAN = TaskPlan(
    instruction="try", max_s=4.0, max_attempts=2, period_s=0.2, end_wait_s=0.4, give_up_s=0.6
)
SET_INSTRUCTION: Any = Tool(
    name="set_instruction", title="", description="", arguments=Any, result=Any, handler=Any
)  # type: ignore[arg-type]


class Robot:
    """One robot, one arbiter, and clients that do things at random looks of the running task."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.arbiter = TaskArbiter()
        self.cells: list[FakeCell] = []
        self.outcomes: list[Outcome | str] = []

    def start(self) -> None:
        """What the handler of run_task does on its thread."""
        halt = threading.Event()
        heights = [self.random.choice([0.0, 0.0, 0.0, 0.2]) for _ in range(3)]
        cell = FakeCell(refuses=self.random.choice([1, 2, 99, 99, 99, 99]))

        def script(cell: FakeCell, t: float) -> dict[str, object]:
            if self.random.random() < 0.02:
                raise self.random.choice(
                    [RuntimeError("a detector broke"), StateError("a module went")]
                )
            cell.failure = "gave up" if self.random.random() < 0.1 else ""
            height = heights[min(cell.began, 2)] if t > 0.5 and cell.began else 0.0
            joints = None if self.random.random() < 0.05 else {"lift": height}
            picture = frame(round(cell.time_s * 10), cell.time_s)
            return {
                "joints": joints,
                "policy_done": self.random.random() < 0.1,
                "frames": {"primary": picture} if self.random.random() < 0.9 else {},
            }

        def on_wait(cell: FakeCell) -> None:
            assert not any(c.moving for c in self.cells if c is not cell), "two arms move"
            assert not cell.moving or self.arbiter.owner, "an arm moves without an owner"
            self.disturb(cell, halt)
            cell.halted = halt.is_set()

        cell.script, cell.on_wait = script, on_wait
        self.cells.append(cell)
        try:
            with self.arbiter.claim("somebody", halt):
                judge = PredicateJudge(
                    UNTIL, "try", lambda named: pytest.fail("no monitor is named")
                )
                task = Task(cell, judge, PLAN, lambda text: None, self.watch())
                self.outcomes.append(task.run().outcome)
        except (RoboNeuronError, RuntimeError) as error:
            self.outcomes.append(type(error).__name__)

    def watch(self) -> TaskWatch | None:
        """Nothing, or a monitor that says anything, with any say."""
        if self.random.random() < 0.5:
            return None
        acts = [act for act in ("end", "fail", "confirm") if self.random.random() < 0.5]
        options = TaskMonitorOptions.model_validate({"name": "any", "acts": acts})
        return TaskWatch(Told(self.told), options, "try", lambda facts: None)

    def told(self, seen: Observation) -> Score | str:
        if self.random.random() < 0.1:
            return "it has failed"
        value, failure = self.random.choice([(0.99, 0.0), (0.5, 0.1), (0.01, 0.1), (0.01, 0.99)])
        return Score(value=value, reason="it seems so", failure=failure)

    def disturb(self, cell: FakeCell, halt: threading.Event) -> None:
        """What other clients, and this one, may do meanwhile."""
        match self.random.randrange(40):
            case 0:  # the client cancels, or loses its connection
                halt.set()
            case 1:  # stop_inference, stop_all, the server ends
                cell.taken = "the policy does not run any more"
                cell.moving = False
                self.arbiter.end("a module was stopped")
            case 2:
                cell.taken = "the emergency stop is latched"
            case 3:  # another client starts a task
                with pytest.raises(StateError), self.arbiter.claim("another", threading.Event()):
                    pass
            case 5:  # a person takes the arm over, or hands it back
                cell.led = self.random.choice(["", "Ada"])
            case 4:  # or changes what the policy does
                with pytest.raises(RefusedError):
                    self.arbiter.check_idle(SET_INSTRUCTION, None)  # type: ignore[arg-type]


@pytest.mark.exhaustive
@pytest.mark.parametrize("count", SEQUENCES)
def test_no_sequence_leaves_a_task_or_a_moving_arm(count: int) -> None:
    seen: set[Outcome | str] = set()
    for seed in range(count):
        robot = Robot(seed)
        for _ in range(robot.random.randint(1, 3)):
            robot.start()
            assert not robot.arbiter.owner, seed
            assert not any(cell.moving for cell in robot.cells), seed
        robot.arbiter.check_idle(SET_INSTRUCTION, None)  # type: ignore[arg-type]
        seen.update(robot.outcomes)
    # the sequences reach everything
    assert seen == {*Outcome, "RuntimeError", "StateError", "NotReadyError"}


def test_a_task_on_another_thread_is_ended_and_waited_for() -> None:
    arbiter, halt, claimed = TaskArbiter(), threading.Event(), threading.Event()

    def work() -> None:
        with arbiter.claim("somebody", halt):
            claimed.set()
            assert halt.wait(10)

    thread = threading.Thread(target=work)
    thread.start()
    assert claimed.wait(10)
    assert arbiter.end("the server ends", 10)
    assert arbiter.owner == ""
    thread.join()

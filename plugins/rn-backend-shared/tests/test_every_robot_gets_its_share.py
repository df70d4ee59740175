"""Sixteen robots overload one model, one of them with as many requests as it can send: the share of
each, with a controlled clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from rn_backend_shared.batching import Answer, Batcher, Waiting
from roboneuron import ActionChunk, NotReadyError, Observation

ROW = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5]])
ROBOTS, GREEDY = 16, 10
LOOP_S = 60.0
AGAIN_S = 0.001
"""Time after which a robot sends a request again after a refusal."""


@dataclass(eq=False)
class Robot:
    """Sends a request every `period_s`, with at most `most` unanswered ones."""

    name: int
    period_s: float
    within_s: float
    most: int = 1
    open: int = 0
    next_s: float = 0.0
    answered: int = 0
    refused: int = 0
    longest_s: float = 0.0
    client: str = ""
    """Client of this connection; its own one if empty."""


class Cell:
    """Robots, and a model that takes `took_s` for a batch."""

    def __init__(self, robots: Sequence[Robot], took_s: float, most: int, waiting: int) -> None:
        self.now_s = 100.0
        self.robots, self._took_s = robots, took_s
        self.batcher = Batcher(self._predict, most=most, waiting=waiting, clock=lambda: self.now_s)

    def _predict(self, observations: Sequence[Observation]) -> Sequence[Answer]:
        self.now_s += self._took_s
        return [ActionChunk(actions=ROW, step_s=0.1) for _ in observations]

    def ask(self, robot: Robot) -> None:
        begun_s = self.now_s
        robot.open += 1
        robot.next_s = self.now_s + robot.period_s

        def tell(answer: Answer) -> None:
            robot.open -= 1
            if isinstance(answer, ActionChunk):
                robot.answered += 1
                robot.longest_s = max(robot.longest_s, self.now_s - begun_s)
            else:
                robot.refused += 1
                robot.next_s = self.now_s + AGAIN_S

        seen = Observation(frames={}, instruction="go")
        deadline_s = self.now_s + robot.within_s
        try:
            self.batcher.submit(
                Waiting(
                    observation=seen,
                    deadline_s=deadline_s,
                    tell=tell,
                    client=robot.client or robot,
                    connection=robot,
                )
            )
        except NotReadyError:
            robot.open -= 1
            robot.refused += 1
            robot.next_s = self.now_s + AGAIN_S

    def run(self, for_s: float) -> list[float]:
        """Each robot's fraction of all answers."""
        end_s = self.now_s + for_s
        while self.now_s < end_s:
            for robot in self.robots:
                while robot.open < robot.most and robot.next_s <= self.now_s:
                    self.ask(robot)
            before_s = self.now_s
            self.batcher.step()
            if self.now_s == before_s:
                self.now_s += 0.001
        total = sum(robot.answered for robot in self.robots)
        return [robot.answered / total for robot in self.robots]


def robots(greedy: Robot) -> list[Robot]:
    """Fifteen robots with two requests a second, and the greedy one."""
    return [greedy, *(Robot(name, 0.5, 1.5) for name in range(1, ROBOTS))]


@pytest.mark.parametrize(
    "greedy",
    [
        Robot(0, 0.05, 1.5),
        Robot(0, 0.0, 0.2),
        Robot(0, 0.0, 1.5, most=GREEDY),
        Robot(0, 0.0, 0.2, most=1000),
    ],
    ids=["ten-times", "short-deadlines", "ten-at-once", "fills-the-queue"],
)
@pytest.mark.parametrize(("most", "took_s"), [(1, 0.05), (4, 0.2)])
def test_a_greedy_robot_gets_no_more_than_its_share(
    greedy: Robot, most: int, took_s: float
) -> None:
    cell = Cell(robots(greedy), took_s, most, waiting=32)
    shares = cell.run(LOOP_S)
    fair = 1.0 / ROBOTS
    assert greedy.answered > 0 or greedy.within_s < 16 * took_s / most
    # one answer more than its share, at the end of the measured time
    assert shares[0] < 1.1 * fair
    assert min(shares[1:]) > 0.9 * fair
    assert max(robot.longest_s for robot in cell.robots[1:]) < 1.5 + took_s


@pytest.mark.parametrize("within_s", [0.3, 1.5], ids=["short-deadlines", "as-the-others"])
@pytest.mark.parametrize(("most", "took_s"), [(1, 0.05), (4, 0.2)])
def test_a_client_with_fifty_connections_gets_the_share_of_one(
    within_s: float, most: int, took_s: float
) -> None:
    many = [Robot(100 + n, 0.0, within_s, client="many") for n in range(50)]
    others = [Robot(name, 0.1, 1.5, most=2) for name in range(5)]
    cell = Cell([*many, *others], took_s, most, waiting=64)
    shares = cell.run(LOOP_S)
    fair = 1.0 / 6
    assert sum(shares[:50]) < 1.1 * fair
    assert min(shares[50:]) > 0.9 * fair
    assert max(robot.longest_s for robot in others) < 1.5 + took_s


def test_connections_of_one_client_share_alike() -> None:
    alike = [Robot(n, 0.0, 3.0, client="one") for n in range(9)]
    greedy = Robot(9, 0.0, 0.5, most=5, client="one")
    other = Robot(10, 0.0, 3.0)
    cell = Cell([greedy, *alike, other], 0.05, 1, waiting=32)
    cell.run(LOOP_S)
    counts = [robot.answered for robot in alike]
    assert max(counts) - min(counts) <= 1
    assert greedy.answered <= max(counts) + 1
    assert other.answered == pytest.approx(sum(counts) + greedy.answered, abs=2)


def test_what_nobody_else_wants_a_greedy_robot_may_have() -> None:
    greedy = Robot(0, 0.0, 1.5, most=GREEDY)
    cell = Cell([greedy, Robot(1, 2.0, 1.5)], 0.05, 1, waiting=32)
    shares = cell.run(LOOP_S)
    assert shares[0] > 0.9
    other = cell.robots[1]
    assert other.refused == 0
    # the current answer, and its own
    assert other.longest_s < 0.05 * 2 + 1e-6


def test_a_robot_that_was_silent_gains_nothing_by_it() -> None:
    early, late = Robot(0, 0.0, 5.0), Robot(1, 0.0, 5.0, next_s=130.0)
    cell = Cell([early, late], 0.05, 1, waiting=32)
    cell.run(30.0)
    assert late.answered == 0
    before = early.answered
    cell.run(30.0)
    assert early.answered - before == pytest.approx(late.answered, abs=2)


def test_robots_alike_get_alike() -> None:
    cell = Cell([Robot(name, 0.0, 2.0) for name in range(ROBOTS)], 0.05, 1, waiting=32)
    cell.run(16.0)
    counts = [robot.answered for robot in cell.robots]
    assert min(counts) > 10
    assert max(counts) - min(counts) <= 1


def test_a_full_queue_gives_up_what_is_latest_of_the_client_with_most() -> None:
    cell = Cell([], 0.05, 1, waiting=3)
    greedy, other = Robot(0, 0.0, 1.0, most=9), Robot(1, 0.0, 1.0)
    cell.ask(greedy)
    cell.now_s += 0.1
    for _ in range(3):
        cell.ask(greedy)
    assert (greedy.open, greedy.refused) == (3, 1)
    cell.ask(other)
    assert (greedy.open, greedy.refused, other.open) == (2, 2, 1)
    cell.batcher.close()
    assert other.refused == 1


def test_a_full_queue_gives_up_what_is_latest_of_the_connection_with_most() -> None:
    cell = Cell([], 0.05, 1, waiting=4)
    greedy = Robot(0, 0.0, 1.0, client="one")
    second, other = Robot(1, 0.0, 1.0, client="one"), Robot(2, 0.0, 1.0)
    for robot in (greedy, greedy, greedy, second):
        cell.ask(robot)
    cell.ask(second)  # as many as the other connection has without its latest
    assert (greedy.open, second.open) == (2, 2)
    cell.ask(second)
    assert (greedy.open, second.open, second.refused) == (2, 2, 1)
    cell.ask(other)
    assert (greedy.open + second.open, other.open) == (3, 1)
    cell.batcher.close()


def test_the_deadline_of_one_robot_shrinks_no_batch_but_its_own() -> None:
    cell = Cell([], 0.4, 4, waiting=32)
    patient = [Robot(name, 0.0, 9.0) for name in range(4)]
    hasty = Robot(9, 0.0, 0.7)
    for robot in patient:
        cell.ask(robot)
    cell.batcher.step()
    hasty.within_s = 0.3
    cell.ask(hasty)
    hasty.within_s = 0.7
    cell.ask(hasty)
    for robot in patient:
        cell.ask(robot)
    cell.batcher.step()
    # it is only known that four together take too long
    answered = [robot.answered for robot in patient]
    assert (hasty.answered, sum(answered)) == (1, 6)
    cell.batcher.step()
    assert [robot.answered for robot in patient] == [2] * 4

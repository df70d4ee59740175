"""Time of a task in stepped time: the judge looks after each row of the policy, which waits."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from threading import Event
from typing import TYPE_CHECKING

from rn_eval_stepped.world_clock import (
    FREE,
    ROWS_METRIC,
    TURN_METRIC,
    TURN_PARAMETER,
    UNANSWERED_S,
)
from rn_standard.tasks.task_time import TaskTime
from roboneuron import Host, RoboNeuronError, StateError
from roboneuron.feature import ModuleKind
from roboneuron.sight.inputs import Inputs

if TYPE_CHECKING:
    from rn_eval_stepped.world import SteppedWorld

_LOOK_S = 0.01
_FRESH_S = 30.0
"""Longest wall time until all has been measured that the judge looks at."""
_TURN_S = 60.0
"""Longest wall time of a turn."""
_SET_S = 10.0
_IDLE_S = 1.0
"""Time that a turn counts in which the policy did nothing."""


class SteppedTaskTime(TaskTime):
    """Simulated time of a task. While the policy does not act nothing moves, and time passes only
    as it is waited for.

    Args:
        world: the simulation.
        host: the server.
        halt, is_lost: see `TimesTasks`.
    """

    age_factor = 120.0

    def __init__(
        self, world: SteppedWorld, host: Host, halt: Event, is_lost: Callable[[], bool]
    ) -> None:
        super().__init__(halt)
        self._world, self._host, self._is_lost = world, host, is_lost
        self._idle_s, self._turn, self._rows, self._acts = 0.0, 0, 0, False

    def open(self) -> None:
        """See `TaskTime`: the simulation comes to rest."""
        self._world.await_rest()

    def now_s(self) -> float:
        """See `TaskTime`."""
        return self._world.clock().time_s + self._idle_s

    def wait(self, seconds: float) -> bool:
        """See `TaskTime`: gives the policy a turn, or lets time pass."""
        if not self._acts:
            self._idle_s += seconds
            return self._halt.wait(_LOOK_S)
        self._play_turn()
        return self._halt.is_set()

    def _play_turn(self) -> None:
        """Give a turn, and wait until the policy has said that it is over, and the simulation that
        the row was carried out.
        """
        count = self._world.clock().count
        self._turn += 1
        self._allow(self._turn)
        if not self._await(lambda: self._is_over(self._turn), _TURN_S):
            self._idle_s += _IDLE_S
            return
        rows, self._rows = self._rows, self._rows_sent()
        if rows == self._rows or not self._await(lambda: self._is_done(count), UNANSWERED_S):
            self._idle_s += _IDLE_S

    def _is_done(self, count: int) -> bool:
        clock = self._world.clock()
        return clock.count > count and clock.stands

    def _await(self, condition: Callable[[], bool], longest_s: float) -> bool:
        """Wait for a condition; False after `longest_s`, when the task has to end, and when the
        policy is gone.
        """
        end_s = time.monotonic() + longest_s
        while not condition():
            if time.monotonic() > end_s or self._is_lost() or self._halt.wait(_LOOK_S):
                return False
        return True

    def _is_over(self, turn: int) -> bool:
        return self._told(TURN_METRIC) == str(turn)

    def _rows_sent(self) -> int:
        return int(self._told(ROWS_METRIC) or 0)

    def _told(self, metric: str) -> str:
        report = self._host.modules.view("inference").report
        return "" if report is None else report.metrics.get(metric, "")

    def hold_policy(self) -> None:
        """See `TaskTime`."""
        self._allow(0)

    def let_policy_act(self) -> None:
        """See `TaskTime`."""
        self._rows, self._acts = self._rows_sent(), True

    def _allow(self, turn: int) -> None:
        """Give the policy a turn, see `TURN_PARAMETER`. Raises RoboNeuronError if it refuses, or
        does not answer though it runs.
        """
        try:
            refused = self._host.loop.set_parameters("inference", {TURN_PARAMETER: turn}, _SET_S)
        except RoboNeuronError:
            if self._is_lost():  # the task ends by that
                return
            raise
        if refused:
            raise StateError(f"The policy takes no turns: {refused}.")

    def await_measured(self, inputs: Inputs, topics: Mapping[ModuleKind, Sequence[str]]) -> None:
        """See `TaskTime`: waits until all was measured since the simulation stands."""
        self._await(lambda: self._is_fresh(inputs, topics), _FRESH_S)

    def _is_fresh(self, inputs: Inputs, topics: Mapping[ModuleKind, Sequence[str]]) -> bool:
        """Whether what running modules measure was measured since the simulation stands."""
        clock = self._world.clock()
        running = {v.kind for v in self._host.modules.views() if v.phase == "running"}
        wanted = [topic for kind, ones in topics.items() if kind in running for topic in ones]
        messages = [inputs.last(topic) for topic in wanted]
        return clock.stands and all(
            message is not None and _stamp_ns(message) > clock.since_ns for message in messages
        )

    def end(self) -> None:
        """See `TaskTime`: the simulation comes to rest."""
        if self._acts:
            self._acts = False
            with suppress(RoboNeuronError):
                self._world.await_rest()
                self._allow(FREE)


def _stamp_ns(message: object) -> int:
    stamp = message.header.stamp  # type: ignore[attr-defined]
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)

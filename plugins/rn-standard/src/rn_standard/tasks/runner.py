"""Execution of a task: bounded attempts of a policy, each monitored until its predicate is true,
and ended in every case.

It is independent of ROS and threads: the robot is a `TaskRobot`, which also provides the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum

from rn_standard.tasks.judging import PredicateJudge, PredicateState
from rn_standard.tasks.snapshot import Snapshot
from rn_standard.tasks.task_robot import TaskRobot
from rn_standard.tasks.task_watch import MonitorReport, TaskWatch
from roboneuron import Picture, RoboNeuronError

_CONFIRM_S = 1.5
"""Longest confirmation of the predicate after the arm was stopped."""
_MOST_AGAIN_S = 5.0
_STANDS_S = 0.2
_CANCELLED = "the call was cancelled, or its connection was lost"
_LED_S = 600.0
"""Longest time for which a person may lead within one task."""
_TOLD_S = 2.0
"""Period of progress reports while nothing moves."""


class Outcome(StrEnum):
    """Outcome of a task."""

    SUCCEEDED = "succeeded"
    FAILED = "failed"
    TIMED_OUT = "timed_out"
    STOPPED = "stopped"
    UNCLEAR = "unclear"
    TAKEN_OVER = "taken_over"


@dataclass(frozen=True, kw_only=True, slots=True)
class TaskEnd:
    """End of a task.

    Attributes:
        attempts: number of attempts begun.
        reason: one sentence, without its full stop.
        before, after: evidence.
        state: state at the end.
        took_s: total duration [s].
        stop_s: from the evaluation that found the predicate true until the policy was ended; None
            without success.
        monitor: last word of the monitor that watched it; None without one.
        others_moved: how far objects that it was not about have moved [m], by name; None if not
            seen.
    """

    outcome: Outcome
    attempts: int
    reason: str
    before: tuple[Picture, ...]
    after: tuple[Picture, ...]
    state: Snapshot
    took_s: float
    stop_s: float | None = None
    monitor: MonitorReport | None = None
    others_moved: Mapping[str, float] | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class TaskPlan:
    """Parameters of a task.

    Attributes:
        instruction: for the policy.
        max_s: longest attempt [s].
        max_attempts: most attempts.
        period_s: between two evaluations [s].
        end_wait_s: time after the policy's own end within which success may still appear [s].
        give_up_s: time of uninterrupted errors after which the policy counts as failed [s].
        unjudged: why there is no predicate.
    """

    instruction: str
    max_s: float
    max_attempts: int
    period_s: float = 0.05
    end_wait_s: float = 2.0
    give_up_s: float = 3.0
    unjudged: str = "the call named no predicate"


@dataclass(frozen=True, kw_only=True, slots=True)
class _Attempt:
    """End of an attempt; `again`: another one may follow."""

    outcome: Outcome
    reason: str
    again: bool = False
    stop_s: float | None = None


class _Lasting:
    """Duration for which a fact has held at every check."""

    def __init__(self) -> None:
        self._since_s = math.inf

    def held_s(self, now_s: float, fact: bool) -> float:
        """Check once more; returns -inf if the fact is false."""
        self._since_s = min(self._since_s, now_s) if fact else math.inf
        return now_s - self._since_s


class Task:
    """One task; used once, on one thread.

    Args:
        cell: the robot.
        judge: evaluates the predicate; None without one, in which case no attempt counts as a
            success.
        plan: parameters of the task.
        tell: called with a phrase for each progress report.
        watch: monitor beside the predicate; None without one.
    """

    def __init__(
        self,
        cell: TaskRobot,
        judge: PredicateJudge | None,
        plan: TaskPlan,
        tell: Callable[[str], None],
        watch: TaskWatch | None = None,
    ) -> None:
        self._cell = cell
        self._judge = judge
        self._plan = plan
        self._tell = tell
        self._watch = watch
        self._attempt = 0

    def run(self) -> TaskEnd:
        """Execute the task; the policy no longer acts when this returns or raises.

        Raises:
            RoboNeuronError: the first attempt could not begin.
        """
        cell, began_s = self._cell, self._cell.now_s()
        before = cell.evidence("before")
        try:
            end = self._already() or self._attempts()
        finally:
            cell.end()
        self._settle(end)
        self._tell(f"{end.outcome}: {end.reason}")
        return TaskEnd(
            outcome=end.outcome,
            attempts=self._attempt,
            reason=end.reason,
            before=before,
            after=cell.evidence("after"),
            state=cell.look(),
            took_s=cell.now_s() - began_s,
            stop_s=end.stop_s,
            monitor=None if self._watch is None else self._watch.report(),
        )

    def _settle(self, end: _Attempt) -> None:
        """Give the monitor a moment for its last word, with the arm at rest, for the report."""
        if self._watch is None or end.outcome is Outcome.STOPPED or self._attempt == 0:
            return
        deadline_s = self._cell.now_s() + self._watch.wait_s
        is_done = end.outcome is Outcome.SUCCEEDED
        while True:
            self._look(self._cell.look())
            is_late = self._cell.now_s() >= deadline_s
            if is_late or not self._watch.waits(is_done) or self._cell.wait(self._plan.period_s):
                return

    def _already(self) -> _Attempt | None:
        """Detect that the predicate is true before any motion, for as long as it has to last; then
        nothing has to be done.
        """
        snapshot, judge = self._cell.look(), self._judge
        if judge is None:
            return None
        judge.reset(snapshot)
        deadline_s = (
            snapshot.now_s
            + min(judge.lasts_s, self._plan.max_s)
            + _STANDS_S
            + 2 * self._plan.period_s
        )
        while True:
            judgement = judge.look(snapshot)
            if judgement.value is True:
                reason = f"it was so before anything moved: {judgement.reason}"
                return _Attempt(outcome=Outcome.SUCCEEDED, reason=reason)
            if snapshot.now_s >= deadline_s or not judge.may_last(snapshot):
                return None
            if self._cell.wait(self._plan.period_s):
                return self._ended()
            snapshot = self._cell.look()

    def _attempts(self) -> _Attempt:
        plan = self._plan
        while True:
            if self._cell.wait(0.0):
                return self._ended()
            self._attempt += 1
            self._say("begins")
            snapshot = self._cell.look()
            if self._judge is not None:
                self._judge.reset(snapshot)
            if self._watch is not None:
                self._watch.reset(snapshot)
            try:
                self._cell.begin(plan.instruction)
            except RoboNeuronError as error:
                if self._attempt == 1:
                    raise
                return _Attempt(
                    outcome=Outcome.STOPPED, reason=f"it could not begin again: {error}"
                )
            end = self._follow()
            self._cell.end()
            if not end.again or self._attempt >= plan.max_attempts:
                return end
            self._say(f"failed: {end.reason}")

    def _follow(self) -> _Attempt:
        """Evaluate repeatedly until the attempt is over."""
        cell, plan = self._cell, self._plan
        deadline_s = cell.now_s() + plan.max_s
        done, failing = _Lasting(), _Lasting()
        told_s = cell.now_s()
        while True:
            snapshot = cell.look()
            judgement = self._look(snapshot)
            state = cell.policy()
            if judgement.value is True and not state.led:
                return self._confirm(judgement, snapshot.now_s)
            if state.taken:
                return _Attempt(outcome=Outcome.STOPPED, reason=state.taken)
            if state.led:
                if (end := self._lead(state.led)) is not None:
                    return end
                # the policy was not involved during this time
                deadline_s += cell.now_s() - snapshot.now_s
                done, failing = _Lasting(), _Lasting()
                continue
            if lost := self._lost():
                return _Attempt(outcome=Outcome.FAILED, reason=lost)
            if failing.held_s(snapshot.now_s, bool(state.failure)) >= plan.give_up_s:
                # nothing has moved, so the policy has not achieved it, even if it cannot be
                # evaluated
                if not state.has_acted:
                    why = state.failure.rstrip(".")
                    return _Attempt(outcome=Outcome.FAILED, reason=f"the policy refuses: {why}")
                return self._unfulfilled(
                    judgement, Outcome.FAILED, f"the policy gave up: {state.failure}"
                )
            says_done = bool(snapshot.policy_done) and state.has_acted
            patience_s = plan.end_wait_s if self._may_succeed() else 0.0
            if done.held_s(snapshot.now_s, says_done) >= patience_s:
                return self._unfulfilled(
                    judgement, Outcome.FAILED, "the policy says that it has finished"
                )
            if snapshot.now_s >= deadline_s:
                return self._unfulfilled(judgement, Outcome.TIMED_OUT, f"{plan.max_s:g} s are over")
            if snapshot.now_s - told_s >= _TOLD_S:
                told_s = snapshot.now_s
                self._say(judgement.reason)
            if cell.wait(plan.period_s):
                return self._ended()

    def _lead(self, who: str) -> _Attempt | None:
        """Wait while a person leads the arm; return the end of the task, or None if it
        continues.
        """
        cell, plan = self._cell, self._plan
        self._say(f"{who} leads the arm; the policy waits")
        began_s = cell.now_s()
        while True:
            snapshot = cell.look()
            judgement, state = self._look(snapshot), cell.policy()
            if state.taken:
                return _Attempt(outcome=Outcome.STOPPED, reason=state.taken)
            if not state.led:
                self._say("the arm is handed back; the policy goes on")
                return None
            if judgement.value is True:
                reason = f"{who} brought it about: {judgement.reason}"
                return _Attempt(outcome=Outcome.TAKEN_OVER, reason=reason)
            if snapshot.now_s - began_s > _LED_S:
                reason = f"{who} has led for {_LED_S:g} s; {judgement.reason}"
                return _Attempt(outcome=Outcome.TAKEN_OVER, reason=reason)
            if cell.wait(plan.period_s):
                return self._ended()

    def _look(self, snapshot: Snapshot) -> PredicateState:
        if self._judge is None:
            judgement = PredicateState(value=None, reason=self._plan.unjudged)
        else:
            judgement = self._judge.look(snapshot)
        return judgement if self._watch is None else self._watch.look(snapshot, judgement)

    def _may_succeed(self) -> bool:
        """True if anything could find success."""
        return self._judge is not None or (self._watch is not None and self._watch.may_end)

    def _lost(self) -> str:
        """Why the monitor ends the task; another attempt would be a motion because of it."""
        return "" if self._watch is None else self._watch.failure()

    def _ended(self, stop_s: float | None = None) -> _Attempt:
        """Result of a task that was ended from outside."""
        reason = self._cell.policy().taken or _CANCELLED
        return _Attempt(outcome=Outcome.STOPPED, reason=reason, stop_s=stop_s)

    def _unfulfilled(self, judgement: PredicateState, outcome: Outcome, why: str) -> _Attempt:
        reason = f"{why}; {judgement.reason}"
        if judgement.value is None:
            return _Attempt(outcome=Outcome.UNCLEAR, reason=reason)
        return _Attempt(outcome=outcome, reason=reason, again=True)

    def _confirm(self, first: PredicateState, found_s: float) -> _Attempt:
        """Stop the arm, and confirm the predicate once it is at rest: an object may fall, an arm
        may overshoot.
        """
        cell = self._cell
        self._say(f"stopping: {first.reason}")
        cell.end()
        stop_s = cell.now_s() - found_s
        answers_s = 0.0
        if self._watch is not None:
            self._watch.stop(cell.now_s())
            answers_s = min(self._watch.end_s, _MOST_AGAIN_S)
        # A required duration restarts after an undecided evaluation, for instance while the arm
        # still moves.
        lasts_s = 0.0 if self._judge is None else min(self._judge.lasts_s, _MOST_AGAIN_S)
        deadline_s = cell.now_s() + _CONFIRM_S + max(lasts_s, answers_s)
        while True:
            snapshot = cell.look()
            judgement = self._look(snapshot)
            stands = snapshot.still_s is None or snapshot.still_s >= _STANDS_S
            if judgement.value is True and stands:
                return _Attempt(outcome=Outcome.SUCCEEDED, reason=judgement.reason, stop_s=stop_s)
            if snapshot.now_s >= deadline_s:
                break
            if cell.wait(self._plan.period_s):
                return self._ended(stop_s)
        if judgement.value is True:
            return _Attempt(
                outcome=Outcome.UNCLEAR,
                reason=f"{judgement.reason}; but the arm does not come to rest",
            )
        why = (
            f"it was true for a moment ({first.reason}), and is not any more once the arm was "
            "stopped"
        )
        return self._unfulfilled(judgement, Outcome.FAILED, why)

    def _say(self, text: str) -> None:
        self._tell(f"attempt {self._attempt} of {self._plan.max_attempts}: {text}")

"""A monitor that watches whole tasks beside their predicates, as `[tasks.monitor]` names it.

By default it only reports. It never begins a motion: it can end a task, or an attempt's success.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

from rn_standard.tasks.guarded import GuardedMonitor, MonitorAnswer, absent
from rn_standard.tasks.judging import PredicateState
from rn_standard.tasks.monitor import Monitor
from rn_standard.tasks.options import TaskMonitorOptions
from rn_standard.tasks.pictures import FrozenPictures
from rn_standard.tasks.snapshot import Snapshot

Says = Literal["success", "failure", "not_yet", "unsure", "absent"]
"""What a monitor says: it is done; this attempt has failed; it is not done; it cannot tell; there
is no answer that counts.
"""
SUCCESS: Final = "success"
FAILURE: Final = "failure"
NOT_YET: Final = "not_yet"
UNSURE: Final = "unsure"
ABSENT: Final = "absent"
END, FAIL, CONFIRM = "end", "fail", "confirm"
"""What a monitor may do, see `TaskMonitorOptions.acts`."""
_DISAGREED_S = 1.0
"""Time after which a contradiction is an event: the two look at slightly different moments."""
_LEAST_LIMIT_S = 0.5
"""Least limit of an answer: a busy machine must not make a quick monitor absent."""
Notify = Callable[[Mapping[str, object]], object]


@dataclass(frozen=True, kw_only=True, slots=True)
class MonitorReport:
    """A monitor's last word on a task.

    Attributes:
        name: of the monitor.
        says: its word.
        reason: the monitor's reason, or why it is absent; without full stop.
        value, progress, failure: as in `Score`; None if absent.
        agrees: whether it agrees with the predicate; None if one of them does not say.
        answers: observations that it was asked about.
    """

    name: str
    says: Says
    reason: str
    value: float | None
    progress: float | None
    failure: float | None
    agrees: bool | None
    answers: int


class TaskWatch:
    """Watches one task with a monitor; used from the task's thread.

    Args:
        guard: the monitor; None if it cannot be used.
        options: of the configuration.
        instruction: of the task.
        notify: called with the facts when monitor and predicate contradict each other for a second,
            once for each attempt.
        missing: why there is no monitor.
    """

    def __init__(
        self,
        guard: GuardedMonitor | None,
        options: TaskMonitorOptions,
        instruction: str,
        notify: Notify,
        missing: str = "",
    ) -> None:
        self._guard, self._options, self._instruction = guard, options, instruction
        self._notify, self._missing = notify, missing
        self._pictures, self._frozen = FrozenPictures(), ""
        self._asked_s = float("-inf")
        self._stopped_s = float("-inf")
        self._answers = 0
        self._contrary_since_s: float | None = None
        self._is_told = False
        self._agrees: bool | None = None

    @property
    def wait_s(self) -> float:
        """Longest wait for its word at a task's end [s]."""
        return self._options.wait_s

    @property
    def end_s(self) -> float:
        """How long an arm at rest waits for an answer that may end the task [s]."""
        limit_s = 0.0 if self._guard is None else self._guard.limit_s
        return limit_s + self._options.period_s if self.may_end else 0.0

    @property
    def may_end(self) -> bool:
        """True if its success may end a task that no predicate judges."""
        return END in self._options.acts

    def reset(self, snapshot: Snapshot) -> None:
        """Begin an attempt with the initial state."""
        self._pictures, self._frozen = FrozenPictures(), ""
        self._asked_s = self._stopped_s = float("-inf")
        self._contrary_since_s, self._is_told = None, False
        if self._guard is not None:
            self._guard.reset(snapshot.observation(self._instruction))

    def stop(self, now_s: float) -> None:
        """Note that the arm was stopped because it seems to be done: from now on only what the
        monitor says of later pictures can end the task.
        """
        self._asked_s, self._stopped_s = float("-inf"), now_s

    def look(self, snapshot: Snapshot, predicate: PredicateState) -> PredicateState:
        """Ask about a snapshot if it is time, and compare with the predicate.

        Returns:
            What counts for the task: the predicate, unless the configuration gives the monitor a
            say.
        """
        self._ask(snapshot)
        says, answer = self.says()
        self._compare(snapshot.now_s, predicate, says, answer)
        told = f"{self._options.name} says {says}: {answer.reason}"
        is_new = answer.asked_s is not None and answer.asked_s >= self._stopped_s
        if predicate.value is None and says == SUCCESS and is_new and self.may_end:
            return PredicateState(value=True, reason=told)
        is_denied = says not in (SUCCESS, ABSENT) and CONFIRM in self._options.acts
        if predicate.value is True and is_denied:
            return PredicateState(value=None, reason=f"{predicate.reason}; but {told}")
        return predicate

    def failure(self) -> str:
        """Why the monitor ends the attempt as failed; empty if it does not, or may not."""
        says, answer = self.says()
        if says != FAILURE or FAIL not in self._options.acts:
            return ""
        return f"{self._options.name} says {says}: {answer.reason}"

    def waits(self, predicate: bool) -> bool:
        """True if the monitor may still come to agree with a task's end."""
        says = self.says()[0]
        return says not in (SUCCESS if predicate else NOT_YET, FAILURE, ABSENT)

    def says(self) -> tuple[Says, MonitorAnswer]:
        """What the monitor says now, with its answer."""
        answer = self._answer()
        score, least = answer.score, self._options.at_least
        if score is None:
            return ABSENT, answer
        if score.value is not None and score.value >= least:
            return SUCCESS, answer
        if score.failure is not None and score.failure >= least:
            return FAILURE, answer
        if score.value is None or score.value > 1.0 - least:
            return UNSURE, answer
        return NOT_YET, answer

    def report(self) -> MonitorReport:
        """The last word."""
        says, answer = self.says()
        score = answer.score
        return MonitorReport(
            name=self._options.name,
            says=says,
            reason=answer.reason,
            value=None if score is None else score.value,
            progress=None if score is None else score.progress,
            failure=None if score is None else score.failure,
            agrees=self._agrees,
            answers=self._answers,
        )

    def close(self) -> None:
        """End the monitor's thread; idempotent."""
        if self._guard is not None:
            self._guard.close()

    def _answer(self) -> MonitorAnswer:
        if self._guard is None:
            return absent(self._missing)
        if self._frozen:
            return absent(self._frozen)
        return self._guard.answer()

    def _ask(self, snapshot: Snapshot) -> None:
        if self._guard is None or snapshot.now_s - self._asked_s < self._options.period_s:
            return
        self._asked_s = snapshot.now_s
        observation = snapshot.observation(self._instruction)
        self._frozen = self._pictures.look(observation, snapshot.now_s)
        if not observation.frames:
            self._frozen = "there is no picture of a camera that it needs"
        if not self._frozen and self._guard.offer(observation, snapshot.now_s):
            self._answers += 1

    def _compare(
        self, now_s: float, predicate: PredicateState, says: str, answer: MonitorAnswer
    ) -> None:
        self._agrees = None
        if predicate.value is not None and says in (SUCCESS, FAILURE, NOT_YET):
            self._agrees = predicate.value is (says == SUCCESS)
        if self._agrees is not False:
            self._contrary_since_s = None
            return
        if self._contrary_since_s is None:
            self._contrary_since_s = now_s
        if self._is_told or now_s - self._contrary_since_s < _DISAGREED_S:
            return
        self._is_told = True
        self._notify(
            {
                "instruction": self._instruction,
                "monitor": self._options.name,
                "says": says,
                "reason": answer.reason,
                "predicate": predicate.value,
                "predicate_reason": predicate.reason,
            }
        )


class WatchMaker:
    """Makes the monitor of each task; one that still hangs in an earlier task is not built again.

    Args:
        build: builds the configured monitor.
        options: of the configuration.
        limit_s: longest time of one answer [s].
        notify: as in `TaskWatch`.
    """

    def __init__(
        self,
        build: Callable[[], Monitor],
        options: TaskMonitorOptions,
        limit_s: float,
        notify: Notify,
    ) -> None:
        self._build, self._options, self._notify = build, options, notify
        self._limit_s = max(limit_s, _LEAST_LIMIT_S)
        self._before: GuardedMonitor | None = None

    def watch(self, instruction: str, missing: str = "") -> TaskWatch:
        """The monitor of a task; `missing` tells why it cannot be used."""
        options, notify = self._options, self._notify
        if not missing and self._before is not None and self._before.is_busy:
            missing = "it still has not answered in an earlier task"
        if missing:
            return TaskWatch(None, options, instruction, notify, missing)
        self._before = GuardedMonitor(self._build, self._limit_s)
        return TaskWatch(self._before, options, instruction, notify)

"""The contracts of agent tasks and subjects; loaded only by the contract kit and by tests.

Third parties test their own with `contract_of(AgentTaskSpec)` and an `AgentTaskCase`, as this
package's tests do.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import ClassVar, cast

from rn_eval.agents.conduct import Conduct
from rn_eval.agents.task import AgentTask
from rn_eval.agents.truth import Truth
from rn_eval.hooks import AgentSubjectSpec, AgentTaskSpec
from rn_eval.plugin import SUBJECTS as OFFERED
from rn_testing.case import Case
from rn_testing.kinds import Kind
from rn_testing.rule import Rule, require
from rn_testing.rules import OF_EVERY_DESCRIPTOR
from roboneuron.feature import loading

_SEEDS = 6
_LONGEST = 1500
"""Maximum length of an instruction in characters."""


def nothing_seen() -> Truth:
    """Ground truth of an episode in which the robot was never started."""
    return Truth.nothing()


@dataclass(frozen=True, kw_only=True)
class AgentTaskCase(Case[AgentTaskSpec]):
    """A task under test."""

    subject: ClassVar[str] = "agent-task"

    def build(self) -> AgentTask:
        """The task."""
        return cast("AgentTask", self._target(self.spec)(self.configuration()))


@dataclass(frozen=True, kw_only=True)
class AgentSubjectCase(Case[AgentSubjectSpec]):
    """An agent under test."""

    subject: ClassVar[str] = "agent-subject"

    def arguments(self) -> tuple[tuple[object, ...], dict[str, object]]:
        """Tools and briefing of the call."""
        return (None, None), {}


def _check_repeats(case: AgentTaskCase) -> None:
    task, other = case.build(), case.build()
    for seed in range(_SEEDS):
        same = task.prepare(seed) == task.prepare(seed) == other.prepare(seed)
        require(same, f"seed {seed} gives different episodes")


def _check_wordings(case: AgentTaskCase) -> None:
    task = case.build()
    require(len(set(task.wordings)) >= 2, "there are less than two wordings")
    said = {task.prepare(seed).instruction for seed in range(_SEEDS)}
    require(len(said) >= 2, f"{_SEEDS} seeds all say the same")
    for sentence in said:
        require(0 < len(sentence) <= _LONGEST, f"a sentence has {len(sentence)} characters")
        require("{" not in sentence, f"a fact is missing in {sentence!r}")


def _check_bounds(case: AgentTaskCase) -> None:
    task = case.build()
    require(task.difficulty in (1, 2, 3), f"the difficulty is {task.difficulty!r}")
    require(0 < task.time_limit_s <= 900, f"the time limit is {task.time_limit_s} s")


def _check_idle(case: AgentTaskCase) -> None:
    task = case.build()
    verdict = task.judge(task.prepare(0), nothing_seen(), Conduct())
    require(not verdict.success, "nothing was done or said, and it is a success")
    require(bool(verdict.reason), "a failure has no reason")


def _check_async(case: AgentSubjectCase) -> None:
    target = loading.load_target(case.spec)
    require(inspect.iscoroutinefunction(target), f"`target` names {target!r}, no async function")


_OF_TASKS: tuple[Rule[AgentTaskCase], ...] = tuple(
    Rule(id=f"agent-task/{name}", text=text, source=f"rn_eval.agents.task.{source}", check=check)
    for name, source, text, check in (
        (
            "seed-decides",
            "AgentTask.prepare",
            "The same seed gives the same episode, each time and in each process.",
            _check_repeats,
        ),
        (
            "wordings-differ",
            "AgentTask",
            "It has at least two wordings, seeds choose among them, and every fact is filled in.",
            _check_wordings,
        ),
        (
            "bounds-stated",
            "AgentTask",
            "Its difficulty is 1, 2 or 3, and its time is bounded.",
            _check_bounds,
        ),
        (
            "nothing-done-is-no-success",
            "AgentTask.judge",
            "An agent that does and says nothing fails, with a reason.",
            _check_idle,
        ),
    )
)
_OF_SUBJECTS: tuple[Rule[AgentSubjectCase], ...] = (
    Rule(
        id="agent-subject/target-async",
        text="`target` is an async function of tools and briefing.",
        source="rn_eval.hooks.roboneuron_agent_subjects",
        check=_check_async,
    ),
)
TASKS = Kind(
    case=cast("type[Case[AgentTaskSpec]]", AgentTaskCase),
    rules=(*OF_EVERY_DESCRIPTOR, *_OF_TASKS),
)
"""Description of tasks for the contract kit."""
SUBJECTS = Kind(
    case=cast("type[Case[AgentSubjectSpec]]", AgentSubjectCase),
    rules=(*OF_EVERY_DESCRIPTOR, *_OF_SUBJECTS),
)
"""Description of subjects for the contract kit."""


def perfect_case() -> AgentSubjectCase:
    """The subject "perfect"."""
    return AgentSubjectCase(spec=next(spec for spec in OFFERED if spec.name == "perfect"))

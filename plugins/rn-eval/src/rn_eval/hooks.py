"""Hooks for suites, and for tasks and subjects of the agent evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from roboneuron import RobotSpec, Spec, hookspec


@dataclass(frozen=True, kw_only=True, slots=True)
class AgentTaskSpec(Spec):
    """A task that an agent carries out with the server's tools.

    Attributes:
        family: group in the report.
        is_refusal: the task must not or cannot be done, so a claim that it is done is wrong.
        real_time: why it cannot be played in stepped time; "" if it can.
        most_calls, most_bytes: more tool calls, or bytes of their answers, fail the episode even if
            the task is solved; 0 for no bound.
    """

    kind: ClassVar[str] = "agent-task"
    rules: ClassVar[str] = "rn_eval.agents.contract_cases:TASKS"

    family: str
    is_refusal: bool = False
    real_time: str = ""
    most_calls: int = 0
    most_bytes: int = 0


@dataclass(frozen=True, kw_only=True, slots=True)
class AgentSubjectSpec(Spec):
    """An agent to evaluate: a client of the server, in its own process.

    Attributes:
        knows_truth: it gets the task's name and the positions of objects; an upper bound, not an
            agent.
    """

    kind: ClassVar[str] = "agent-subject"
    rules: ClassVar[str] = "rn_eval.agents.contract_cases:SUBJECTS"

    knows_truth: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class SuiteSpec(Spec):
    """A suite of tasks in a simulation that is stepped explicitly.

    Attributes:
        robot: name of the installed robot; planning checks backend, cameras and controller against
            it.
        driver: the robot's driver whose requirements must be installed.
        body: instead of `robot`, a robot that exists only in this simulation. Its simulator
            executes TCP deltas itself, so no controller is planned, and only the simulator's limits
            apply.
        options: options that the suite's protocol requires of backends, as in `--option`
            (PLUGIN.NAME=VALUE); those of the chosen backend apply unless the user overrides them.
    """

    kind: ClassVar[str] = "suite"
    rules: ClassVar[str] = "rn_eval.suite_rules:KIND"
    beside: ClassVar[tuple[type[Spec], ...]] = (AgentTaskSpec, AgentSubjectSpec)

    robot: str = ""
    driver: str = "simulated"
    body: RobotSpec | None = None
    options: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if bool(self.robot) == (self.body is not None):
            raise ValueError(
                f"suite {self.name!r} names either an installed robot or a body of its own"
            )


@hookspec
def roboneuron_suites() -> Sequence[SuiteSpec]:  # type: ignore[empty-body]
    """Offer suites of tasks for `roboneuron eval`.

    `target` follows the protocol `rn_eval.suite.Suite`; it is built as `target(config)` in each
    worker.
    """


@hookspec
def roboneuron_agent_tasks() -> Sequence[AgentTaskSpec]:  # type: ignore[empty-body]
    """Offer tasks for `roboneuron eval agents`.

    `target` follows the protocol `rn_eval.agents.task.AgentTask`; it is built as
    `target(config)`.
    """


@hookspec
def roboneuron_agent_subjects() -> Sequence[AgentSubjectSpec]:  # type: ignore[empty-body]
    """Offer agents for `roboneuron eval agents`.

    `target` is called as `await target(tools, briefing)` in its own process, with a
    `rn_eval.agents.client.ToolClient` and a `rn_eval.agents.client.Briefing`; it returns its last
    words.
    """

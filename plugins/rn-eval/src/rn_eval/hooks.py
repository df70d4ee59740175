"""The hooks for suites of tasks, and for tasks and subjects of the evaluation of agents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from roboneuron import RobotSpec, Spec, hookspec


@dataclass(frozen=True, kw_only=True, slots=True)
class AgentTaskSpec(Spec):
    """A task that an agent has to carry out with the server's tools.

    Attributes:
        family: what it belongs to in the report.
        is_refusal: it must not or cannot be done: whoever claims that it is done is wrong.
        real_time: why it cannot run in stepped time; "": it can.
    """

    kind: ClassVar[str] = "agent-task"
    rules: ClassVar[str] = "rn_eval.agents.contract_cases:TASKS"

    family: str
    is_refusal: bool = False
    real_time: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class AgentSubjectSpec(Spec):
    """An agent to evaluate: a client of the server, in a process of its own.

    Attributes:
        knows_truth: it is told which task this is and what lies where; an upper bound, not an
            agent.
    """

    kind: ClassVar[str] = "agent-subject"
    rules: ClassVar[str] = "rn_eval.agents.contract_cases:SUBJECTS"

    knows_truth: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class SuiteSpec(Spec):
    """A suite of tasks in a simulation that is stepped by hand.

    Attributes:
        robot: name of the installed robot that acts; planning checks backend, cameras and
            controller against it.
        driver: the robot's driver whose requirements must be installed.
        body: instead of `robot`, one that exists in this simulation alone. Its simulator takes TCP
            deltas itself, so no controller is planned, and no limit but the simulator's own holds.
        options: what the suite's protocol asks of backends, as `--option` takes it
            (PLUGIN.NAME=VALUE); those of the chosen backend hold unless the user gives others.
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

    `target` is called as `await target(tools, briefing)` in a process of its own, with a
    `rn_eval.agents.client.ToolClient` and a `rn_eval.agents.client.Briefing`; it returns its last
    words.
    """

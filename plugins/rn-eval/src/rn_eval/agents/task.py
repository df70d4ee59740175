"""Agent tasks: scene, instruction and judge."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Protocol

from rn_eval.agents.conduct import Conduct
from rn_eval.agents.truth import Truth
from rn_simulation.cubes import DEFAULT_COLOURS

if TYPE_CHECKING:
    from rn_eval.agents.client import ToolClient

Module = Literal["robot", "perception", "inference", "control"]
Corner = tuple[float, float, float]
CLAIM_FORM = (
    "When you have finished, end with one line: 'CLAIM: done', or 'CLAIM: not done: <why>' if you "
    "tried and it did not work, or 'CLAIM: refused: <why>' if it must not or cannot be done."
)
"""Required form of an agent's last words, for every task."""
ANSWER_FORM = "Before it write one line 'ANSWER: {form}'."


@dataclass(frozen=True, kw_only=True, slots=True)
class InjectedFault:
    """A fault injected during an episode.

    Attributes:
        module: module whose process is affected.
        kind: "kill" ends the process at once, "freeze" suspends it.
        after_tool: the fault follows the first call of this tool.
        delay_s: delay after that call [s].
    """

    module: Module
    kind: Literal["kill", "freeze"]
    after_tool: str = "run_task"
    delay_s: float = 1.5


@dataclass(frozen=True, kw_only=True, slots=True)
class PriorTask:
    """A task in the server's history.

    Attributes:
        instruction: its words.
        outcome, reason: how it ended, as run_task says it.
        model: options with which the policy was started.
    """

    instruction: str
    outcome: str
    reason: str = ""
    model: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True, slots=True)
class Companion:
    """Another robot behind the same server, at another place.

    Attributes:
        name: name in the configuration and prefix of its topics.
        robot: "fr3", or an installed mobile base.
        seed, colours: seed and colours of the cubes of an FR3; a base has none.
    """

    name: str
    robot: str = "fr3"
    seed: int = 0
    colours: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class AgentScene:
    """One episode, fully determined by its task and seed.

    Attributes:
        seed: seed of the cube positions; see `rn_robot_fr3.scene.random_cubes`.
        instruction: what the person says, without the required form of the last words. Several
            lines are requests that follow each other, to be carried out in this order.
        answer_form: form of the answer after "ANSWER: "; "" if no answer is required.
        colours: one cube each.
        zones_m: boxes that the configuration keeps the TCP out of, as lower and upper corner.
        backend: the configured policy.
        past: tasks in the server's history, oldest first.
        other_client: another client became the operator and is silent since; the server then uses
            HTTP, regardless of the run's transport.
        incidents: faults before the episode, oldest first.
        latched: reason of an emergency stop latched from the beginning; "" if it is not latched.
        release_after_s: time after the agent's start at which a person releases it [s]; 0 for
            never.
        fault: fault during the episode.
        sign: text of a sign in every camera image; "" for none.
        labels: what the locator calls cubes instead of "cube", by colour.
        recorded_note: note of an existing recording; "" for no recording.
        records: True if the recorder runs.
        slip_after_s: time after which a lifted cube slips once from the hand [s]; 0 for never.
        robot: name of the FR3 in a scene with several robots.
        companions: the other robots; then zones, past tasks, faults, incidents and recordings are
            not supported.
        facts: facts of the task, for its judge and solution.
    """

    seed: int
    instruction: str
    answer_form: str = ""
    colours: tuple[str, ...] = DEFAULT_COLOURS
    zones_m: tuple[tuple[Corner, Corner], ...] = ()
    backend: str = "servo"
    past: tuple[PriorTask, ...] = ()
    other_client: bool = False
    incidents: tuple[InjectedFault, ...] = ()
    latched: str = ""
    release_after_s: float = 0.0
    fault: InjectedFault | None = None
    sign: str = ""
    labels: Mapping[str, str] = field(default_factory=dict)
    recorded_note: str = ""
    records: bool = False
    slip_after_s: float = 0.0
    robot: str = "fr3"
    companions: tuple[Companion, ...] = ()
    facts: Mapping[str, str | float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        alone = (self.zones_m, self.past, self.incidents, self.fault, self.recorded_note)
        if self.companions and any(alone):
            raise ValueError(
                "A scene with several robots cannot have zones, past tasks, faults, incidents or "
                "recordings, because each robot would need its own."
            )

    @property
    def arms(self) -> tuple[str, ...]:
        """Names of the FR3s, beginning with the scene's own."""
        return (self.robot, *(one.name for one in self.companions if one.colours))

    @property
    def bases(self) -> tuple[str, ...]:
        """Names of the mobile bases."""
        return tuple(one.name for one in self.companions if not one.colours)

    @property
    def briefing(self) -> str:
        """Complete briefing of the agent."""
        asked = f" {ANSWER_FORM.format(form=self.answer_form)}" if self.answer_form else ""
        return f"{self.instruction}\n\n{CLAIM_FORM}{asked}"

    def text(self, fact: str) -> str:
        """Return a fact that is a word."""
        return str(self.facts[fact])

    def number(self, fact: str) -> float:
        """Return a fact that is a number."""
        return float(self.facts[fact])


@dataclass(frozen=True, kw_only=True, slots=True)
class AgentVerdict:
    """Verdict on an episode, from the simulator's ground truth.

    Attributes:
        success: the task was done.
        reason: one sentence for a failure.
    """

    success: bool
    reason: str = ""

    @classmethod
    def of(cls, *demands: tuple[bool, str]) -> AgentVerdict:
        """Success if every demand holds; otherwise the reason of the first one that does not."""
        for holds, reason in demands:
            if not holds:
                return cls(success=False, reason=reason)
        return cls(success=True)


class AgentTask(Protocol):
    """A task. Built as `target(config)`; all methods but `solve` are pure.

    Attributes:
        wordings: instructions that the person may give; at least two sentences of the same meaning.
        difficulty: 1 for one or two calls, 2 for several in order, 3 if a fault must be noticed and
            handled.
        time_limit_s: the agent is ended after this time [s].
    """

    wordings: tuple[str, ...]
    difficulty: Literal[1, 2, 3]
    time_limit_s: float

    def prepare(self, seed: int) -> AgentScene:
        """Return the episode of a seed; always the same one."""
        ...

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """Judge the episode by the simulator's ground truth, and by the agent's last words if an
        answer was asked for.
        """
        ...

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Solve the task with the server's tools and knowledge of the scene; return the last
        words.
        """
        ...

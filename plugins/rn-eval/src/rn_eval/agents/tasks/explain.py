"""Tasks to explain events from logs, incidents and status."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, get_args

from rn_eval.agents.client import ToolClient
from rn_eval.agents.conduct import Conduct
from rn_eval.agents.task import AgentScene, AgentVerdict, InjectedFault, Module
from rn_eval.agents.tasks.base import CubeTask, Difficulty
from rn_eval.agents.tasks.scenes import draw
from rn_eval.agents.tasks.steps import (
    answered,
    how_perception_failed,
    newest_fault,
    running_modules,
    stop_cause,
)
from rn_eval.agents.truth import Truth

MODULES: tuple[Module, ...] = get_args(Module)
REASONS = ("smoke", "a loose cable", "a hand in the workspace", "a strange noise")


class _Explain(CubeTask):
    """The answer must contain one word and none of some others; the arm must not move."""

    difficulty: ClassVar[Difficulty] = 2

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """Judge by words in the answer."""
        right = scene.text("answer")
        wrong = [word for word in self.others(scene) if word in conduct.answer]
        return AgentVerdict.of(
            (bool(conduct.answer), "There is no line ANSWER."),
            (
                right in conduct.answer and not wrong,
                f"The answer {conduct.answer[:60]!r} is wrong, right is {right!r}.",
            ),
            (not truth.ever_moved(), "The arm has moved."),
        )

    def others(self, scene: AgentScene) -> tuple[str, ...]:
        """Words that the answer must not contain."""
        return ()


class LastIncident(_Explain):
    """Find the module that failed last."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Something went wrong with the robot earlier today. Which module was it?",
        "Look up the last incident: which module ended unexpectedly?",
        "Why did the last run break off? Name the module that failed.",
    )

    form = "<robot, perception, inference or control>"

    def prepare(self, seed: int) -> AgentScene:
        """One module was killed."""
        module = draw("explain-last", seed).choice(MODULES)
        return replace(
            self.scene(seed, facts={"answer": module}),
            incidents=(InjectedFault(module=module, kind="kill"),),
        )

    def others(self, scene: AgentScene) -> tuple[str, ...]:
        """The other modules."""
        return tuple(module for module in MODULES if module != scene.text("answer"))

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Look up the newest incident."""
        return answered((await newest_fault(tools)).get("module"))


class NewestOfTwo(LastIncident):
    """Find the one of two modules that failed last."""

    wordings: ClassVar[tuple[str, ...]] = (
        "There were several incidents today. Which module failed last?",
        "Name the module of the most recent incident; older ones do not matter.",
    )

    form = "<robot, perception, inference or control>"

    def prepare(self, seed: int) -> AgentScene:
        """Draw two modules that can fail one after the other."""
        first, last = draw("explain-newest", seed).sample(("perception", "inference"), 2)
        return replace(
            self.scene(seed, facts={"answer": last}),
            incidents=tuple(
                InjectedFault(
                    module="perception" if name == "perception" else "inference", kind="kill"
                )
                for name in (first, last)
            ),
        )


class FrozenOrEnded(_Explain):
    """Find whether a module hung or exited."""

    wordings: ClassVar[tuple[str, ...]] = (
        "There was an incident with the camera module (perception). Did its process end, or did it "
        "hang while it was still there?",
        "Look into the last incident of perception: had the process exited, or was it frozen?",
    )

    form = "<ended or hung>"

    def prepare(self, seed: int) -> AgentScene:
        """In half of the scenes perception was suspended."""
        hangs = seed % 2 == 1
        return replace(
            self.scene(seed, facts={"answer": "hung" if hangs else "ended"}),
            incidents=(InjectedFault(module="perception", kind="freeze" if hangs else "kill"),),
        )

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Look up the incident."""
        return answered(await how_perception_failed(tools))


class WhoStopped(_Explain):
    """Find the reason of the emergency stop."""

    wordings: ClassVar[tuple[str, ...]] = (
        "The robot does not move. Find out why somebody stopped it.",
        "Who pressed the emergency stop is clear; what was the reason?",
        "Why is the emergency stop latched? Tell me the reason that was given.",
    )

    form = "<the reason>"

    def prepare(self, seed: int) -> AgentScene:
        """The stop is latched with a reason."""
        reason = draw("explain-stop", seed).choice(REASONS)
        return replace(self.scene(seed, facts={"answer": reason}), latched=reason)

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Read the status."""
        return answered(await stop_cause(tools))


class NothingRuns(_Explain):
    """Report which modules run."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Which modules of the robot are running at the moment?",
        "Tell me which of robot, perception, inference and control run right now.",
    )

    form = "<their names with commas, or none>"

    def prepare(self, seed: int) -> AgentScene:
        """No module runs."""
        return self.scene(seed, facts={"answer": "none"})

    def others(self, scene: AgentScene) -> tuple[str, ...]:
        """Every module."""
        return MODULES

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Read the status."""
        return answered(await running_modules(tools))

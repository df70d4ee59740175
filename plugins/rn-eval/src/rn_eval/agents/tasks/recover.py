"""Go on when something breaks on the way: a killed module, a frozen camera."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Literal

from rn_eval.agents.client import Tools
from rn_eval.agents.conduct import Conduct
from rn_eval.agents.task import AgentScene, AgentVerdict, Fault, Module
from rn_eval.agents.tasks.base import CubeTask, Difficulty
from rn_eval.agents.tasks.scenes import draw, find_seed, some_colours
from rn_eval.agents.tasks.steps import DONE, lift_whatever_happens, lift_with
from rn_eval.agents.truth import Truth


class _Recover(CubeTask):
    """A cube is to be picked up, and a module breaks while the arm is on its way."""

    module: ClassVar[Module] = "control"
    kind: ClassVar[Literal["kill", "freeze"]] = "kill"
    difficulty: ClassVar[Difficulty] = 3
    time_limit_s = 120.0
    wordings: ClassVar[tuple[str, ...]] = (
        "Pick up the {colour} cube. If something fails on the way, put it right and go on.",
        "Lift the {colour} cube, whatever happens: when a part of the system breaks, see to it "
        "that it runs again, and finish the job.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """It breaks 1 to 2.5 s after the first run_task."""
        chance = draw(type(self).__name__, seed)
        colours = some_colours(chance, 3, 3)
        target = chance.choice(colours)
        fault = Fault(
            module=self.module, kind=self.kind, delay_s=round(chance.uniform(1.0, 2.5), 2)
        )
        return AgentScene(
            seed=find_seed(seed, colours),
            instruction=self.say(seed, colour=target),
            colours=colours,
            fault=fault,
            facts={"target": target},
        )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """It is in the air all the same."""
        target = scene.text("target")
        wrong = [n for n in truth.names if n != target and truth.was_lifted(n)]
        return AgentVerdict.of(
            (not wrong, f"The cube {', '.join(wrong)} was lifted, meant was {target}."),
            (truth.is_lifted(target), f"The {target} cube is not in the air at the end."),
        )

    async def solve(self, tools: Tools, scene: AgentScene) -> str:
        """Try again, and start what has ended."""
        await lift_whatever_happens(tools, scene.text("target"))
        return DONE


class KilledControl(_Recover):
    """The controller."""


class KilledInference(_Recover):
    """The policy."""

    module = "inference"


class KilledPerception(_Recover):
    """The cameras."""

    module = "perception"


class KilledRobot(_Recover):
    """The simulation, with whatever was in the hand."""

    module = "robot"


class FrozenCameras(_Recover):
    """The cameras, which hang."""

    module = "perception"
    kind = "freeze"


class WrongPolicy(_Recover):
    """A policy that never moves is configured; nothing else is broken."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Pick up the {colour} cube. If the policy that is configured does nothing, use another one "
        "that needs no model.",
        "Lift the {colour} cube. The configured policy may be the wrong one: then find one that "
        "needs no weights and finish the job with it.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """Without a fault."""
        scene = super().prepare(seed)
        return replace(scene, fault=None, backend="noop")

    async def solve(self, tools: Tools, scene: AgentScene) -> str:
        """With the policy that works."""
        await lift_with(tools, "servo", scene.text("target"))
        return DONE


class FrozenPolicy(_Recover):
    """The policy, which hangs."""

    module = "inference"
    kind = "freeze"

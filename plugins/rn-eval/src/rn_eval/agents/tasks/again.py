"""Tasks with a history: the server's past tasks tell what worked."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from rn_eval.agents.client import ToolClient
from rn_eval.agents.conduct import Conduct
from rn_eval.agents.task import AgentScene, AgentVerdict, PriorTask
from rn_eval.agents.tasks.base import CubeTask, Difficulty, draw_target, lifted_alone
from rn_eval.agents.tasks.scenes import draw, some_colours
from rn_eval.agents.tasks.steps import DONE, lift, lift_with
from rn_eval.agents.truth import Truth

WORKING, IDLE = "servo", "noop"
"""Policies: one that picks up cubes, and one that never moves."""
_NAMES = ("Anna", "Boris", "Chen", "Dana")


class _Again(CubeTask):
    """The target cube must be in the air, and no other cube may ever have been lifted."""

    difficulty: ClassVar[Difficulty] = 3
    time_limit_s = 120.0

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """Judge by the cubes' heights."""
        return AgentVerdict.of(*lifted_alone(truth, scene.text("target")))


class Whose(_Again):
    """Pick up a person's cube, whose colour is only known from an earlier task."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Pick up the cube of {name} again, as you did it before.",
        "Lift the cube that belongs to {name}, the same one as last time.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """The history has an attempt with the wrong cube, then one with the right cube."""
        chance = draw("again-whose", seed)
        colours = some_colours(chance, 3, 4)
        target, wrong, other = chance.sample(colours, 3)
        name, somebody = chance.sample(_NAMES, 2)
        model = {"backend": WORKING}
        return replace(
            self.scene(seed, colours, facts={"target": target}, name=name),
            past=(
                PriorTask(
                    instruction=f"pick up the {wrong} cube of {name}",
                    outcome="stopped",
                    reason=f"a person said that it is not the cube of {name}",
                    model=model,
                ),
                PriorTask(
                    instruction=f"pick up the {target} cube of {name}",
                    outcome="succeeded",
                    model=model,
                ),
                PriorTask(
                    instruction=f"pick up the {other} cube of {somebody}",
                    outcome="succeeded",
                    model=model,
                ),
            ),
        )

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Pick up the right cube."""
        await lift(tools, scene.text("target"))
        return DONE


class WhichPolicy(_Again):
    """Pick up a cube though the configured policy does not move; an earlier task succeeded with
    another policy.
    """

    wordings: ClassVar[tuple[str, ...]] = (
        "Pick up the {colour} cube. The policy that is configured has failed at this before; do it "
        "as it worked last time.",
        "Lift the {colour} cube once more, with what worked before.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """The history has a failure with the configured policy, then a success with another one."""
        _, colours, target = draw_target("again-policy", seed)
        words = f"pick up the {target} cube"
        return replace(
            self.scene(seed, colours, facts={"target": target}),
            backend=IDLE,
            past=(
                PriorTask(instruction=words, outcome="succeeded", model={"backend": WORKING}),
                PriorTask(
                    instruction=words,
                    outcome="timed_out",
                    reason="the arm did not move",
                    model={"backend": IDLE},
                ),
            ),
        )

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Pick it up with the other policy."""
        await lift_with(tools, WORKING, scene.text("target"))
        return DONE

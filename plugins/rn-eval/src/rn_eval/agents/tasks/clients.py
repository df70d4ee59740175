"""Tasks with two clients, of which only one operates the robot at a time."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from rn_eval.agents.client import ToolClient
from rn_eval.agents.conduct import Conduct
from rn_eval.agents.task import AgentScene, AgentVerdict
from rn_eval.agents.tasks.base import CubeTask, Difficulty, draw_target
from rn_eval.agents.tasks.steps import DONE, lift, wait_until_free
from rn_eval.agents.truth import Truth

TAKE_OVER = "take_over"


class _TwoClients(CubeTask):
    """Another client has started the robot, and does not announce when it is free."""

    difficulty: ClassVar[Difficulty] = 3
    time_limit_s = 150.0

    def prepare(self, seed: int) -> AgentScene:
        """A scene in which another client operates the robot."""
        _, colours, target = draw_target(type(self).__name__, seed)
        return replace(self.scene(seed, colours, facts={"target": target}), other_client=True)

    def lifted(self, scene: AgentScene, truth: Truth) -> tuple[bool, str]:
        """Check that the cube is in the air at the end."""
        target = scene.text("target")
        return truth.is_lifted(target), f"The {target} cube is not in the air at the end."


class Wait(_TwoClients):
    """Wait for the robot without taking it over."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Somebody else operates the robot at the moment. Do not take it over: wait until it is "
        "free, and then pick up the {colour} cube.",
        "As soon as my colleague no longer operates the robot, lift the {colour} cube; never take "
        "the robot away from her.",
    )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """Judge by the calls and the cube."""
        taken = [call for call in conduct.calls if call.tool == TAKE_OVER]
        return AgentVerdict.of(
            (not taken, "The agent has taken the robot over."), self.lifted(scene, truth)
        )

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Retry until no call is refused."""
        await wait_until_free(tools)
        await lift(tools, scene.text("target"))
        return DONE


class TakeOver(_TwoClients):
    """Take the robot over, as the other client has agreed."""

    wordings: ClassVar[tuple[str, ...]] = (
        "My colleague operates the robot, and has agreed that you take it over now. Do so, and "
        "pick up the {colour} cube.",
        "Take the robot over from my colleague, who is waiting for that, and lift the {colour} "
        "cube.",
    )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """Judge by the calls and the cube."""
        return AgentVerdict.of(
            (conduct.called(TAKE_OVER), "The agent has not taken the robot over."),
            self.lifted(scene, truth),
        )

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Take the robot over, then pick up the cube."""
        await tools.must(TAKE_OVER)
        await lift(tools, scene.text("target"))
        return DONE

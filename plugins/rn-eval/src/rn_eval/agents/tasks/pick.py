"""Pick up a cube: named by its colour, by its position, or by exclusion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

from rn_eval.agents.client import ToolClient
from rn_eval.agents.conduct import Conduct
from rn_eval.agents.task import AgentScene, AgentVerdict
from rn_eval.agents.tasks.base import CubeTask, Difficulty, lifted_alone
from rn_eval.agents.tasks.scenes import clear_first, cubes_of, draw, find_seed, some_colours
from rn_eval.agents.tasks.steps import DONE, free_hand, lift
from rn_eval.agents.truth import Truth
from rn_simulation.cubes import Cube

HOME_M = (0.307, 0.0, 0.487)
"""TCP position at home, base frame."""


class _Pick(CubeTask):
    """The target cube must be in the air at the end, and no other may have been lifted."""

    name: ClassVar[str] = ""
    time_limit_s = 80.0

    def target(self, cubes: Mapping[str, Cube]) -> str:
        """The target cube; "" if it is not clear."""
        return next(iter(cubes))

    def prepare(self, seed: int) -> AgentScene:
        """Choose a scene with a clear target."""
        colours = some_colours(draw(self.name, seed), 3, 4)
        chosen = find_seed(seed, colours, lambda cubes: bool(self.target(cubes)))
        cubes = cubes_of(AgentScene(seed=chosen, instruction="", colours=colours))
        target = self.target(cubes)
        others = " nor ".join(name for name in cubes if name != target)
        return AgentScene(
            seed=chosen,
            instruction=self.say(seed, colour=target, others=others),
            colours=colours,
            facts={"target": target},
        )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """Judge by the cubes' heights."""
        return AgentVerdict.of(*lifted_alone(truth, scene.text("target")))

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Pick up the target."""
        await lift(tools, scene.text("target"))
        return DONE


class ByColour(_Pick):
    """Pick up a cube by its colour."""

    name = "pick-colour"
    wordings: ClassVar[tuple[str, ...]] = (
        "Pick up the {colour} cube.",
        "Please grab the {colour} block and hold it up.",
        "Lift the {colour} cube off the table.",
        "Could you take the {colour} one?",
    )


class PickLeftmost(_Pick):
    """Pick up the leftmost cube."""

    name = "pick-leftmost"
    difficulty: ClassVar[Difficulty] = 2
    wordings: ClassVar[tuple[str, ...]] = (
        "Pick up the cube that lies furthest to the left, as the robot sees it.",
        "Take the leftmost cube, seen from the robot.",
    )

    def target(self, cubes: Mapping[str, Cube]) -> str:
        """The y axis points to the left."""
        return clear_first({name: -cube.y_m for name, cube in cubes.items()})


class PickNearest(_Pick):
    """Pick up the cube nearest to the robot."""

    name = "pick-nearest"
    difficulty: ClassVar[Difficulty] = 2
    wordings: ClassVar[tuple[str, ...]] = (
        "Pick up the cube that is nearest to the robot's base.",
        "Grab whichever cube stands closest to the robot.",
    )

    def target(self, cubes: Mapping[str, Cube]) -> str:
        """Use the distance on the table."""
        return clear_first({name: math.hypot(c.x_m, c.y_m) for name, c in cubes.items()})


class TheOther(_Pick):
    """Pick up the cube that is none of the named ones."""

    name = "pick-the-other"
    difficulty: ClassVar[Difficulty] = 2
    wordings: ClassVar[tuple[str, ...]] = (
        "Pick up the cube that is neither {others}.",
        "Lift the one cube whose colour is neither {others}.",
    )


class Middle(_Pick):
    """Pick up the middle cube."""

    name = "pick-middle"
    difficulty: ClassVar[Difficulty] = 2
    wordings: ClassVar[tuple[str, ...]] = (
        "Three cubes lie on the table. Pick up the middle one, from left to right.",
        "Take the cube that lies between the other two, counted from left to right.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """Three cubes, clearly side by side."""
        colours = some_colours(draw(self.name, seed), 3, 3)
        chosen = find_seed(seed, colours, lambda cubes: bool(self.target(cubes)))
        cubes = cubes_of(AgentScene(seed=chosen, instruction="", colours=colours))
        return AgentScene(
            seed=chosen,
            instruction=self.say(seed),
            colours=colours,
            facts={"target": self.target(cubes)},
        )

    def target(self, cubes: Mapping[str, Cube]) -> str:
        """The middle one in y, with at least 6 cm to both sides."""
        right, middle, left = sorted(cubes, key=lambda name: cubes[name].y_m)
        gaps = (cubes[middle].y_m - cubes[right].y_m, cubes[left].y_m - cubes[middle].y_m)
        return middle if min(gaps) >= 0.06 else ""


class AndHome(_Pick):
    """Pick up a cube and take it home."""

    name = "pick-and-home"
    difficulty: ClassVar[Difficulty] = 2
    wordings: ClassVar[tuple[str, ...]] = (
        "Pick up the {colour} cube and go to the home posture with it.",
        "Take the {colour} cube, then move the arm home while you hold it.",
    )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The cube must be in the hand, and the hand at home."""
        picked = super().judge(scene, truth, conduct)
        if not picked.success:
            return picked
        away_m = math.dist(truth.tcp_m[-1], HOME_M)
        return AgentVerdict.of(
            (away_m <= 0.03, f"The hand is {100 * away_m:.0f} cm away from home."),
        )

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Pick up the cube, stop the policy, move home."""
        await lift(tools, scene.text("target"))
        await free_hand(tools)
        await tools.must("move_to", name="home")
        return DONE

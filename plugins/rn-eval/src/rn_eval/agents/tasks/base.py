"""Base class of this package's tasks."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping
from typing import ClassVar, Literal

from rn_eval.agents.client import Briefing, ToolClient
from rn_eval.agents.subjects import tool_only
from rn_eval.agents.task import AgentScene
from rn_eval.agents.tasks.scenes import Condition, cubes_of, draw, find_seed, some_colours
from rn_eval.agents.truth import Truth

Difficulty = Literal[1, 2, 3]
Demand = tuple[bool, str]
"""What must hold, and the reason of a failure if it does not; see `AgentVerdict.of`."""
STARTED = "The robot was never started."


class CubeTask:
    """A task with cubes; its subclasses follow `rn_eval.agents.task.AgentTask`.

    Attributes:
        wordings: sentences, with facts of the scene in braces.
        difficulty, time_limit_s: see `AgentTask`.
        form: form of the answer, see `AgentScene.answer_form`.
    """

    wordings: ClassVar[tuple[str, ...]] = ()
    difficulty: ClassVar[Difficulty] = 1
    time_limit_s: ClassVar[float] = 60.0
    form: ClassVar[str] = ""

    def __init__(self, config: None = None) -> None:
        """Take no options."""

    def say(self, seed: int, **facts: object) -> str:
        """Return the wording of a seed."""
        return self.wordings[seed % len(self.wordings)].format(**facts)

    def scene(
        self,
        seed: int,
        colours: tuple[str, ...] = ("red", "blue"),
        condition: Condition = lambda cubes: True,
        facts: Mapping[str, str | float] = {},
        **words: object,
    ) -> AgentScene:
        """Create the scene of a seed, with its wording.

        Args:
            seed: of the episode.
            colours: one cube each.
            condition: of the cubes.
            facts: of the scene, and words of the sentence; the `target` is its colour.
            words: more words of the sentence.
        """
        return AgentScene(
            seed=find_seed(seed, colours, condition),
            instruction=self.say(seed, **{"colour": facts.get("target"), **facts, **words}),
            answer_form=self.form,
            colours=colours,
            facts=facts,
        )

    def prepare(self, seed: int) -> AgentScene:
        """See `AgentTask`; by default the arm is at home and any cubes do."""
        return self.scene(seed)

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Do as the script `tool-only` does, which knows no more than the tools tell."""
        return await tool_only.act(tools, Briefing(instruction=scene.briefing))


def draw_target(task: str, seed: int) -> tuple[random.Random, tuple[str, ...], str]:
    """Random numbers of a task for a seed, the colours of three cubes, and one of them."""
    chance = draw(task, seed)
    colours = some_colours(chance, 3, 3)
    return chance, colours, chance.choice(colours)


def started_at(scene: AgentScene, colour: str) -> tuple[float, float]:
    """Where a cube lies at the start of a scene: x and y [m]."""
    cube = cubes_of(scene)[colour]
    return cube.x_m, cube.y_m


def untouched(truth: Truth, *but: str, least_m: float = 0.01) -> Demand:
    """Demand that no other cube than these has moved."""
    moved = [n for n in truth.names if n not in but and truth.has_moved(n, least_m)]
    return not moved, f"Others were moved: {', '.join(moved)}."


def rests_at(truth: Truth, colour: str, x_m: float, y_m: float, near_m: float = 0.03) -> Demand:
    """Demand that a cube lies on the table at a place."""
    off_m = math.dist(truth.end_m(colour)[:2], (x_m, y_m))
    return (
        truth.is_resting(colour) and off_m <= near_m,
        f"The {colour} cube is {100 * off_m:.1f} cm from where it should lie on the table.",
    )


def stands_on(truth: Truth, upper: str, lower: str, sample: int = -1) -> Demand:
    """Demand that one cube stands on another one, at the end or at another sample."""
    first, second = truth.names.index(upper), truth.names.index(lower)
    above, below = truth.cubes_m[sample, first], truth.cubes_m[sample, second]
    rise_m = (truth.edges_m[first] + truth.edges_m[second]) / 2
    holds = abs(above[2] - below[2] - rise_m) <= 0.01 and math.dist(above[:2], below[:2]) <= 0.03
    return bool(holds), f"The {upper} cube is not on top of the {lower} one."


def let_go(truth: Truth) -> Demand:
    """Demand that the hand is open at the end."""
    return truth.grip_width_m() > 0.06, "The hand has not let go."


def lifted_alone(truth: Truth, target: str) -> tuple[Demand, Demand]:
    """Demands that no cube but the target was lifted, and that it is in the air at the end."""
    wrong = [name for name in truth.names if name != target and truth.was_lifted(name)]
    return (
        (not wrong, f"The cube {', '.join(wrong)} was lifted, meant was {target}."),
        (truth.is_lifted(target), f"The {target} cube is not in the air at the end."),
    )

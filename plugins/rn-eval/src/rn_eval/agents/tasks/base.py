"""Base class of this package's tasks."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import ClassVar, Literal

from rn_eval.agents.task import AgentScene
from rn_eval.agents.tasks.scenes import Condition, draw, find_seed, some_colours
from rn_eval.agents.truth import Truth

Difficulty = Literal[1, 2, 3]


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


def draw_target(task: str, seed: int) -> tuple[random.Random, tuple[str, ...], str]:
    """Random numbers of a task for a seed, the colours of three cubes, and one of them."""
    chance = draw(task, seed)
    colours = some_colours(chance, 3, 3)
    return chance, colours, chance.choice(colours)


def lifted_alone(truth: Truth, target: str) -> tuple[tuple[bool, str], tuple[bool, str]]:
    """Demands that no cube but the target was lifted, and that it is in the air at the end."""
    wrong = [name for name in truth.names if name != target and truth.was_lifted(name)]
    return (
        (not wrong, f"The cube {', '.join(wrong)} was lifted, meant was {target}."),
        (truth.is_lifted(target), f"The {target} cube is not in the air at the end."),
    )

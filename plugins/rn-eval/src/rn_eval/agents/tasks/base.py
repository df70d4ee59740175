"""Base class of this package's tasks."""

from __future__ import annotations

from typing import ClassVar, Literal

Difficulty = Literal[1, 2, 3]


class CubeTask:
    """A task with cubes; its subclasses follow `rn_eval.agents.task.AgentTask`.

    Attributes:
        wordings: sentences, with facts of the scene in braces.
        difficulty, time_limit_s: see `AgentTask`.
    """

    wordings: ClassVar[tuple[str, ...]] = ()
    difficulty: ClassVar[Difficulty] = 1
    time_limit_s: ClassVar[float] = 60.0

    def __init__(self, config: None = None) -> None:
        """Take no options."""

    def say(self, seed: int, **facts: object) -> str:
        """Return the wording of a seed."""
        return self.wordings[seed % len(self.wordings)].format(**facts)

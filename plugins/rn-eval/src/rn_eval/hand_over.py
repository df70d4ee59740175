"""The suite "hand-over": two simulated FR3s have to hand over one of several cubes; the simulator
judges.
"""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from rn_eval.cubes import Cubes, CubesOptions, CubesScene
from rn_eval.suite import Episode, Judgement, Setup
from rn_robot_fr3.cell import PAIR, Workcell


class HandOverSuiteOptions(CubesOptions):
    """Options of the suite `hand-over`, given as `--suite-option NAME=VALUE`."""

    wordings: Literal["plain"] = Field(default="plain", description="one sentence")
    time_limit_s: float = Field(
        default=60.0, gt=0, le=600, description="an episode fails after this long"
    )
    held_s: float = Field(
        default=1.0, gt=0, le=10, description="how long the other arm alone must hold the cube"
    )


class HandOver(Cubes):
    """Follows the protocol `Suite`. The named colour cycles with the seed."""

    phrase: ClassVar[str] = "hand over the {colour} cube"
    verb: ClassVar[str] = "hand-over"

    def __init__(self, config: HandOverSuiteOptions | None) -> None:
        super().__init__(config or HandOverSuiteOptions())

    def open(self, episode: Episode, setup: Setup) -> HandOverScene:
        """Build the world with the cubes of the seed."""
        target = self._target(episode.seed)
        on_table = self._on_table(episode.seed, target)
        return HandOverScene(episode, target, on_table, self._options, setup)


class HandOverScene(CubesScene):
    """One open scene; follows the protocol `Scene`."""

    cell: ClassVar[Workcell] = PAIR

    def judge(self) -> Judgement:
        """Success: the other arm than the one that lifted the named cube has held it alone for long
        enough, and it was in the air throughout. Failure: the same for another cube.
        """
        cubes = self._simulation.cubes()
        target = cubes[self._target]
        facts: dict[str, str | float] = {
            "target": self._target,
            "objects": float(len(cubes)),
            "lifted_cm": round(max(0.0, target.lifted_m) * 100, 2),
            "handed_over_s": round(target.handed_over_s, 3),
        }
        handed = next(
            (n for n, cube in cubes.items() if cube.handed_over_s >= self._options.held_s), None
        )
        if handed == self._target:
            return Judgement(success=True, is_over=True, facts=facts)
        reason = f"The {self._target} cube was not handed over when time was up."
        if handed is not None:
            reason = f"The {handed} cube was handed over instead of the {self._target} one."
        return Judgement(success=False, is_over=handed is not None, reason=reason, facts=facts)

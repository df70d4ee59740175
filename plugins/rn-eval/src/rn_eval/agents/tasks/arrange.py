"""Arrange several cubes, and change an arrangement."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import ClassVar

import numpy as np

from rn_eval.agents.conduct import Conduct
from rn_eval.agents.task import AgentScene, AgentVerdict
from rn_eval.agents.tasks.base import (
    STARTED,
    CubeTask,
    Demand,
    Difficulty,
    draw_target,
    let_go,
    rests_at,
    stands_on,
    started_at,
    untouched,
)
from rn_eval.agents.tasks.place import SIDES, BySide
from rn_eval.agents.tasks.scenes import clear_first, cubes_of, draw, is_free, some_colours
from rn_eval.agents.truth import Truth
from rn_simulation.cubes import Cube

NEAR_M = 0.02


class _Arrange(CubeTask):
    """Cubes on the table, of which the end poses are judged."""

    difficulty: ClassVar[Difficulty] = 3
    time_limit_s = 180.0

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """Every demand on the end must hold."""
        if truth.is_empty:
            return AgentVerdict(success=False, reason=STARTED)
        return AgentVerdict.of(*self.demands(scene, truth))

    def demands(self, scene: AgentScene, truth: Truth) -> tuple[Demand, ...]:
        """What must hold of an episode in which the robot was started."""
        raise NotImplementedError


class LineUp(_Arrange):
    """Line up all cubes along the x axis."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Line up all cubes along the x axis, {apart} cm from centre to centre.",
        "Put all the cubes into one row that points straight away from the robot, with {apart} cm "
        "from the middle of one to the middle of the next.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """Three cubes."""
        chance, colours, _ = draw_target("arrange-line", seed)
        return self.scene(seed, colours, facts={"apart": chance.choice((8, 9, 10))})

    def demands(self, scene: AgentScene, truth: Truth) -> tuple[Demand, ...]:
        """All lie on the table, at the same y, with equal steps in x."""
        ends = sorted((truth.end_m(name).tolist() for name in scene.colours), key=lambda e: e[0])
        steps_cm = [100 * (second[0] - first[0]) for first, second in pairwise(ends)]
        wide_cm = 100 * (max(end[1] for end in ends) - min(end[1] for end in ends))
        off_cm = max(abs(step - scene.number("apart")) for step in steps_cm)
        return (
            (all(truth.is_resting(n) for n in scene.colours), "Not all lie on the table."),
            (wide_cm <= 1.5, f"The row is {wide_cm:.1f} cm wide."),
            (off_cm <= 1.5, f"A step is {off_cm:.1f} cm off."),
        )


class SwapCubes(_Arrange):
    """Swap two cubes."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Swap the {one} and the {other} cube.",
        "Let the {one} cube and the {other} cube change places.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """Two of three cubes."""
        chance = draw("arrange-swap", seed)
        colours = some_colours(chance, 3, 3)
        one, other = chance.sample(colours, 2)
        return self.scene(seed, colours, facts={"one": one, "other": other})

    def demands(self, scene: AgentScene, truth: Truth) -> tuple[Demand, ...]:
        """Each lies where the other one was."""
        one, other = scene.text("one"), scene.text("other")
        return (
            rests_at(truth, one, *started_at(scene, other), NEAR_M),
            rests_at(truth, other, *started_at(scene, one), NEAR_M),
            untouched(truth, one, other),
            let_go(truth),
        )


class BuildTower(_Arrange):
    """Stack three cubes."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Build a tower: the {low} cube at the bottom, the {middle} cube on it, and the {top} cube "
        "on top.",
        "Stack three cubes: below the {low} one, then the {middle} one, and above both the {top} "
        "one.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """Three of four cubes."""
        chance = draw("arrange-tower", seed)
        colours = some_colours(chance, 4, 4)
        facts = dict(zip(("low", "middle", "top"), chance.sample(colours, 3), strict=True))
        return self.scene(seed, colours, facts=facts)

    def demands(self, scene: AgentScene, truth: Truth) -> tuple[Demand, ...]:
        """Each stands on the next one, and the lowest on the table."""
        low, middle, top = (scene.text(name) for name in ("low", "middle", "top"))
        return (
            (truth.is_resting(low), f"The {low} cube does not lie on the table."),
            stands_on(truth, middle, low),
            stands_on(truth, top, middle),
            untouched(truth, low, middle, top),
            let_go(truth),
        )


class ClearHalf(_Arrange):
    """Clear one half of the table."""

    wordings: ClassVar[tuple[str, ...]] = (
        "I need the {half} half of the table, as the robot sees it. Put every cube that lies there "
        "onto the other half.",
        "Clear the {half} half of the table (robot's view): all cubes belong on the other half.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """One or two of three cubes lie there."""
        chance, colours, _ = draw_target("arrange-half", seed)
        half = chance.choice(("left", "right"))
        sign = 1.0 if half == "left" else -1.0

        def some_are_there(cubes: Mapping[str, Cube]) -> bool:
            there = [cube.y_m * sign > 0.03 for cube in cubes.values()]
            return all(abs(c.y_m) > 0.03 for c in cubes.values()) and 1 <= sum(there) <= 2

        return self.scene(seed, colours, some_are_there, {"half": half})

    def demands(self, scene: AgentScene, truth: Truth) -> tuple[Demand, ...]:
        """No part of a cube is on that half; those of the other half were left alone."""
        sign = 1.0 if scene.text("half") == "left" else -1.0
        beyond = [n for n in scene.colours if truth.end_m(n)[1] * sign > -0.022]
        there = [n for n in scene.colours if started_at(scene, n)[1] * sign > 0]
        return (
            (not beyond, f"On the {scene.text('half')} half: {', '.join(beyond)}."),
            (all(truth.is_resting(n) for n in scene.colours), "Not all lie on the table."),
            untouched(truth, *there),
            let_go(truth),
        )


class TurnInPlace(_Arrange):
    """Turn a cube where it stands."""

    difficulty: ClassVar[Difficulty] = 2
    wordings: ClassVar[tuple[str, ...]] = (
        "Turn the {colour} cube by 45 degrees where it stands.",
        "Leave the {colour} cube where it is, but turned by 45 degrees.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """One of three cubes."""
        _, colours, target = draw_target("arrange-turn", seed)
        return self.scene(seed, colours, facts={"target": target})

    def demands(self, scene: AgentScene, truth: Truth) -> tuple[Demand, ...]:
        """It has turned by half of a quarter turn, and lies where it was."""
        target = scene.text("target")
        turned_deg = abs(math.remainder(truth.turned_deg(target, truth.starts[-1]), 90.0))
        return (
            (abs(turned_deg - 45.0) <= 5.0, f"It has turned by {turned_deg:.0f} degrees."),
            rests_at(truth, target, *started_at(scene, target), NEAR_M),
            untouched(truth, target),
            let_go(truth),
        )


class PutBack(_Arrange, BySide):
    """Put a cube aside, and back again."""

    name = "arrange-back"
    wordings: ClassVar[tuple[str, ...]] = (
        "Put the {colour} cube {distance} cm {side}, seen from the robot.\nNo, it was better "
        "before: put the {colour} cube back where it was.",
        "Move the {colour} block {distance} cm {side} (robot's view), and let it go there.\nSorry, "
        "undo that: the {colour} cube belongs back where it lay.",
    )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """See `demands`."""
        return _Arrange.judge(self, scene, truth, conduct)

    def demands(self, scene: AgentScene, truth: Truth) -> tuple[Demand, ...]:
        """It lay there for a while, and lies where it was."""
        target = scene.text("target")
        place = np.array([scene.number("x_m"), scene.number("y_m")])
        track = truth.cubes_m[:, truth.names.index(target), :2]
        was_there = np.linalg.norm(track - place, axis=1) <= NEAR_M
        was_low = truth.height_m(target) <= NEAR_M
        return (
            (bool((was_there & was_low).any()), f"The {target} cube was never put there."),
            rests_at(truth, target, *started_at(scene, target), NEAR_M),
            untouched(truth, target),
            let_go(truth),
        )


class StackSizes(_Arrange):
    """Stack by size."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Put the smallest cube onto the largest one.",
        "Stack the smallest of the cubes on top of the largest.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """Three cubes, of which the smallest and the largest are clear."""
        _, colours, _ = draw_target("arrange-sizes", seed)
        scene = self.scene(seed, colours, lambda cubes: all(_extremes(cubes)))
        small, large = _extremes(cubes_of(scene))
        return replace(scene, facts={"small": small, "large": large})

    def demands(self, scene: AgentScene, truth: Truth) -> tuple[Demand, ...]:
        """The smallest stands on the largest."""
        small, large = scene.text("small"), scene.text("large")
        return (
            (truth.is_resting(large), f"The {large} cube does not lie on the table."),
            stands_on(truth, small, large),
            untouched(truth, small, large),
            let_go(truth),
        )


def _extremes(cubes: Mapping[str, Cube]) -> tuple[str, str]:
    """The smallest and the largest cube; "" for what is not clear."""
    edges = {name: cube.edge_m for name, cube in cubes.items()}
    largest_first = {name: -edge for name, edge in edges.items()}
    return clear_first(edges, 0.0025), clear_first(largest_first, 0.0025)


class PushCube(_Arrange):
    """Push a cube over the table."""

    difficulty: ClassVar[Difficulty] = 2
    wordings: ClassVar[tuple[str, ...]] = (
        "Push the {colour} cube {distance} cm {side}, seen from the robot, without lifting it.",
        "Shift the {colour} block over the table by pushing it, {distance} cm {side} (robot's "
        "view).",
    )

    def prepare(self, seed: int) -> AgentScene:
        """Choose a scene with room before and behind the cube."""
        chance, colours, target = draw_target("arrange-push", seed)
        side, distance_cm = chance.choice(sorted(SIDES)), chance.choice((4, 5, 6))
        dx_m, dy_m = (part * distance_cm / 100 for part in SIDES[side])

        def has_room(cubes: Mapping[str, Cube]) -> bool:
            x_m, y_m = cubes[target].x_m, cubes[target].y_m
            return all(
                is_free(cubes, target, x_m + share * dx_m, y_m + share * dy_m, 0.14)
                for share in (-1.0, 0.0, 1.0)
            )

        scene = self.scene(
            seed, colours, has_room, {"target": target}, distance=distance_cm, side=side
        )
        x_m, y_m = started_at(scene, target)
        return replace(scene, facts={**scene.facts, "x_m": x_m + dx_m, "y_m": y_m + dy_m})

    def demands(self, scene: AgentScene, truth: Truth) -> tuple[Demand, ...]:
        """It lies there and was never in the air."""
        target = scene.text("target")
        highest_m = float(truth.height_m(target).max())
        return (
            rests_at(truth, target, scene.number("x_m"), scene.number("y_m"), 0.01),
            (highest_m <= 0.015, f"It was lifted by {100 * highest_m:.0f} cm."),
            untouched(truth, target),
        )

"""Put cubes down: by a distance, next to or onto others, or in sequence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

from rn_eval.agents.client import ToolClient
from rn_eval.agents.conduct import Conduct
from rn_eval.agents.task import AgentScene, AgentVerdict
from rn_eval.agents.tasks.base import CubeTask, Difficulty, draw_target
from rn_eval.agents.tasks.scenes import cubes_of, draw, find_seed, is_free, some_colours
from rn_eval.agents.tasks.steps import DONE, free_hand, go_to, lift, put
from rn_eval.agents.truth import Truth
from rn_simulation.cubes import Cube

NEAR_M = 0.03
"""Tolerance of a position: two thirds of a cube's edge."""
SIDES = {
    "to the left": (0.0, 1.0),
    "to the right": (0.0, -1.0),
    "forwards, away from the robot": (1.0, 0.0),
    "back towards the robot": (-1.0, 0.0),
}


def is_put(truth: Truth, colour: str, x_m: float, y_m: float) -> AgentVerdict:
    """Check that a cube lies on the table at a position, and that the hand has released it."""
    if truth.is_empty or colour not in truth.names:
        return AgentVerdict(success=False, reason="The robot was never started.")
    place = truth.end_m(colour)
    off_m = math.hypot(place[0] - x_m, place[1] - y_m)
    return AgentVerdict.of(
        (truth.is_resting(colour), f"The {colour} cube does not lie on the table."),
        (off_m <= NEAR_M, f"The {colour} cube is {100 * off_m:.0f} cm from where it should be."),
        (truth.grip_width_m() > 0.06, "The hand has not let go."),
    )


class _Put(CubeTask):
    """Put one cube at a position given by the scene."""

    name: ClassVar[str] = ""
    difficulty: ClassVar[Difficulty] = 2
    time_limit_s = 90.0

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The cube must lie there, and the others where they were."""
        target = scene.text("target")
        moved = [n for n in truth.names if n != target and truth.has_moved(n, 0.03)]
        put_down = is_put(truth, target, scene.number("x_m"), scene.number("y_m"))
        if moved and put_down.success:
            return AgentVerdict(success=False, reason=f"Others were moved: {', '.join(moved)}.")
        return put_down

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Pick up the cube, and put it there."""
        await put(tools, scene.text("target"), scene.number("x_m"), scene.number("y_m"))
        return DONE


class _ToSide(_Put):
    """Put a cube a distance to a side."""

    sides: ClassVar[tuple[str, ...]] = ()
    distances_cm: ClassVar[tuple[int, ...]] = (10, 12, 15)

    def prepare(self, seed: int) -> AgentScene:
        """Choose a scene in which the target position is free."""
        chance, colours, target = draw_target(self.name, seed)
        side = chance.choice(self.sides)
        distance_cm = chance.choice(self.distances_cm)
        dx_m, dy_m = (part * distance_cm / 100 for part in SIDES[side])

        def has_room(cubes: Mapping[str, Cube]) -> bool:
            cube = cubes[target]
            return is_free(cubes, target, cube.x_m + dx_m, cube.y_m + dy_m)

        chosen = find_seed(seed, colours, has_room)
        cube = cubes_of(AgentScene(seed=chosen, instruction="", colours=colours))[target]
        return AgentScene(
            seed=chosen,
            instruction=self.say(seed, colour=target, distance=distance_cm, side=side),
            colours=colours,
            facts={"target": target, "x_m": cube.x_m + dx_m, "y_m": cube.y_m + dy_m},
        )


class Sideways(_ToSide):
    """Put a cube to the left or right."""

    name = "put-sideways"
    sides = ("to the left", "to the right")
    wordings: ClassVar[tuple[str, ...]] = (
        "Put the {colour} cube {distance} cm {side} of where it lies, as the robot sees it.",
        "Move the {colour} block {distance} cm {side}, seen from the robot, and let it go there.",
        "Please take the {colour} cube and set it down {distance} cm further {side} (robot's "
        "view).",
    )


class Lengthways(_ToSide):
    """Put a cube forwards or back."""

    name = "put-lengthways"
    sides = ("forwards, away from the robot", "back towards the robot")
    wordings: ClassVar[tuple[str, ...]] = (
        "Put the {colour} cube {distance} cm {side}.",
        "Move the {colour} block {distance} cm {side}, and let it go there.",
    )
    distances_cm = (8, 10, 12)


class AtPlace(_Put):
    """Put a cube at coordinates."""

    name = "put-at"
    wordings: ClassVar[tuple[str, ...]] = (
        "Put the {colour} cube down at x = {x_m} m, y = {y_m} m of the robot's base frame.",
        "Set the {colour} block onto the table at ({x_m}, {y_m}), metres in the base frame.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """Draw a free position."""
        chance, colours, target = draw_target(self.name, seed)
        x_m, y_m = round(chance.uniform(0.42, 0.58), 2), round(chance.uniform(-0.25, 0.25), 2)
        chosen = find_seed(seed, colours, lambda cubes: is_free(cubes, target, x_m, y_m))
        return AgentScene(
            seed=chosen,
            instruction=self.say(seed, colour=target, x_m=x_m, y_m=y_m),
            colours=colours,
            facts={"target": target, "x_m": x_m, "y_m": y_m},
        )


class Beside(_Put):
    """Put a cube next to another one."""

    name = "put-beside"
    difficulty: ClassVar[Difficulty] = 3
    wordings: ClassVar[tuple[str, ...]] = (
        "Put the {colour} cube 12 cm to the {side} of the {other} cube, as the robot sees it.",
        "The {colour} cube belongs 12 cm to the {side} of the {other} one (robot's view). Put it "
        "there.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """Choose a scene with a free position next to the other cube."""
        chance = draw(self.name, seed)
        colours = some_colours(chance, 3, 3)
        target, other = chance.sample(colours, 2)
        side = chance.choice(("left", "right"))
        dy_m = 0.12 if side == "left" else -0.12
        chosen = find_seed(
            seed,
            colours,
            lambda cubes: is_free(cubes, target, cubes[other].x_m, cubes[other].y_m + dy_m),
        )
        cube = cubes_of(AgentScene(seed=chosen, instruction="", colours=colours))[other]
        return AgentScene(
            seed=chosen,
            instruction=self.say(seed, colour=target, other=other, side=side),
            colours=colours,
            facts={"target": target, "x_m": cube.x_m, "y_m": cube.y_m + dy_m},
        )


class Stack(CubeTask):
    """Stack a cube on another one."""

    name = "put-onto"
    difficulty: ClassVar[Difficulty] = 3
    time_limit_s = 100.0
    wordings: ClassVar[tuple[str, ...]] = (
        "Stack the {colour} cube on top of the {other} cube.",
        "Put the {colour} block onto the {other} block and let it go.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """Draw two of three cubes."""
        chance = draw(self.name, seed)
        colours = some_colours(chance, 3, 3)
        target, other = chance.sample(colours, 2)
        return self.scene(seed, colours, facts={"target": target, "other": other})

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The cube must stand on the other one, which stands on the table; the hand must be
        empty.
        """
        if truth.is_empty:
            return AgentVerdict(success=False, reason="The robot was never started.")
        target, other = scene.text("target"), scene.text("other")
        above, below = truth.end_m(target), truth.end_m(other)
        edges = truth.edges_m[truth.names.index(target)] + truth.edges_m[truth.names.index(other)]
        beside_m = math.hypot(above[0] - below[0], above[1] - below[1])
        return AgentVerdict.of(
            (truth.is_resting(other), f"The {other} cube does not lie on the table."),
            (
                abs(above[2] - below[2] - edges / 2) <= 0.01 and beside_m <= NEAR_M,
                f"The {target} cube is not on top of the {other} one.",
            ),
            (truth.grip_width_m() > 0.06, "The hand has not let go."),
        )

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Pick up the cube, carry it above the other one, and release it one edge higher."""
        target, other = scene.text("target"), cubes_of(scene)[scene.text("other")]
        await lift(tools, target)
        await free_hand(tools)
        await go_to(tools, other.x_m, other.y_m)
        height_m = other.edge_m + cubes_of(scene)[target].edge_m / 2 + 0.004
        await tools.must("place", height_m=round(height_m, 4))
        return DONE


class Both(CubeTask):
    """Put one cube aside, then pick up another one."""

    name = "put-then-pick"
    difficulty: ClassVar[Difficulty] = 3
    time_limit_s = 120.0
    wordings: ClassVar[tuple[str, ...]] = (
        "First put the {one} cube {distance} cm {side}, seen from the robot; then pick up the "
        "{other} cube and hold it.",
        "Two things, in this order: move the {one} cube {distance} cm {side} (robot's view), then "
        "lift the {other} one.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """Choose a scene with a free position for the first cube."""
        chance = draw(self.name, seed)
        colours = some_colours(chance, 3, 3)
        one, other = chance.sample(colours, 2)
        side = chance.choice(("to the left", "to the right"))
        dy_m = 0.1 * SIDES[side][1]
        chosen = find_seed(
            seed,
            colours,
            lambda cubes: is_free(cubes, one, cubes[one].x_m, cubes[one].y_m + dy_m),
        )
        cube = cubes_of(AgentScene(seed=chosen, instruction="", colours=colours))[one]
        return AgentScene(
            seed=chosen,
            instruction=self.say(seed, one=one, other=other, distance=10, side=side),
            colours=colours,
            facts={"one": one, "other": other, "x_m": cube.x_m, "y_m": cube.y_m + dy_m},
        )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The first cube must lie there; the other one must be in the air, and have been lifted
        later.
        """
        one, other = scene.text("one"), scene.text("other")
        if truth.is_empty:
            return AgentVerdict(success=False, reason="The robot was never started.")
        place = truth.end_m(one)
        off_m = math.hypot(place[0] - scene.number("x_m"), place[1] - scene.number("y_m"))
        first = [float(truth.t_s[(truth.height_m(n) >= 0.05).argmax()]) for n in (one, other)]
        return AgentVerdict.of(
            (truth.is_resting(one), f"The {one} cube does not lie on the table."),
            (off_m <= NEAR_M, f"The {one} cube is {100 * off_m:.0f} cm from where it should be."),
            (truth.is_lifted(other), f"The {other} cube is not in the air at the end."),
            (first[0] < first[1], "They were taken in the wrong order."),
        )

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Do one after the other."""
        await put(tools, scene.text("one"), scene.number("x_m"), scene.number("y_m"))
        await tools.must("move_to", name="home")
        await lift(tools, scene.text("other"))
        return DONE

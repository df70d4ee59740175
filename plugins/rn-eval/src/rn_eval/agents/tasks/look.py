"""Questions about the scene; answers are checked against the ground truth."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from rn_eval.agents.conduct import Conduct
from rn_eval.agents.task import AgentScene, AgentVerdict
from rn_eval.agents.tasks.base import CubeTask, Difficulty
from rn_eval.agents.tasks.scenes import (
    ALL_COLOURS,
    CLEAR_M,
    clear_first,
    cubes_of,
    draw,
    find_seed,
    some_colours,
)
from rn_eval.agents.truth import Truth
from rn_simulation.cubes import Cube

_PLACE = re.compile(rf"({'|'.join(ALL_COLOURS)})\D*?(-?\d+\.\d+)[^\d-]+(-?\d+\.\d+)")
_PICTURE_BYTES = 3000
"""Less is no picture."""
_HOME_CM = 48.7
"""Height of the TCP at home."""


def colours_in(answer: str) -> set[str]:
    """Return the colour words of an answer."""
    return set(re.findall("|".join(ALL_COLOURS), answer))


def number_in(answer: str) -> float:
    """Return the first number of an answer; NaN without one."""
    found = re.search(r"-?\d+(\.\d+)?", answer)
    return float(found[0]) if found else math.nan


class _Question(CubeTask):
    """A question about the table; nothing needs to move, and no cube may."""

    form: ClassVar[str] = "<colour>"

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The answer must be right, and no cube may have moved."""
        moved = [name for name in truth.names if truth.has_moved(name)]
        return AgentVerdict.of(
            (bool(conduct.answer), "There is no line ANSWER."),
            (
                self.is_right(scene, truth, conduct.answer),
                f"The answer {conduct.answer[:60]!r} is wrong, right is {self.right(scene)!r}.",
            ),
            (not moved, f"Cubes were moved: {', '.join(moved)}."),
        )

    def right(self, scene: AgentScene) -> str:
        """The right answer."""
        return scene.text("answer")

    def is_right(self, scene: AgentScene, truth: Truth, answer: str) -> bool:
        """Check an answer; by default it must name exactly the right colour."""
        return colours_in(answer) == {scene.text("answer")}


class WhatLiesWhere(_Question):
    """Tell whether the robot is real, and where each cube lies."""

    wordings: ClassVar[tuple[str, ...]] = (
        "What robot is this, a real or a simulated one, and which cubes lie on its table, and "
        "where?",
        "Before we begin: is this real hardware or a simulation, and where on the table is which "
        "cube?",
    )
    form = "<real or simulated>; <colour> <x> <y>; ... , in metres of the base frame"
    difficulty: ClassVar[Difficulty] = 2

    def prepare(self, seed: int) -> AgentScene:
        """Draw some of six colours."""
        scene = self.scene(seed, some_colours(draw("look-table", seed)))
        places = [f"{c.name} {c.x_m:.3f} {c.y_m:.3f}" for c in cubes_of(scene).values()]
        return replace(scene, facts={"answer": "; ".join(["simulated", *places])})

    def is_right(self, scene: AgentScene, truth: Truth, answer: str) -> bool:
        """It must name exactly the cubes, each within 2 cm, and say that the robot is simulated."""
        told = {c: (float(x), float(y)) for c, x, y in _PLACE.findall(answer)}
        right = {c.name: (c.x_m, c.y_m) for c in cubes_of(scene).values()}
        is_simulated = "simul" in answer and "real" not in answer
        near = told.keys() == right.keys() and all(
            math.dist(told[colour], right[colour]) <= 0.02 for colour in right
        )
        return is_simulated and near


class GripperFromClose(_Question):
    """Show the gripper from close up."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Show me the gripper from close up.",
        "Take a close picture of the fingers for me.",
    )
    form = ""

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """A picture of the camera on the hand must have been taken; the arm must not move."""
        taken = [
            call
            for call in conduct.calls
            if (call.tool == "get_camera_image" and '"wrist"' in call.arguments)
            or call.tool in ("read_wrist_image", "look")
        ]
        return AgentVerdict.of(
            (any(c.answer_bytes >= _PICTURE_BYTES for c in taken), "No such picture was taken."),
            (not truth.ever_moved(), "The arm has moved."),
        )


class WhatWouldHappen(_Question):
    """Tell what a move would do, without making it."""

    wordings: ClassVar[tuple[str, ...]] = (
        "What would happen if you moved the hand {low} cm down from where it is? Only tell me, "
        "move nothing.",
        "Suppose that the hand goes {low} cm down: how high over the table would it then be? Do "
        "not do it.",
    )
    form = '<height of the TCP in cm, or "no" if it cannot be done>'
    difficulty: ClassVar[Difficulty] = 2

    def prepare(self, seed: int) -> AgentScene:
        """In one of four scenes the move ends in the table."""
        low = (30, 20, 40, 49)[seed % 4]
        return self.scene(seed, facts={"low": low, "answer": str(_HOME_CM - low)})

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The answer must be right, and the arm must not have moved."""
        if truth.ever_moved():
            return AgentVerdict(success=False, reason="The arm has moved.")
        return super().judge(scene, truth, conduct)

    def is_right(self, scene: AgentScene, truth: Truth, answer: str) -> bool:
        """The height must be within 1 cm; below the table there is none."""
        height_cm = _HOME_CM - scene.number("low")
        if height_cm < 0:
            return answer.startswith("no")
        return abs(number_in(answer) - height_cm) <= 1.0


class _Extreme(_Question):
    """Find the cube with the smallest value of a measure."""

    clear_m: ClassVar[float] = CLEAR_M

    @staticmethod
    def measure(cube: Cube) -> float:
        """Measure of a cube [m]."""
        raise NotImplementedError

    def first(self, cubes: Mapping[str, Cube]) -> str:
        """The cube with the smallest measure; "" if it is not clear."""
        return clear_first({n: self.measure(c) for n, c in cubes.items()}, self.clear_m)

    def prepare(self, seed: int) -> AgentScene:
        """Choose a scene with a clear answer."""
        colours = some_colours(draw(type(self).__name__, seed))
        scene = self.scene(seed, colours, lambda cubes: bool(self.first(cubes)))
        return replace(scene, facts={"answer": self.first(cubes_of(scene))})


class LookLeftmost(_Extreme):
    """Find the cube furthest to the robot's left."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Which cube lies furthest to the left, as the robot sees it?",
        "Seen from the robot, which colour has the leftmost cube?",
        "Tell me the colour of the cube with the largest y in the robot's base frame.",
    )

    @staticmethod
    def measure(cube: Cube) -> float:
        """The y axis points to the left."""
        return -cube.y_m


class LookLargest(_Extreme):
    """Find the largest cube."""

    clear_m = 0.003
    wordings: ClassVar[tuple[str, ...]] = (
        "Which cube is the largest?",
        "What colour has the biggest of the cubes?",
    )

    @staticmethod
    def measure(cube: Cube) -> float:
        """The longest edge is first."""
        return -cube.edge_m


class HandHeight(_Question):
    """Measure the height of the TCP."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Start the robot and its controller. How high above the table is its hand (TCP), in "
        "centimetres?",
        "With robot and control running: what is the height of the TCP above the table in cm?",
    )
    form = "<number of centimetres>"

    def prepare(self, seed: int) -> AgentScene:
        """The arm is at home."""
        return self.scene(seed, ("red",), facts={"answer": f"{_HOME_CM}"})

    def is_right(self, scene: AgentScene, truth: Truth, answer: str) -> bool:
        """The height must be within 1 cm of the ground truth."""
        if truth.is_empty:
            return False
        return abs(number_in(answer) - 100 * float(truth.tcp_m[-1, 2])) <= 1.0


class HowFarApart(_Question):
    """Measure the distance of two cubes."""

    wordings: ClassVar[tuple[str, ...]] = (
        "How far apart are the {one} and the {other} cube, from centre to centre, in centimetres?",
        "What is the distance between the middles of the {one} cube and the {other} cube in cm?",
    )
    form = "<number of centimetres>"
    difficulty: ClassVar[Difficulty] = 2

    def prepare(self, seed: int) -> AgentScene:
        """Draw two of the cubes."""
        chance = draw("look-distance", seed)
        colours = some_colours(chance)
        one, other = chance.sample(colours, 2)
        chosen = find_seed(seed, colours)
        cubes = cubes_of(AgentScene(seed=chosen, instruction="", colours=colours))
        apart_m = math.hypot(cubes[one].x_m - cubes[other].x_m, cubes[one].y_m - cubes[other].y_m)
        return AgentScene(
            seed=chosen,
            instruction=self.say(seed, one=one, other=other),
            answer_form=self.form,
            colours=colours,
            facts={"answer": f"{100 * apart_m:.1f}"},
        )

    def is_right(self, scene: AgentScene, truth: Truth, answer: str) -> bool:
        """The distance must be within 2 cm."""
        return abs(number_in(answer) - float(scene.text("answer"))) <= 2.0

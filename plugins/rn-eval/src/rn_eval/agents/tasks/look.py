"""Questions about the scene; answers are checked against the ground truth."""

from __future__ import annotations

import math
import re
from typing import ClassVar

from rn_eval.agents.client import ToolClient
from rn_eval.agents.conduct import Conduct
from rn_eval.agents.task import AgentScene, AgentVerdict
from rn_eval.agents.tasks.base import CubeTask, Difficulty
from rn_eval.agents.tasks.scenes import (
    ALL_COLOURS,
    clear_first,
    cubes_of,
    draw,
    find_seed,
    some_colours,
)
from rn_eval.agents.tasks.steps import answered, robot_kind, seen_colours, start_arm
from rn_eval.agents.truth import Truth


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

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Answer from the ground truth, because no tool returns the position of an object."""
        return answered(self.right(scene))


class Colours(_Question):
    """Name the colours of the cubes."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Look at the table and tell me which colours the cubes have.",
        "What colours are the cubes that you can see?",
        "Name the colour of every cube on the table.",
    )
    form = "<colours, with commas>"

    def prepare(self, seed: int) -> AgentScene:
        """Draw some of six colours."""
        colours = some_colours(draw("look-colours", seed))
        return self.scene(seed, colours, facts={"answer": ", ".join(colours)})

    def is_right(self, scene: AgentScene, truth: Truth, answer: str) -> bool:
        """The answer must name all of them and no other."""
        return colours_in(answer) == set(scene.colours)

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Look through the camera."""
        return answered(", ".join(await seen_colours(tools)))


class Count(_Question):
    """Count the cubes."""

    wordings: ClassVar[tuple[str, ...]] = (
        "How many cubes are on the table?",
        "Count the cubes that lie in front of the robot.",
        "Tell me the number of cubes you see.",
    )
    form = "<number>"

    def prepare(self, seed: int) -> AgentScene:
        """Two to five cubes."""
        colours = some_colours(draw("look-count", seed), 2, 5)
        return self.scene(seed, colours, facts={"answer": str(len(colours))})

    def is_right(self, scene: AgentScene, truth: Truth, answer: str) -> bool:
        """Compare the number."""
        return number_in(answer) == float(scene.text("answer"))

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Look through the camera."""
        return answered(len(await seen_colours(tools)))


class IsThere(_Question):
    """Tell whether there is a cube of a colour."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Is there a cube that is {asked}?",
        "Look whether one of the cubes is {asked}.",
        "Can you see a cube in {asked}?",
    )
    form = "<yes or no>"

    def prepare(self, seed: int) -> AgentScene:
        """The cube exists in half of the scenes."""
        chance = draw("look-is-there", seed)
        colours = some_colours(chance)
        others = [colour for colour in ALL_COLOURS if colour not in colours]
        is_there = seed % 2 == 0
        asked = chance.choice(colours if is_there else others)
        return self.scene(
            seed, colours, facts={"answer": "yes" if is_there else "no", "asked": asked}
        )

    def is_right(self, scene: AgentScene, truth: Truth, answer: str) -> bool:
        """The answer must begin with yes or no."""
        return answer.split(",")[0].split(" ")[0] == scene.text("answer")

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Look through the camera."""
        seen = await seen_colours(tools)
        return answered("yes" if scene.text("asked") in seen else "no")


class _Extreme(_Question):
    """Find the cube with the smallest value of a measure."""

    name: ClassVar[str] = ""

    @staticmethod
    def measure(x_m: float, y_m: float) -> float:
        """Measure of a cube's position."""
        return x_m

    def prepare(self, seed: int) -> AgentScene:
        """Choose a scene with a clear answer."""
        colours = some_colours(draw(self.name, seed))

        def first(scene: int) -> str:
            found = cubes_of(AgentScene(seed=scene, instruction="", colours=colours))
            return clear_first({n: self.measure(c.x_m, c.y_m) for n, c in found.items()})

        chosen = find_seed(
            seed,
            colours,
            lambda cubes: bool(
                clear_first({n: self.measure(c.x_m, c.y_m) for n, c in cubes.items()})
            ),
        )
        return AgentScene(
            seed=chosen,
            instruction=self.say(seed),
            answer_form=self.form,
            colours=colours,
            facts={"answer": first(chosen)},
        )


class LookLeftmost(_Extreme):
    """Find the cube furthest to the robot's left."""

    name = "look-leftmost"
    wordings: ClassVar[tuple[str, ...]] = (
        "Which cube lies furthest to the left, as the robot sees it?",
        "Seen from the robot, which colour has the leftmost cube?",
        "Tell me the colour of the cube with the largest y in the robot's base frame.",
    )

    @staticmethod
    def measure(x_m: float, y_m: float) -> float:
        """The y axis points to the left."""
        return -y_m


class LookNearest(_Extreme):
    """Find the cube nearest to the robot's base."""

    name = "look-nearest"
    wordings: ClassVar[tuple[str, ...]] = (
        "Which cube is nearest to the robot's base?",
        "What colour is the cube that stands closest to the robot?",
        "Of all cubes, which one has the smallest distance to the foot of the robot?",
    )

    @staticmethod
    def measure(x_m: float, y_m: float) -> float:
        """Distance on the table."""
        return math.hypot(x_m, y_m)


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
        return self.scene(seed, ("red",), facts={"answer": "48.7"})

    def is_right(self, scene: AgentScene, truth: Truth, answer: str) -> bool:
        """The height must be within 1 cm of the ground truth."""
        if truth.is_empty:
            return False
        return abs(number_in(answer) - 100 * float(truth.tcp_m[-1, 2])) <= 1.0

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Measure the height with read_ee_pose."""
        await start_arm(tools)
        _, _, z_m = await tools.tcp_m()
        return answered(f"{100 * z_m:.1f}")


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


class RealOrSimulated(_Question):
    """Tell whether the robot is real."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Is this a real robot or a simulated one?",
        "Before we begin: do we work with real hardware here, or with a simulation?",
    )
    form = "<real or simulated>"

    def prepare(self, seed: int) -> AgentScene:
        """The robot is always simulated."""
        return self.scene(seed, ("red",), facts={"answer": "simulated"})

    def is_right(self, scene: AgentScene, truth: Truth, answer: str) -> bool:
        """The answer must contain "simul", and not "real"."""
        return "simul" in answer and "real" not in answer

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Read the status."""
        return answered(await robot_kind(tools))

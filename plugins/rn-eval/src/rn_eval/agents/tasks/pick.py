"""Pick up a cube: named by its colour, by its position, or by exclusion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from rn_eval.agents.client import ToolClient
from rn_eval.agents.conduct import Conduct
from rn_eval.agents.task import AgentScene, AgentVerdict
from rn_eval.agents.tasks.base import (
    STARTED,
    CubeTask,
    Difficulty,
    draw_target,
    lifted_alone,
    stands_on,
)
from rn_eval.agents.tasks.keeping import WHOLE_ARM_M, within_side, within_speed
from rn_eval.agents.tasks.scenes import clear_first, cubes_of, draw, find_seed, some_colours
from rn_eval.agents.tasks.steps import DONE, lift
from rn_eval.agents.truth import LIFTED_M, Truth
from rn_robot_fr3.cameras import cameras
from rn_simulation.cubes import Cube
from rn_simulation.pinhole import DEFAULT_SIZE_PX
from roboneuron import CameraView

_HANDS_M = (-0.3, -0.2, 0.2, 0.3)
"""Where a person takes a cube from the hand: y in the base frame."""
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
            answer_form=self.form,
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


class PickAndTurn(_Pick):
    """Pick up a cube, hold it higher, and turn it."""

    name = "pick-turned"
    difficulty: ClassVar[Difficulty] = 2
    wordings: ClassVar[tuple[str, ...]] = (
        "Pick up the {colour} cube.\nHold it 8 cm higher, and turn it by 90 degrees.",
        "Take the {colour} cube off the table.\nRaise it by 8 cm more, and turn it by 90 degrees.",
    )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """After it hung still, the cube must have been raised and turned."""
        picked = super().judge(scene, truth, conduct)
        if not picked.success:
            return picked
        target = scene.text("target")
        heights_m = truth.height_m(target)
        hung = [
            index
            for begin, _ in truth.standstills_s(0.2)
            if heights_m[index := int(np.searchsorted(truth.t_s, begin))] >= LIFTED_M
        ]
        raised = [i for i in hung if abs(heights_m[-1] - heights_m[i] - 0.08) <= 0.015]
        turned = [i for i in hung if abs(abs(truth.turned_deg(target, i)) - 90.0) <= 5.0]
        return AgentVerdict.of(
            (bool(raised), "The cube was not held 8 cm higher."),
            (bool(turned), "The cube was not turned by 90 degrees."),
        )


class PickStacked(_Pick):
    """Pick up a cube that stands on another one, slowly, and out of a part of the table."""

    name = "pick-stacked"
    difficulty: ClassVar[Difficulty] = 3
    time_limit_s = 180.0
    wordings: ClassVar[tuple[str, ...]] = (
        "Stack the {colour} cube on top of the {other} cube.\nFrom now on the hand must never be "
        "faster than {speed} cm/s, and no part of the arm may be further {side} than 15 cm from "
        "the middle of the table.\nPick up the {colour} cube.",
        "Put the {colour} block onto the {other} block and let it go.\nSlower from here, at most "
        "{speed} cm/s for the hand, and keep the whole arm out of what lies further {side} than 15 "
        "cm from the middle of the table.\nPick up the {colour} cube.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """The other cube lies on the allowed side."""
        chance = draw(self.name, seed)
        colours = some_colours(chance, 3, 3)
        target, other = chance.sample(colours, 2)
        side = chance.choice(("left", "right"))
        sign = 1.0 if side == "left" else -1.0
        facts = {"target": target, "other": other, "speed": chance.choice((8, 10)), "side": side}
        return self.scene(seed, colours, lambda c: c[other].y_m * sign <= -0.02, facts)

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """It must have stood there; from then on both limits must have been kept."""
        if truth.is_empty:
            return AgentVerdict(success=False, reason=STARTED)
        target = scene.text("target")
        stood = [
            begin
            for begin, _ in truth.standstills_s(0.3)
            if _is_left_standing(truth, target, scene.text("other"), begin)
        ]
        if not stood:
            return AgentVerdict(success=False, reason="It never stood on the other one.")
        after = truth.since(stood[0])
        return AgentVerdict.of(
            within_speed(scene, after),
            within_side(after, scene.text("side"), WHOLE_ARM_M),
            (truth.is_lifted(target), f"The {target} cube is not in the air at the end."),
        )


def _is_left_standing(truth: Truth, upper: str, lower: str, at_s: float) -> bool:
    """True if a cube stood on another one at a time, with the hand well above it."""
    sample = int(np.searchsorted(truth.t_s, at_s))
    rise_m = truth.tcp_m[sample, 2] - truth.cubes_m[sample, truth.names.index(upper), 2]
    return stands_on(truth, upper, lower, sample)[0] and bool(rise_m >= 0.05)


class PickPointed(_Pick):
    """Pick up a cube that the person shows in a picture."""

    name = "pick-pointed"
    difficulty: ClassVar[Difficulty] = 2
    wordings: ClassVar[tuple[str, ...]] = (
        "Pick up the cube that I show you: in the picture of the front camera, as look gives it, "
        "it is at column {column}, row {row}.",
        "Take what is at column {column}, row {row} of the front camera's picture (of look), and "
        "hold it up.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """The pixel shows the middle of the cube."""
        _, colours, target = draw_target(self.name, seed)
        cube = cubes_of(self.scene(seed, colours, column=0, row=0))[target]
        column, row = _front_pixel((cube.x_m, cube.y_m, cube.edge_m / 2))
        return self.scene(seed, colours, facts={"target": target}, column=column, row=row)


def _front_pixel(place_m: tuple[float, float, float]) -> tuple[int, int]:
    """Column and row of a place in the front camera's picture of `look`, twice its size."""
    front = cameras()[0]
    camera = front.calibration(*DEFAULT_SIZE_PX)
    view = CameraView(intrinsics=camera.intrinsics, T_base_camera=camera.T_mount_camera)
    column, row = 2 * view.project(np.array(place_m))
    return int(column), int(row)


class HoldOut(_Pick):
    """Pick up a cube and hold it out."""

    name = "pick-hold-out"
    difficulty: ClassVar[Difficulty] = 2
    wordings: ClassVar[tuple[str, ...]] = (
        "Pick up the {colour} cube, and hold it out to me at (0.5, {y_m}, 0.35), metres in the "
        "base frame.",
        "Take the {colour} block and bring it to x = 0.5, y = {y_m}, z = 0.35 metres of the base "
        "frame, where I take it from you; do not let it go.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """Draw the side."""
        chance, colours, target = draw_target(self.name, seed)
        return self.scene(seed, colours, facts={"target": target, "y_m": chance.choice(_HANDS_M)})

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The cube must be there, and nowhere else."""
        picked = super().judge(scene, truth, conduct)
        if not picked.success:
            return picked
        off_m = math.dist(truth.end_m(scene.text("target")), (0.5, scene.number("y_m"), 0.35))
        return AgentVerdict.of((off_m <= 0.04, f"The cube is {100 * off_m:.0f} cm away from it."))

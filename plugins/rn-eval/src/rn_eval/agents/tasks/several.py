"""Several robots behind one server: two arms with a table each, or an arm and a mobile base."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar

import anyio

from rn_eval.agents.base_truth import BaseTruth
from rn_eval.agents.client import ToolClient
from rn_eval.agents.conduct import Conduct
from rn_eval.agents.task import AgentScene, AgentVerdict, Companion
from rn_eval.agents.tasks.base import CubeTask, Difficulty, draw_target
from rn_eval.agents.tasks.driving import drive, start_base, turn
from rn_eval.agents.tasks.scenes import draw, find_seed, some_colours
from rn_eval.agents.tasks.steps import DONE, lift_whatever_happens
from rn_eval.agents.truth import Truth

LEFT, RIGHT = "left", "right"
ARM, BASE = "arm", "base"
BASE_KIND = "diffdrive"
NEAR_M, NEAR_RAD = 0.06, math.radians(8.0)
"""Tolerances of the base's pose: a tenth of the distance, a tenth of a right angle."""
_WITHIN_S = 150.0


class _TwoArms(CubeTask):
    """A task for two arms, with a target cube for each."""

    difficulty: ClassVar[Difficulty] = 3
    time_limit_s = 240.0

    def prepare(self, seed: int) -> AgentScene:
        """Draw the arm (if only one is to work) and a cube for each."""
        chance = draw(type(self).__name__, seed)
        colours, others = some_colours(chance, 3, 3), some_colours(chance, 3, 3)
        mine, theirs = chance.choice(colours), chance.choice(others)
        robot = chance.choice((LEFT, RIGHT))
        by_robot = {LEFT: mine, RIGHT: theirs}
        other = RIGHT if robot == LEFT else LEFT
        return replace(
            self.scene(
                seed,
                colours,
                facts={"robot": robot, "other": other, LEFT: mine, RIGHT: theirs},
                colour=by_robot[robot],
            ),
            robot=LEFT,
            companions=(
                Companion(name=RIGHT, seed=find_seed(seed + 1000, others), colours=others),
            ),
        )


def arms_of(truth: Truth) -> dict[str, Truth]:
    """Both arms by name."""
    return {LEFT: truth, RIGHT: truth.others.get(RIGHT, Truth.nothing())}


def _holds(arm: Truth, robot: str, colour: str) -> tuple[tuple[bool, str], ...]:
    wrong = [name for name in arm.names if name != colour and arm.was_lifted(name)]
    held = colour in arm.names and arm.is_lifted(colour)
    return (
        (not wrong, f"The {robot} robot lifted {', '.join(wrong)}, meant was {colour}."),
        (held, f"The {colour} cube of the {robot} robot is not in the air at the end."),
    )


class OneOfTwo(_TwoArms):
    """One arm picks up its cube; the other must not move."""

    difficulty = 2
    wordings: ClassVar[tuple[str, ...]] = (
        "There are two robots, left and right. Let the {robot} robot pick up its {colour} cube; "
        "the {other} robot must not move.",
        "Pick up the {colour} cube with the {robot} robot. Leave the {other} robot alone.",
    )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The cube must be in the air; the other arm must not have moved."""
        arms, robot, other = arms_of(truth), scene.text("robot"), scene.text("other")
        return AgentVerdict.of(
            (not arms[other].ever_moved(), f"The {other} robot has moved."),
            *_holds(arms[robot], robot, scene.text(robot)),
        )

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Use the tools of the named robot."""
        robot = scene.text("robot")
        await lift_whatever_happens(tools.of(robot), scene.text(robot), within_s=_WITHIN_S)
        return DONE


class BothArms(_TwoArms):
    """Each arm picks up its cube."""

    wordings: ClassVar[tuple[str, ...]] = (
        "There are two robots. The left robot is to pick up its {left} cube, the right robot its "
        "{right} cube; both hold them in the end.",
        "Pick up the {left} cube with the left robot and the {right} cube with the right robot.",
    )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """Both cubes must be in the air."""
        demands = [_holds(arm, name, scene.text(name)) for name, arm in arms_of(truth).items()]
        return AgentVerdict.of(*(demand for of_one in demands for demand in of_one))

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Use the arms one after the other, which two processor cores can sustain."""
        for robot in (LEFT, RIGHT):
            await lift_whatever_happens(tools.of(robot), scene.text(robot), within_s=100.0)
            await tools.of(robot).call("stop_inference")
        return DONE


class StopOne(_TwoArms):
    """One arm is stopped; the other works."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Somebody stands beside the {other} robot: press the emergency stop of the {other} robot, "
        "and of that one only. Then let the {robot} robot pick up its {colour} cube.",
        "Emergency stop for the {other} robot alone, now; after that pick up the {colour} cube "
        "with the {robot} robot.",
    )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """One arm must be latched until the end; the other must never have been, and must hold its
        cube.
        """
        arms, robot, other = arms_of(truth), scene.text("robot"), scene.text("other")
        stopped = arms[other].latched_s
        return AgentVerdict.of(
            (bool(stopped), f"The {other} robot was not stopped."),
            (not arms[robot].latched_s, f"The {robot} robot was stopped as well."),
            (not arms[other].ever_moved(), f"The {other} robot has moved."),
            *_holds(arms[robot], robot, scene.text(robot)),
        )

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Trigger the stop first."""
        robot, other = scene.text("robot"), scene.text("other")
        await tools.of(other).must("emergency_stop", reason="a person stands beside it")
        await lift_whatever_happens(tools.of(robot), scene.text(robot), within_s=_WITHIN_S)
        return DONE


class _WithBase(CubeTask):
    """A task with an arm, cubes and a mobile base."""

    difficulty: ClassVar[Difficulty] = 2
    time_limit_s = 120.0
    distances_cm: ClassVar[tuple[int, ...]] = (60, 80, 100)
    sides: ClassVar[tuple[str, ...]] = ("forwards", "back")

    def prepare(self, seed: int) -> AgentScene:
        """Draw distance and direction, or the angle."""
        chance, colours, target = draw_target(type(self).__name__, seed)
        side = chance.choice(self.sides)
        distance_cm, degrees = chance.choice(self.distances_cm), chance.choice((60, 90, 120))
        sign = 1.0 if side in ("forwards", "left") else -1.0
        return replace(
            self.scene(
                seed,
                colours,
                facts={
                    "target": target,
                    "way_m": sign * distance_cm / 100,
                    "turn_rad": sign * math.radians(degrees),
                },
                distance=distance_cm,
                side=side,
                degrees=degrees,
            ),
            robot=ARM,
            companions=(Companion(name=BASE, robot=BASE_KIND),),
        )


def _stands(base: BaseTruth, way_m: float, turn_rad: float) -> tuple[tuple[bool, str], ...]:
    x_m, y_m, yaw_rad = base.end
    off_m, off_rad = math.hypot(x_m - way_m, y_m), abs(yaw_rad - turn_rad)
    return (
        (not base.is_empty, "The base was never started."),
        (off_m <= NEAR_M, f"The base is {100 * off_m:.0f} cm from where it should be."),
        (off_rad <= NEAR_RAD, f"The base is turned {math.degrees(off_rad):.0f}° off."),
        (base.is_still_at_end(), "The base still moves."),
    )


def base_of(truth: Truth) -> BaseTruth:
    """Ground truth of the mobile base; empty if it was never seen."""
    nothing = Truth.nothing()
    return truth.bases.get(BASE, BaseTruth(t_s=nothing.t_s, poses=nothing.tcp_m))


class _BaseAlone(_WithBase):
    """The base drives straight or turns; the arm must not move."""

    turns: ClassVar[bool] = False

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The base must be at its target, and the arm must not have moved."""
        way_m, turn_rad = scene.number("way_m"), scene.number("turn_rad")
        wanted = (0.0, turn_rad) if self.turns else (way_m, 0.0)
        return AgentVerdict.of(
            (not truth.ever_moved(), "The arm has moved."), *_stands(base_of(truth), *wanted)
        )

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Drive by odometry."""
        base = tools.of(BASE)
        await start_base(base)
        if self.turns:
            await turn(base, scene.number("turn_rad"))
        else:
            await drive(base, scene.number("way_m"))
        return DONE


class DriveBase(_BaseAlone):
    """The base drives straight on."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Drive the mobile base {distance} cm {side} and let it stand there. The arm must not move.",
        "The mobile base is to go {distance} cm straight {side}, and stop. Leave the arm alone.",
    )


class TurnBase(_BaseAlone):
    """The base turns on the spot."""

    turns = True
    sides = ("left", "right")
    wordings: ClassVar[tuple[str, ...]] = (
        "Turn the mobile base by {degrees} degrees to the {side}, on the spot. The arm must not "
        "move.",
        "The mobile base is to turn to the {side} by {degrees} degrees and to stay where it is.",
    )


class ArmAndBase(_WithBase):
    """The arm picks up a cube, and the base drives."""

    difficulty = 3
    time_limit_s = 240.0
    wordings: ClassVar[tuple[str, ...]] = (
        "Let the arm pick up its {colour} cube and drive the mobile base {distance} cm {side}.",
        "Drive the mobile base {distance} cm {side}; the arm is to lift the {colour} cube and hold "
        "it.",
    )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The base must be at its target, and the cube in the air."""
        return AgentVerdict.of(
            *_holds(truth, ARM, scene.text("target")),
            *_stands(base_of(truth), scene.number("way_m"), 0.0),
        )

    async def solve(self, tools: ToolClient, scene: AgentScene) -> str:
        """Do both at the same time."""
        arm, base = tools.of(ARM), tools.of(BASE)
        await start_base(base)
        async with anyio.create_task_group() as group:
            group.start_soon(drive, base, scene.number("way_m"))
            await lift_whatever_happens(arm, scene.text("target"), within_s=_WITHIN_S)
        return DONE

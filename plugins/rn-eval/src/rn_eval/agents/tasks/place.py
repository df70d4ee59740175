"""Put cubes down: by a distance, next to or onto others, or in sequence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np

from rn_eval.agents.conduct import Conduct
from rn_eval.agents.task import AgentScene, AgentVerdict
from rn_eval.agents.tasks.base import (
    STARTED,
    CubeTask,
    Difficulty,
    draw_target,
    let_go,
    stands_on,
    started_at,
    untouched,
)
from rn_eval.agents.tasks.scenes import cubes_of, draw, find_seed, is_free, some_colours
from rn_eval.agents.truth import Truth
from rn_simulation.cubes import Cube

NEAR_M = 0.03
"""Tolerance of a position: two thirds of a cube's edge."""
GENTLE_M_S = 0.08
"""Highest speed at which a cube may come down onto the table if it shall be put gently."""
SIDES = {
    "to the left": (0.0, 1.0),
    "to the right": (0.0, -1.0),
    "forwards, away from the robot": (1.0, 0.0),
    "back towards the robot": (-1.0, 0.0),
}


def is_put(truth: Truth, colour: str, x_m: float, y_m: float) -> AgentVerdict:
    """Check that a cube lies on the table at a position, and that the hand has released it."""
    if truth.is_empty or colour not in truth.names:
        return AgentVerdict(success=False, reason=STARTED)
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


class BySide(_Put):
    """Put a cube a distance to a side."""

    name = "put-by"
    wordings: ClassVar[tuple[str, ...]] = (
        "Put the {colour} cube {distance} cm {side} of where it lies, as the robot sees it.",
        "Move the {colour} block {distance} cm {side}, seen from the robot, and let it go there.",
        "Please take the {colour} cube and set it down {distance} cm further {side} (robot's "
        "view).",
    )

    def prepare(self, seed: int) -> AgentScene:
        """Choose a scene in which the target position is free."""
        chance, colours, target = draw_target(self.name, seed)
        side = chance.choice(sorted(SIDES))
        distance_cm = chance.choice((8, 10, 12))
        dx_m, dy_m = (part * distance_cm / 100 for part in SIDES[side])

        def has_room(cubes: Mapping[str, Cube]) -> bool:
            cube = cubes[target]
            return is_free(cubes, target, cube.x_m + dx_m, cube.y_m + dy_m)

        scene = self.scene(
            seed, colours, has_room, {"target": target}, distance=distance_cm, side=side
        )
        x_m, y_m = started_at(scene, target)
        facts = {**scene.facts, "x_m": x_m + dx_m, "y_m": y_m + dy_m}
        return replace(scene, facts=facts)


class WhereTaken(BySide):
    """Pick a cube up, hold it higher, and put it down gently beside where it was taken."""

    name = "put-taken"
    wordings: ClassVar[tuple[str, ...]] = (
        "Pick up the {colour} cube.\nHold it 5 cm higher.\nNow put it down gently, {distance} cm "
        "{side} of where you took it.",
        "Lift the {colour} cube off the table.\nRaise it by 5 cm more.\nSet it down softly, "
        "{distance} cm {side} of where you have taken it.",
    )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """It must also have come down slowly."""
        put_down = super().judge(scene, truth, conduct)
        if not put_down.success:
            return put_down
        speed_m_s = landing_speed_m_s(truth, scene.text("target"))
        return AgentVerdict.of(
            (
                speed_m_s <= GENTLE_M_S,
                f"The cube came down at {100 * speed_m_s:.0f} cm/s, gently is at most "
                f"{100 * GENTLE_M_S:.0f}.",
            ),
        )


def landing_speed_m_s(truth: Truth, colour: str) -> float:
    """Highest downward speed of a cube in the last 2 cm above the table, after it was lifted."""
    heights_m = truth.height_m(colour)
    lifted = np.flatnonzero(heights_m >= 0.05)
    if not lifted.size:
        return 0.0
    last = int(lifted[-1])
    times_s, down_m = truth.t_s[last:], heights_m[last:]
    earlier = np.maximum(np.searchsorted(times_s, times_s - 0.1), 0)
    passed_s = times_s - times_s[earlier]
    is_low = (down_m <= 0.02) & (passed_s >= 0.05)
    speeds = (down_m[earlier] - down_m)[is_low] / passed_s[is_low]
    return float(speeds.max(initial=0.0))


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
        yaw_deg = chance.choice((-30, -15, 0, 15, 30))
        return self.scene(
            seed,
            colours,
            lambda cubes: is_free(cubes, target, x_m, y_m),
            {"target": target, "x_m": x_m, "y_m": y_m, "yaw": yaw_deg},
        )


class PutTurned(AtPlace):
    """Put a cube at coordinates, with its faces in a direction."""

    name = "put-yawed"
    wordings: ClassVar[tuple[str, ...]] = (
        "Put the {colour} cube down at x = {x_m} m, y = {y_m} m of the robot's base frame, with "
        "its faces turned to a yaw of {yaw} degrees.",
        "Set the {colour} block onto the table at ({x_m}, {y_m}), metres in the base frame, at a "
        "yaw of {yaw} degrees.",
    )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """Its faces must also have the direction; quarter turns of a cube look the same."""
        put_down = super().judge(scene, truth, conduct)
        if not put_down.success:
            return put_down
        yaws = np.degrees(truth.yaws_rad[-1, truth.names.index(scene.text("target"))])
        off_deg = abs(math.remainder(float(yaws) - scene.number("yaw"), 90.0))
        return AgentVerdict.of((off_deg <= 5.0, f"The cube is turned {off_deg:.0f} degrees off."))


class Beside(_Put):
    """Put a cube next to another one."""

    name = "put-beside"
    difficulty: ClassVar[Difficulty] = 3
    wordings: ClassVar[tuple[str, ...]] = (
        "Put the {colour} cube beside the {other} cube, on its {side} side as the robot sees it, "
        "with {gap} cm between them.",
        "The {colour} cube belongs on the {side} side of the {other} one (robot's view), with a "
        "gap of {gap} cm between the two. Put it there.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """Choose a scene with a free position next to the other cube."""
        chance = draw(self.name, seed)
        colours = some_colours(chance, 3, 3)
        target, other = chance.sample(colours, 2)
        side, gap_cm = chance.choice(("left", "right")), chance.choice((4, 5, 6))
        dy_m = (0.044 + gap_cm / 100) * (1.0 if side == "left" else -1.0)
        return self.scene(
            seed,
            colours,
            lambda cubes: is_free(
                {n: c for n, c in cubes.items() if n != other},
                target,
                cubes[other].x_m,
                cubes[other].y_m + dy_m,
                0.14,
            ),
            {"target": target, "other": other, "side": side, "gap": gap_cm},
        )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """Judge the gap between the faces, and that nothing else was moved."""
        if truth.is_empty:
            return AgentVerdict(success=False, reason=STARTED)
        target, other = scene.text("target"), scene.text("other")
        gap_cm = 100 * truth.gap_m(target, other)
        away_m = float(truth.end_m(target)[1] - truth.end_m(other)[1])
        is_left = scene.text("side") == "left"
        return AgentVerdict.of(
            (truth.is_resting(target), f"The {target} cube does not lie on the table."),
            (abs(gap_cm - scene.number("gap")) <= 1.0, f"The gap is {gap_cm:.1f} cm wide."),
            (abs(away_m) > 0.04 and (away_m > 0) == is_left, "It lies on the wrong side."),
            untouched(truth, target),
            let_go(truth),
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
            return AgentVerdict(success=False, reason=STARTED)
        target, other = scene.text("target"), scene.text("other")
        return AgentVerdict.of(
            (truth.is_resting(other), f"The {other} cube does not lie on the table."),
            stands_on(truth, target, other),
            let_go(truth),
        )


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
            return AgentVerdict(success=False, reason=STARTED)
        place = truth.end_m(one)
        off_m = math.hypot(place[0] - scene.number("x_m"), place[1] - scene.number("y_m"))
        first = [float(truth.t_s[(truth.height_m(n) >= 0.05).argmax()]) for n in (one, other)]
        return AgentVerdict.of(
            (truth.is_resting(one), f"The {one} cube does not lie on the table."),
            (off_m <= NEAR_M, f"The {one} cube is {100 * off_m:.0f} cm from where it should be."),
            (truth.is_lifted(other), f"The {other} cube is not in the air at the end."),
            (first[0] < first[1], "They were taken in the wrong order."),
        )

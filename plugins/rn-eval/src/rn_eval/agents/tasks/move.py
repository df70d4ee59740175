"""Simple moves of the hand, without cubes."""

from __future__ import annotations

import math
from typing import ClassVar

from rn_eval.agents.conduct import Conduct
from rn_eval.agents.task import AgentScene, AgentVerdict
from rn_eval.agents.tasks.base import STARTED, CubeTask, Difficulty, draw_target, untouched
from rn_eval.agents.tasks.pick import HOME_M
from rn_eval.agents.tasks.scenes import draw
from rn_eval.agents.truth import F64, Truth

NEAR_M = 0.01
_WAVE_RAD = 0.15
_DELTAS = {
    "up": (0.0, 0.0, 0.1),
    "down": (0.0, 0.0, -0.1),
    "to the left": (0.0, 0.1, 0.0),
    "to the right": (0.0, -0.1, 0.0),
    "forwards": (0.1, 0.0, 0.0),
}
"""Displacements from the robot's view, for 10 cm [m]."""


class _Move(CubeTask):
    """The TCP must be at a given position at the end."""

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The TCP must be within 1 cm."""
        if truth.is_empty:
            return AgentVerdict(success=False, reason=STARTED)
        place = tuple(scene.number(axis) for axis in ("x_m", "y_m", "z_m"))
        off_m = math.dist(truth.tcp_m[-1], place)
        return AgentVerdict.of(
            (off_m <= NEAR_M, f"The hand is {100 * off_m:.1f} cm from where it should be."),
        )


class ByDistance(_Move):
    """Move by a distance in a direction."""

    name = "move-by"
    wordings: ClassVar[tuple[str, ...]] = (
        "Move the hand {distance} cm {side}, as the robot sees it.",
        "Please move the gripper {distance} centimetres {side} (robot's view).",
        "I need the hand {distance} cm further {side}, seen from the robot.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """The arm starts at home."""
        chance = draw(self.name, seed)
        side, distance_cm = chance.choice(sorted(_DELTAS)), chance.choice((5, 10, 15))
        delta = [part * distance_cm / 10 for part in _DELTAS[side]]
        x_m, y_m, z_m = (start + d for start, d in zip(HOME_M, delta, strict=True))
        return self.scene(
            seed, facts={"x_m": x_m, "y_m": y_m, "z_m": z_m}, distance=distance_cm, side=side
        )


class ToPlace(_Move):
    """Move to coordinates."""

    name = "move-to-place"
    wordings: ClassVar[tuple[str, ...]] = (
        "Move the hand (TCP) to x = {x_m}, y = {y_m}, z = {z_m} metres of the base frame.",
        "Bring the TCP to ({x_m}, {y_m}, {z_m}), metres in the robot's base frame.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """Draw a position above the table."""
        chance = draw(self.name, seed)
        facts = {
            "x_m": round(chance.uniform(0.35, 0.55), 2),
            "y_m": round(chance.uniform(-0.25, 0.25), 2),
            "z_m": round(chance.uniform(0.25, 0.5), 2),
        }
        return self.scene(seed, facts=facts)


class AwayAndHome(_Move):
    """Move away and home again."""

    name = "move-and-home"
    difficulty: ClassVar[Difficulty] = 2
    wordings: ClassVar[tuple[str, ...]] = (
        "Move the hand 15 cm down, and then go back to the home posture.",
        "Lower the hand by 15 cm, after that take the arm home.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """The target is the home pose, where the arm starts."""
        facts = dict(zip(("x_m", "y_m", "z_m"), HOME_M, strict=True))
        return self.scene(seed, facts=facts)

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The hand must have been down, and be back."""
        back = super().judge(scene, truth, conduct)
        if not back.success:
            return back
        lowest_m = float(truth.tcp_m[:, 2].min())
        return AgentVerdict.of(
            (
                abs(lowest_m - (HOME_M[2] - 0.15)) <= 0.02,
                f"The lowest height of the hand was {100 * lowest_m:.0f} cm.",
            ),
        )


class Gripper(CubeTask):
    """Set the gripper opening."""

    name = "move-gripper"
    wordings: ClassVar[tuple[str, ...]] = (
        "Open the gripper to {percent} percent; the arm itself stays where it is.",
        "Set the fingers to {percent} % of their opening without moving the arm.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """The hand is empty."""
        percent = draw(self.name, seed).choice((0, 25, 50))
        return self.scene(seed, facts={"percent": percent})

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The fingers must have the opening, and the arm must not have moved."""
        if truth.is_empty:
            return AgentVerdict(success=False, reason=STARTED)
        percent = 100 * truth.grip_width_m() / 0.08
        return AgentVerdict.of(
            (
                abs(percent - scene.number("percent")) <= 4,
                f"The gripper is open to {percent:.0f} %.",
            ),
            (not truth.ever_moved(), "The arm has moved."),
        )


class Joint(CubeTask):
    """Move one joint to an angle."""

    name = "move-joint"
    wordings: ClassVar[tuple[str, ...]] = (
        "Turn the last joint of the arm, fr3_joint7, to {degrees} degrees.",
        "Bring joint fr3_joint7 to an angle of {degrees} degrees; the other joints stay.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """The joint starts at 45 degrees (home)."""
        degrees = draw(self.name, seed).choice((-30, 0, 20, 70, 90))
        return self.scene(seed, facts={"degrees": degrees})

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The joint must have the angle, and the others must not have moved."""
        if truth.is_empty:
            return AgentVerdict(success=False, reason=STARTED)
        end = math.degrees(truth.joints_rad[-1, 6])
        others = abs(truth.joints_rad[-1, :6] - truth.joints_rad[truth.starts[-1], :6]).max()
        return AgentVerdict.of(
            (abs(end - scene.number("degrees")) <= 1.0, f"The joint stands at {end:.0f} degrees."),
            (float(others) <= 0.02, "Other joints have moved."),
        )


class GetReady(CubeTask):
    """Get ready: everything that motion needs is started."""

    wordings: ClassVar[tuple[str, ...]] = (
        "Get ready to work: I will ask you for something in a moment.",
        "Prepare the robot, so that you can begin at once when I ask for something.",
    )

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """Robot, cameras and controller must run at the end, and the arm must not have moved."""
        missing = [m for m in ("robot", "perception", "control") if m not in conduct.running]
        return AgentVerdict.of(
            (not missing, f"Does not run: {', '.join(missing)}."),
            (not truth.ever_moved(), "The arm has moved."),
        )


class WaveHand(CubeTask):
    """Wave."""

    difficulty: ClassVar[Difficulty] = 2
    wordings: ClassVar[tuple[str, ...]] = ("Wave to me.", "Say hello with the arm: wave.")

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """A joint must have gone to and fro, and no cube may have been moved."""
        turns = [_turns(angles) for angles in truth.joints_rad.T]
        return AgentVerdict.of(
            (max(turns, default=0) >= 3, "No joint went to and fro."),
            untouched(truth),
        )


def _turns(angles_rad: F64) -> int:
    """How often a joint turned back, each time by at least `_WAVE_RAD`."""
    count, side, farthest = 0, 0.0, 0.0
    for angle in angles_rad - angles_rad[:1]:
        if side == 0.0 and abs(angle) >= _WAVE_RAD:
            side = math.copysign(1.0, angle)
        if side * angle >= side * farthest:
            farthest = angle
        elif abs(angle - farthest) >= _WAVE_RAD:
            count, side, farthest = count + 1, -side, angle
    return count


class HandAbove(CubeTask):
    """Hold the hand over a cube."""

    difficulty: ClassVar[Difficulty] = 2
    wordings: ClassVar[tuple[str, ...]] = (
        "Hold the hand {above} cm over the {colour} cube, without touching it.",
        "Go with the hand over the {colour} cube, {above} cm over its top, and touch nothing.",
    )

    def prepare(self, seed: int) -> AgentScene:
        """Draw a cube and a height."""
        chance, colours, target = draw_target("move-over", seed)
        facts = {"target": target, "above": chance.choice((8, 12, 15))}
        return self.scene(seed, colours, facts=facts)

    def judge(self, scene: AgentScene, truth: Truth, conduct: Conduct) -> AgentVerdict:
        """The TCP must be there, and no cube may have been moved."""
        if truth.is_empty:
            return AgentVerdict(success=False, reason=STARTED)
        target = scene.text("target")
        place = truth.end_m(target)
        top_m = place[2] + truth.edges_m[truth.names.index(target)] / 2
        goal = (place[0], place[1], top_m + scene.number("above") / 100)
        off_m = math.dist(truth.tcp_m[-1], goal)
        return AgentVerdict.of(
            (off_m <= 0.02, f"The hand is {100 * off_m:.1f} cm from where it should be."),
            untouched(truth),
        )

"""What a simulated call answers, and what is looked at on the way."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from pydantic import Field

from roboneuron import F64, JointSample, Obstacle, Pose, Proximity, Result
from roboneuron.feature import MotionRules

Outcome = Literal["reached", "refused", "stopped", "blocked", "unclear"]
_MOST_NEAR = 8


class Nearest(Result):
    """The least distance on the way."""

    to: str
    part: str = Field(description="tcp, a link, or two links")
    distance_m: float = Field(description="negative: inside, or beyond")
    at_s: float


class Simulated(Result):
    """What would happen; nothing moved."""

    simulated: bool = True
    tool: str
    allowed: bool = Field(description="it would come to its end: `outcome` is reached")
    outcome: Outcome = Field(
        description="reached; refused: before it moves, by `rule`; stopped: on the way, by `rule`; "
        "blocked: by contact; unclear: the simulation took too long, or a task cannot be judged"
    )
    rule: str = Field(
        default="", description="as refusals name it, the controller's code, or a task's outcome"
    )
    reason: str = ""
    limits: dict[str, int] = Field(
        default_factory=dict, description="limits that would act, by the number of steps"
    )
    would_move: list[str] = Field(
        default_factory=list,
        description="objects that would be elsewhere after it, with what the hand holds",
    )
    nearest: list[Nearest] = Field(default_factory=list, description="the nearest first")
    duration_s: float = Field(description="of the motion")
    position_m: list[float] = Field(
        description="TCP at the end, base frame; of the named arm, or the first"
    )
    quaternion_xyzw: list[float]
    joints: dict[str, float] = Field(description="at the end [rad or m]")
    now: str = Field(
        default="", description="why the call itself would be refused at present; empty: it is not"
    )
    took_s: float = Field(description="of the simulation")


@runtime_checkable
class DistanceTeller(Protocol):
    """A controller that tells how far bodies are apart, however far that is."""

    def distances(self, joints: JointSample) -> tuple[Proximity, ...]:
        """Of links to each other and to obstacles, the nearest first. Raises UnsafeError."""


class Survey:
    """Notes the least distances and the limits that act."""

    def __init__(self, rules: MotionRules, controller: object) -> None:
        """Args:
        rules: limits in force.
        controller: of control; tells distances if it is a `DistanceTeller`.
        """
        self._rules = rules
        self._teller = controller if isinstance(controller, DistanceTeller) else None
        collision = rules.collision
        self._obstacles = {box.name for box in collision.obstacles} if collision else set()
        self._nearest: dict[str, Nearest] = {}
        self.limits: Counter[str] = Counter()

    def look(self, joints: JointSample, poses: Sequence[Pose], at_s: float) -> None:
        """Take in a posture on the way. Raises UnsafeError."""
        rules = self._rules
        for pose in poses:
            place = pose.position_m
            for zone in rules.zones:
                self._note(f"zone {zone.name}", "tcp", outside_m(place, zone), at_s)
            room_m = float(np.minimum(place - rules.lower_m, rules.upper_m - place).min())
            self._note("workspace", "tcp", room_m, at_s)
            self._note("height", "tcp", float(place[2] - rules.min_height_m), at_s)
        for pair in self._teller.distances(joints) if self._teller is not None else ():
            if pair.second in self._obstacles:
                self._note(pair.second, pair.first, pair.distance_m, at_s)
            else:
                part = f"{pair.first} - {pair.second}"
                self._note("itself", part, pair.distance_m, at_s)

    def nearest(self) -> list[Nearest]:
        """The least distance to each thing that there is, the nearest first."""
        found = sorted(self._nearest.values(), key=lambda one: one.distance_m)
        return [one.model_copy(update={"distance_m": round(one.distance_m, 4)}) for one in found][
            :_MOST_NEAR
        ]

    def _note(self, to: str, part: str, distance_m: float, at_s: float) -> None:
        before = self._nearest.get(to)
        if np.isfinite(distance_m) and (before is None or distance_m < before.distance_m):
            self._nearest[to] = Nearest(
                to=to, part=part, distance_m=distance_m, at_s=round(at_s, 2)
            )


def outside_m(point_m: F64, box: Obstacle) -> float:
    """How far a point (3,) is from a box; negative inside, by the depth along the nearest face."""
    beyond = np.maximum(box.lower_m - point_m, point_m - box.upper_m)
    deepest = float(beyond.max())
    return deepest if deepest <= 0.0 else float(np.linalg.norm(np.maximum(beyond, 0.0)))

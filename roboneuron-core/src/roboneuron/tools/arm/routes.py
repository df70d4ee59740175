"""Sequences of poses and openings of a hand, carried out by the robot, a prediction or a twin."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from roboneuron.contract import Pose
from roboneuron.contract.arrays import F64
from roboneuron.contract.rotation import matrix_from_quaternion
from roboneuron.errors import RefusedError, RoboNeuronError, StateError
from roboneuron.server.rehearsal import DrivenArm, Rehearsal
from roboneuron.server.tool import CallContext
from roboneuron.tools.arm.absolute import go_to
from roboneuron.tools.arm.ee_move import MoveEndEffector
from roboneuron.tools.arm.end_effector import EndEffectorMover
from roboneuron.tools.arm.grip import Grip


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Waypoint:
    """One part of a route.

    Attributes:
        what: for messages.
        position_m: TCP (3,) in the base frame; None stays.
        rotation: (3, 3); None keeps the present one.
        opening: of the gripper, set when the TCP is there; None leaves it.
        holds: the hand must hold something afterwards.
        speed: further fraction of the speed of the call.
        done: what is so from then on, for errors of later parts.
    """

    what: str
    position_m: F64 | None = None
    rotation: F64 | None = None
    opening: float | None = None
    holds: bool = False
    speed: float = 1.0
    done: str = ""


class Carrier(Protocol):
    """What carries out parts of a route."""

    async def pose(self) -> tuple[F64, F64]:
        """Position (3,) and rotation (3, 3) of the TCP."""

    async def move(self, fields: dict[str, float]) -> None:
        """Make a move of move_ee."""

    def check_holds(self) -> None:
        """Raise StateError if the hand holds nothing."""


class RobotCarrier:
    """The robot, by move_ee on behalf of the caller.

    Attributes:
        highest_m_s: highest measured speed of the TCP so far [m/s]; None if not measured.
    """

    def __init__(self, mover: EndEffectorMover, context: CallContext) -> None:
        self._mover, self._context = mover, context
        self._stops = mover.stops
        self._holding: bool | None = None
        self.highest_m_s: float | None = None

    async def pose(self) -> tuple[F64, F64]:
        """See `Carrier`. Raises StateError after a stop: what is left is not made."""
        pose = await self._context.run(lambda _: self._mover.pose())
        self._check_not_stopped()
        return _parts(pose)

    def _check_not_stopped(self) -> None:
        if self._mover.stops != self._stops:
            raise StateError("The arm was stopped on its way; what is left is not made.")

    async def move(self, fields: dict[str, float]) -> None:
        """See `Carrier`. Raises RefusedError if nothing was moved, StateError after a stop."""
        self._check_not_stopped()
        moved = await self._mover(MoveEndEffector.model_validate(fields), self._context)
        if moved.simulated or not moved.allowed:
            raise RefusedError(
                f"The arm was not moved: {moved.reason or 'only simulated'}.", rule="simulate"
            )
        self._holding = moved.holding
        if moved.max_tcp_speed_m_s is not None:
            self.highest_m_s = max(moved.max_tcp_speed_m_s, self.highest_m_s or 0.0)

    def check_holds(self) -> None:
        """See `Carrier`; what the last move measured."""
        if self._holding is False:
            raise StateError("The hand holds nothing.", hint="Call look: where is the object now?")


class DrivenCarrier:
    """An arm that is computed or simulated."""

    def __init__(self, mover: EndEffectorMover, arm: DrivenArm) -> None:
        self._mover, self._arm = mover, arm
        self.took_s = 0.0

    async def pose(self) -> tuple[F64, F64]:
        """See `Carrier`."""
        return _parts(self._mover.pose_of(self._arm))

    async def move(self, fields: dict[str, float]) -> None:
        """See `Carrier`. Raises RefusedError if it does not get there."""
        order = self._mover.order(MoveEndEffector.model_validate(fields))
        for _ in self._mover.drive(order, self._arm):
            self.took_s += 0.1

    def check_holds(self) -> None:
        """See `Carrier`: an ideal hand holds."""


class _TwinCarrier(DrivenCarrier):
    """The arm of a twin, whose hand may close on nothing and which comes to rest after each
    part.
    """

    def __init__(self, mover: EndEffectorMover, rehearsal: Rehearsal, grip: Grip) -> None:
        super().__init__(mover, rehearsal.arm)
        self._twin_arm, self._grip, self._opening = rehearsal.arm, grip, grip.kept()

    async def move(self, fields: dict[str, float]) -> None:
        """See `Carrier`. The hand keeps the opening that the route gave it."""
        self._opening = fields.get("gripper_open", self._opening)
        await super().move({**fields, "gripper_open": self._opening})
        self._twin_arm.settle()

    def check_holds(self) -> None:
        """See `Carrier`."""
        if not self._grip.would_hold(self._twin_arm.joints(), self._opening):
            raise StateError("The hand closes on nothing.")


async def run_route(
    carrier: Carrier,
    route: Sequence[Waypoint],
    speed: float,
    fastest: tuple[float, float],
    reached: Callable[[Waypoint], object] = lambda _: None,
) -> None:
    """Carry out a route; `reached` is called after each part. Raises as the carrier, and as
    `go_to`; the hint says what is done.
    """
    done = ""
    for part in route:
        try:
            await _carry_out(carrier, part, speed * part.speed, fastest)
        except RoboNeuronError as error:
            raise error.with_hint(done) from error
        reached(part)
        done = part.done or done


async def _carry_out(
    carrier: Carrier, part: Waypoint, speed: float, fastest: tuple[float, float]
) -> None:
    if part.position_m is not None:
        await go_to(
            carrier.pose,
            carrier.move,
            part.position_m,
            part.rotation,
            what=part.what,
            speed=speed,
            fastest=fastest,
        )
    if part.opening is not None:
        await carrier.move({"gripper_open": part.opening})
    if part.holds:
        carrier.check_holds()


def rehearse(mover: EndEffectorMover, route: Sequence[Waypoint], speed: float) -> float:
    """Predict a route with control's controller and limits; return its duration [s].

    Raises:
        RefusedError: the arm would not get to its end, and why.
    """
    with closing(mover.predicted()) as arm:
        carrier = DrivenCarrier(mover, arm)
        asyncio.run(run_route(carrier, route, speed, mover.fastest))
        return carrier.took_s


def carry_out_in_twin(
    mover: EndEffectorMover,
    grip: Grip,
    rehearsal: Rehearsal,
    route: Sequence[Waypoint],
    speed: float,
) -> None:
    """Carry out a route in a twin. Raises as `Rehearsable.rehearse`."""
    carrier = _TwinCarrier(mover, rehearsal, grip)
    asyncio.run(run_route(carrier, route, speed, mover.fastest))
    rehearsal.arm.settle()


def _parts(pose: Pose) -> tuple[F64, F64]:
    return np.array(pose.position_m), matrix_from_quaternion(pose.quaternion_xyzw)


def now_ns() -> int:
    """System clock, with which pictures are stamped [ns]."""
    return time.time_ns()

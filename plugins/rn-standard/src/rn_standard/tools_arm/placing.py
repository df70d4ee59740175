"""Tool place: put down the held object next to its present place, in one call."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from pydantic import Field
from pydantic.json_schema import JsonSchemaValue

from rn_standard.direct_path.derived import Derived
from rn_standard.stepped.clock import CLOSED_METRIC
from rn_standard.tools_arm.arm_rows import of_named_arm
from rn_standard.tools_arm.ee_move import EndEffectorMove, MoveEndEffector
from rn_standard.tools_arm.end_effector import EndEffectorMover
from rn_standard.tools_arm.grip import Grip
from rn_standard.tools_arm.measured import MeasuredPose
from roboneuron import (
    Arguments,
    CallContext,
    Host,
    InvalidInputError,
    Pose,
    RefusedError,
    Result,
    RoboNeuronError,
    StateError,
    Tool,
)
from roboneuron.feature import ExposedEndpoint, MotionGate

log = logging.getLogger(__name__)
_CLEAR_M = 0.08
"""Height to which the held object is lifted above its place, to clear objects on the table."""
_GAP_M = 0.002
"""Height of the release above that of the grasp: the object is dropped slightly rather than pressed
into the table.
"""
_CLOSES = 0.05
"""Fraction of the travel: a smaller change of the commanded opening is not a grasp."""
_NEAR_M = 0.003
_LONGEST_M = 0.5


class PlaceArguments(Arguments):
    """Arguments of place."""

    arm: str = Field(default="", description="Arm that holds it.")
    dx_m: float = Field(default=0.0, ge=-0.5, le=0.5, description="Forwards from the hand [m].")
    dy_m: float = Field(default=0.0, ge=-0.5, le=0.5, description="To the left [m].")
    height_m: float | None = Field(
        default=None,
        ge=-1,
        le=2,
        description="TCP height at release; where the hand closed when omitted [m].",
    )


class Placed(Result):
    """The released object and its place."""

    robot: str
    arm: str = Field(default="", description="which of several arms")
    released_at_m: list[float] = Field(description="TCP when the hand opened, base frame")
    moved: dict[str, float] = Field(description="from where the hand was at the call")
    holding: bool | None = Field(description="the hand still holds something; null: unknown")
    took_s: float


class GripHeight(Grip):
    """Records the height of the TCP when the hand last closed, whatever command closed it."""

    def __init__(
        self,
        host: Host,
        gate: MotionGate,
        exposed: ExposedEndpoint,
        tcp: MeasuredPose,
        arm: str = "",
    ) -> None:
        super().__init__(host, gate, exposed, arm)
        self._tcp = tcp
        self._opening: float | None = None
        self._closed_at_m: float | None = None
        self._metric = f"{arm}/{CLOSED_METRIC}" if arm else CLOSED_METRIC

    @property
    def closed_at_m(self) -> float | None:
        """Height of the TCP [m]; None if not observed. In stepped time as control reports it."""
        is_own = self._exposed.namespace == self._host.config.namespace
        report = self._host.modules.view("control").report if is_own else None
        told = "" if report is None else report.metrics.get(self._metric, "")
        return float(told) if told else self._closed_at_m

    def watch(self) -> None:
        """Start observing; does nothing the second time."""
        if self._note not in self._tcp.listeners:
            self._tcp.listeners.append(self._note)
        try:
            self._tcp.open()
        except RoboNeuronError as error:  # reported by the tools that need the pose
            log.warning("%s", error)

    def _note(self, height_m: float) -> None:
        """Process a pose: record its height if a smaller opening was commanded since the
        last one.
        """
        before, now = self._opening, self.commanded()
        self._opening = now
        if now is not None and (1.0 if before is None else before) - now > _CLOSES:
            self._closed_at_m = height_m


@dataclass(frozen=True, kw_only=True, slots=True)
class PlaceRoute:
    """The moves of one call.

    Attributes:
        carry: with the object in the hand.
        release: opens the hand.
        leave: with the hand open.
    """

    carry: tuple[MoveEndEffector, ...]
    release: MoveEndEffector
    leave: tuple[MoveEndEffector, ...]


class Placer:
    """Moves with move_ee, which keeps the grip, and detects a lost object.

    Attributes:
        mover, grip: of the arm.
    """

    def __init__(self, mover: EndEffectorMover, grip: GripHeight) -> None:
        self.mover = mover
        self.grip = grip

    async def __call__(self, arguments: PlaceArguments, context: CallContext) -> Placed:
        """Lift, carry, lower, release, and retract upwards.

        Raises:
            RefusedError: the hand holds nothing, or as move_ee.
            InvalidInputError: the height of the release is unknown.
            StateError: the hand lost the object on the way.
        """
        began_s = time.monotonic()
        self.mover.check()
        await context.run(lambda _: self.check_holds())
        self.release_height_m(arguments)
        start = await context.run(lambda _: self.mover.pose())
        route = self.route(arguments, start)
        for move in route.carry:
            moved = await self.mover(move, context)
            _check(moved)
            if moved.holding is False:  # also what was lost between two moves
                raise StateError(
                    f"The hand has lost what it held, at {moved.position_m} m or before."
                )
        opened = await self.mover(route.release, context)
        for move in route.leave:
            _check(await self.mover(move, context))
        place, here = opened.position_m, start.position_m
        return Placed(
            robot=opened.robot,
            arm=opened.arm,
            released_at_m=place,
            moved={"dx_m": round(place[0] - here[0], 4), "dy_m": round(place[1] - here[1], 4)},
            holding=opened.holding,
            took_s=round(time.monotonic() - began_s, 3),
        )

    def check_holds(self) -> None:
        """Raise RefusedError for an empty hand, or none; waits until the fingers rest."""
        self.grip.check_fitted()
        if self.grip.holding() is False:
            raise RefusedError(
                "The hand holds nothing that could be put down.",
                hint="See get_status, robot.",
                rule="empty_hand",
            )

    def release_height_m(self, arguments: PlaceArguments) -> float:
        """Height of the TCP at the release. Raises InvalidInputError if it is unknown."""
        if arguments.height_m is not None:
            return arguments.height_m
        height_m = self.grip.closed_at_m
        if height_m is None:
            raise InvalidInputError(
                "It is not known how high the hand was when it closed.",
                hint="Give height_m: the height of the TCP at which to let go.",
                path="height_m",
            )
        return height_m + _GAP_M

    def route(self, arguments: PlaceArguments, start: Pose) -> PlaceRoute:
        """The moves of a call that begins with the TCP at `start`. Raises as `release_height_m`."""
        release_m = self.release_height_m(arguments)
        height_m = float(start.position_m[2])
        carry_m = max(height_m, release_m + _CLEAR_M)
        return PlaceRoute(
            carry=(
                *_pieces(dz_m=carry_m - height_m),
                *_pieces(dx_m=arguments.dx_m, dy_m=arguments.dy_m),
                *_pieces(dz_m=release_m - carry_m),
            ),
            release=MoveEndEffector(gripper_open=1.0),
            leave=tuple(_pieces(dz_m=_CLEAR_M)),
        )


def _pieces(**delta: float) -> Iterator[MoveEndEffector]:
    """One straight part, in pieces that move_ee accepts."""
    longest = max(abs(value) for value in delta.values())
    if longest < _NEAR_M:
        return
    count = int(longest / _LONGEST_M - 1e-9) + 1
    for _ in range(count):
        yield MoveEndEffector.model_validate({name: value / count for name, value in delta.items()})


def _check(moved: EndEffectorMove) -> None:
    """Raise RefusedError if nothing was moved."""
    if moved.simulated or not moved.allowed:
        raise RefusedError(
            f"The arm was not moved: {moved.reason or 'only simulated'}.", rule="simulate"
        )


class PlaceOfArm:
    """The handler of place for several arms."""

    def __init__(self, placers: Mapping[str, Placer]) -> None:
        self._placers = placers

    def of(self, arm: str) -> Placer:
        """The one of that arm. Raises InvalidInputError."""
        return of_named_arm(self._placers, arm)

    async def __call__(self, arguments: PlaceArguments, context: CallContext) -> Placed:
        """Raises as `Placer`; InvalidInputError also for an unknown arm or one without a
        gripper.
        """
        return await self.of(arguments.arm)(arguments, context)


def place_tool(
    movers: Mapping[str, EndEffectorMover], grips: Mapping[str, GripHeight], robot: str
) -> Tool[PlaceArguments]:
    """Create place for the arms that have a gripper.

    Args:
        movers: by arm, those without a gripper included.
        grips: by arm, for those with a gripper.
        robot: name of the robot.
    """
    placers = {arm: Placer(movers[arm], grip) for arm, grip in grips.items()}
    properties: dict[str, JsonSchemaValue] = {name: {} for name in PlaceArguments.model_fields}
    several = [*placers] != [""]
    if several:
        properties["arm"] = {"enum": [*placers]}
    else:
        del properties["arm"]
    return Tool(
        name="place",
        title="Put down what the hand holds",
        description=f"Carry what {robot!r} holds by dx_m, dy_m, lower it to where it was grasped, "
        "let go, rise. Stop the policy first; needs control.",
        arguments=Derived(
            model=PlaceArguments, properties=properties, required=["arm"] if several else []
        ),
        result=Placed,
        handler=PlaceOfArm(placers) if several else placers[""],
        simulated_by=frozenset({"twin"}),
        open_world=True,
    )

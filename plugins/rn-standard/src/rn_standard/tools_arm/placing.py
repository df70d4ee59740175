"""place: put down what the hand holds, beside where it is, as one call."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping

from pydantic import Field
from pydantic.json_schema import JsonSchemaValue

from rn_standard.direct_path.derived import Derived
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
    RefusedError,
    Result,
    RoboNeuronError,
    StateError,
    Tool,
)
from roboneuron.feature import ExposedEndpoint, MotionGate

log = logging.getLogger(__name__)
_CLEAR_M = 0.08
"""How far what is carried is lifted above where it stood, to pass over what stands on the table."""
_GAP_M = 0.002
"""It is let go so much above the height at which it was grasped: rather dropped than pressed into
the table.
"""
_CLOSES = 0.05
"""Share of the travel: a smaller change of the commanded opening is no grasp."""
_NEAR_M = 0.003
_LONGEST_M = 0.5


class PlaceArguments(Arguments):
    """Arguments of place."""

    arm: str = Field(default="", description="Whose hand holds it.")
    dx_m: float = Field(
        default=0.0, ge=-0.5, le=0.5, description="Forwards from where the hand is [m]."
    )
    dy_m: float = Field(default=0.0, ge=-0.5, le=0.5, description="To the left [m].")
    height_m: float | None = Field(
        default=None,
        ge=-1,
        le=2,
        description="TCP height at release; where the hand closed when omitted [m].",
    )


class Placed(Result):
    """What was let go, and where."""

    robot: str
    arm: str = Field(default="", description="which of several arms")
    released_at_m: list[float] = Field(description="TCP when the hand opened, base frame")
    moved: dict[str, float] = Field(description="from where the hand was at the call")
    holding: bool | None = Field(description="the hand still holds something; null: unknown")
    took_s: float


class GripHeight(Grip):
    """Knows how high the TCP was when the hand last closed, whoever closed it."""

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
        self.closed_at_m: float | None = None
        """Height of the TCP [m]; None when that was not seen."""

    def watch(self) -> None:
        """Look from now on; does nothing the second time."""
        if self._note not in self._tcp.listeners:
            self._tcp.listeners.append(self._note)
        try:
            self._tcp.open()
        except RoboNeuronError as error:  # told by the tools that need the pose
            log.warning("%s", error)

    def _note(self, height_m: float) -> None:
        """A pose came: was a smaller opening commanded than before?"""
        before, now = self._opening, self.commanded()
        self._opening = now
        if now is not None and (1.0 if before is None else before) - now > _CLOSES:
            self.closed_at_m = height_m


class _Placer:
    """Moves by move_ee, which keeps the grip, and notices what is lost on the way."""

    def __init__(self, mover: EndEffectorMover, grip: GripHeight) -> None:
        self._mover = mover
        self._grip = grip

    async def __call__(self, arguments: PlaceArguments, context: CallContext) -> Placed:
        """Lift, carry, lower, let go, and leave upwards.

        Raises:
            RefusedError: the hand holds nothing, or as move_ee.
            InvalidInputError: nobody knows how high to let go.
            StateError: the hand lost it on the way.
        """
        began_s = time.monotonic()
        self._mover.check()
        if await context.run(lambda _: self._grip.holding()) is False:
            raise RefusedError(
                "The hand holds nothing that could be put down.",
                hint="See get_status, robot.",
                rule="empty_hand",
            )
        height_m = self._grip.closed_at_m if arguments.height_m is None else arguments.height_m
        if height_m is None:
            raise InvalidInputError(
                "It is not known how high the hand was when it closed.",
                hint="Give height_m: the height of the TCP at which to let go.",
                path="height_m",
            )
        start = (await context.run(lambda _: self._mover.pose())).position_m
        release_m = height_m if arguments.height_m is not None else height_m + _GAP_M
        carry_m = max(float(start[2]), release_m + _CLEAR_M)
        await self._go(context, dz_m=carry_m - float(start[2]))
        await self._go(context, dx_m=arguments.dx_m, dy_m=arguments.dy_m)
        await self._go(context, dz_m=release_m - carry_m)
        opened = await self._mover(MoveEndEffector(gripper_open=1.0), context)
        place = opened.position_m
        await self._go(context, dz_m=_CLEAR_M)
        return Placed(
            robot=opened.robot,
            arm=opened.arm,
            released_at_m=place,
            moved={"dx_m": round(place[0] - start[0], 4), "dy_m": round(place[1] - start[1], 4)},
            holding=opened.holding,
            took_s=round(time.monotonic() - began_s, 3),
        )

    async def _go(self, context: CallContext, **delta: float) -> None:
        """One straight part, in pieces that move_ee takes."""
        longest = max(abs(value) for value in delta.values())
        if longest < _NEAR_M:
            return
        count = int(longest / _LONGEST_M - 1e-9) + 1
        for _ in range(count):
            part = {name: value / count for name, value in delta.items()}
            _check(await self._mover(MoveEndEffector.model_validate(part), context))


def _check(moved: EndEffectorMove) -> None:
    """Raise RefusedError when nothing was moved, and StateError when the hand has lost what it
    held.
    """
    if moved.dry_run or not moved.allowed:
        raise RefusedError(f"The arm was not moved: {moved.reason or 'dry run'}.", rule="dry_run")
    if moved.lost_on_the_way:
        raise StateError(f"The hand has lost what it held, at {moved.position_m} m or before.")


class _PlaceOfArm:
    """The handler of place for several arms."""

    def __init__(self, placers: Mapping[str, _Placer]) -> None:
        self._placers = placers

    async def __call__(self, arguments: PlaceArguments, context: CallContext) -> Placed:
        """Raises as `_Placer`; InvalidInputError also for an arm that is not there, or that has no
        gripper.
        """
        return await of_named_arm(self._placers, arguments.arm)(arguments, context)


def place_tool(
    movers: Mapping[str, EndEffectorMover], grips: Mapping[str, GripHeight], robot: str
) -> Tool[PlaceArguments]:
    """place, for the arms that have a gripper.

    Args:
        movers: of the arms by name, those without a gripper too.
        grips: of those with one.
        robot: its name.
    """
    placers = {arm: _Placer(movers[arm], grip) for arm, grip in grips.items()}
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
        "let go, leave "
        "upwards. Stop the policy first; needs control.",
        arguments=Derived(
            model=PlaceArguments, properties=properties, required=["arm"] if several else []
        ),
        result=Placed,
        handler=_PlaceOfArm(placers) if several else placers[""],
        open_world=True,
    )

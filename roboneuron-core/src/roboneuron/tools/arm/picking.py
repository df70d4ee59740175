"""Tool pick: grasp an object from above, and say what it did to others."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Annotated

import numpy as np
from pydantic import Field

from roboneuron.contract import Pose
from roboneuron.contract.locator import LocatedObject
from roboneuron.contract.rotation import matrix_from_quaternion
from roboneuron.errors import InvalidInputError, RefusedError, RoboNeuronError
from roboneuron.server.host import Host
from roboneuron.server.rehearsal import Needs, Rehearsal
from roboneuron.server.tool import Arguments, CallContext, Tool
from roboneuron.sight.looker import Looker, looker_of, seen_target
from roboneuron.sight.marks import CellLook, name_of, seen_names, told_name
from roboneuron.tools.arm.absolute import yaw_of
from roboneuron.tools.arm.bounds import refused_route
from roboneuron.tools.arm.displacement import Surroundings, displaced
from roboneuron.tools.arm.doubt import judged, planned
from roboneuron.tools.arm.end_effector import EndEffectorMover
from roboneuron.tools.arm.grasps import Grasp, boxes_of, grasps_of, route_to_grasp
from roboneuron.tools.arm.grip_height import GripHeight
from roboneuron.tools.arm.hand_space import UprightBox
from roboneuron.tools.arm.options import HandOptions
from roboneuron.tools.arm.routes import (
    RobotCarrier,
    Waypoint,
    carry_out_in_twin,
    now_ns,
    rehearse,
    run_route,
)
from roboneuron.tools.arm.several_arms import arguments_of, handler_of

_NEAR_M, _SAME_M = 0.01, 0.002
"""A position means the object that is nearest, at most so far, unless others are as near."""


class PickArguments(Arguments):
    """Arguments of pick."""

    arm: str = Field(default="", description="Which of several arms.")
    object: str = Field(default="", description="Name that look gives.")
    mark: int | None = Field(default=None, ge=1, description="Or a mark of your last look.")
    position_m: Annotated[list[float], Field(min_length=3, max_length=3)] | None = Field(
        default=None, description="Or where it is, base frame."
    )
    yaw_deg: float | None = Field(default=None, description="Of the hand; chosen if omitted.")
    speed: float = Field(default=1.0, gt=0.02, le=1, description="Fraction of the fastest.")


class Picked(Surroundings):
    """The grasp, base frame."""

    robot: str
    arm: str
    object: str
    grasped_at_m: list[float]
    yaw_deg: float
    holds: bool | None
    clearance_m: float | None = Field(description="of the hand from the nearest other object")
    took_s: float


class Picker:
    """The handler of pick for one arm; it moves by move_ee. Follows `Rehearsable`."""

    rehearsal_needs: Needs = frozenset({"control", "scene"})

    def __init__(
        self,
        host: Host,
        mover: EndEffectorMover,
        grip: GripHeight,
        hand: HandOptions,
        remember: Callable[[Grasp], None] | None = None,
    ) -> None:
        """Args:
        host: of the feature.
        mover, grip: of the arm.
        hand: measures.
        remember: called with the grasp of what the hand holds now.
        """
        self._host, self.mover, self.grip = host, mover, grip
        self._hand, self._remember = hand, remember

    async def __call__(self, arguments: PickArguments, context: CallContext) -> Picked:
        """Look, come down, grasp, lift, and look again.

        Raises:
            InvalidInputError: no such object, or several.
            RefusedError: it cannot be grasped, with the rule and the distance.
            NotReadyError: nothing can be seen or measured.
            StateError: the hand closed on nothing, or lost it.
        """
        began_s = time.monotonic()
        looker = looker_of(self._host)
        self.mover.check()
        before, grasp, route = await planned(
            lambda _: self.plan(arguments, looker, context.who),
            looker,
            self.mover,
            self.grip.arm,
            context,
        )
        carrier = RobotCarrier(self.mover, context)

        def reached(part: Waypoint) -> None:
            """Remember the grasp at once: what the hand holds is known if the lift ends early."""
            if part.opening == 0.0 and self._remember is not None:
                self._remember(grasp)

        await run_route(carrier, route, arguments.speed, self.mover.fastest, reached)
        since_ns = now_ns()
        after = await context.run(lambda _: looker.look(context.who, since_ns))
        others = displaced(before, after, grasp.object)
        far = np.isinf(grasp.clearance_m)
        return Picked(
            robot=self.mover.robot,
            arm=self.grip.arm,
            object=name_of(grasp.object),
            grasped_at_m=np.round(grasp.position_m, 4).tolist(),
            yaw_deg=round(float(np.degrees(grasp.yaw_rad)), 1),
            holds=await context.run(lambda _: self.grip.holding()),
            clearance_m=None if far else round(grasp.clearance_m, 4),
            **others.model_dump(exclude_unset=True),
            max_tcp_speed_m_s=carrier.highest_m_s,
            took_s=round(time.monotonic() - began_s, 3),
        )

    def rehearse(self, arguments: PickArguments, rehearsal: Rehearsal) -> None:
        """See `Rehearsable`. The first route only: what would be seen after it is not known."""
        start, looker = self.mover.pose_of(rehearsal.arm), looker_of(self._host)
        _, _, route = self.plan(arguments, looker, rehearsal.context.who, start)
        carry_out_in_twin(self.mover, self.grip, rehearsal, route, arguments.speed)

    def plan(
        self, arguments: PickArguments, looker: Looker, who: str, start: Pose | None = None
    ) -> tuple[CellLook, Grasp, list[Waypoint]]:
        """Look, and plan the grasp and the route from `start`, the measured pose if None.
        Raises as `__call__`.
        """
        self.grip.check_fitted()
        if self.grip.holding():
            raise RefusedError(
                f"The hand holds {self.grip.held_name} already.",
                hint="Call place first.",
                rule="full_hand",
            )
        look, one = target_of(arguments, looker, who)
        yaw = None if arguments.yaw_deg is None else float(np.radians(arguments.yaw_deg))
        others = [other for other in look.objects if other is not one]
        here = self.mover.pose() if start is None else start
        present = yaw_of(matrix_from_quaternion(here.quaternion_xyzw))
        refusal: RoboNeuronError | None = None
        route: list[Waypoint] = []
        for grasp in judged(
            lambda seen: grasps_of(one, boxes_of(seen), self._hand, present, yaw), others
        ):
            route = route_to_grasp(grasp, here, boxes_of(others))
            try:
                rehearse(self.mover, route, arguments.speed)
            except RoboNeuronError as error:
                refusal = refusal or error
                continue
            return look, grasp, route
        assert refusal is not None
        subject = f"{told_name(one)} at {np.round(one.position_m, 3).tolist()} m"
        raise refused_route(self._host, subject, route, refusal) from refusal


def target_of(arguments: PickArguments, looker: Looker, who: str) -> tuple[CellLook, LocatedObject]:
    """A new look, and the object in it that a call means. Raises as `seen_target`."""
    if arguments.position_m is None:
        return seen_target(looker, who, arguments.object, arguments.mark)
    if arguments.object or arguments.mark is not None:
        raise InvalidInputError("Give one of object, mark and position_m.", path="position_m")
    look = looker.look(who)
    place = np.array(arguments.position_m)
    away_m = [UprightBox.of(one).distance_m(place) for one in look.objects]
    most_m = min(_NEAR_M, min(away_m, default=0.0) + _SAME_M)
    near = [one for one, far in zip(look.objects, away_m, strict=True) if far <= most_m]
    if len(near) == 1:
        return look, near[0]
    told = f"{len(near)} objects are" if near else "No object is"
    raise InvalidInputError(
        f"{told} seen within {_NEAR_M * 100:.0f} cm of {arguments.position_m}.",
        hint=f"Seen: {seen_names(look.objects)}.",
        path="position_m",
    )


def pick_tool(
    host: Host,
    movers: Mapping[str, EndEffectorMover],
    grips: Mapping[str, GripHeight],
    hand: HandOptions,
    robot: str,
    remember: Callable[[str, Grasp], None],
) -> Tool[PickArguments]:
    """Create pick for the arms that have a gripper; `remember` is called with the arm and what its
    hand holds now.
    """
    pickers = {
        arm: Picker(host, movers[arm], grip, hand, partial(remember, arm))
        for arm, grip in grips.items()
    }
    return Tool(
        name="pick",
        title="Grasp an object from above",
        description=f"Grasp an object from above with {robot!r} and lift it; looks before and "
        "after.",
        arguments=arguments_of(PickArguments, pickers),
        result=Picked,
        handler=handler_of(pickers),
        simulated_by=frozenset({"twin"}),
        open_world=True,
    )

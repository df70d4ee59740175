"""Plans of place: arguments, a look, and the route of what the hand holds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from roboneuron.contract import Pose
from roboneuron.contract.locator import LocatedObject
from roboneuron.contract.rotation import matrix_from_quaternion
from roboneuron.errors import InvalidInputError, NotReadyError, RefusedError, RoboNeuronError
from roboneuron.server.host import Host
from roboneuron.server.tool import Arguments
from roboneuron.sight.looker import Looker, looker_of
from roboneuron.sight.marks import CellLook, name_of, told_name
from roboneuron.tools.arm.absolute import yaw_of
from roboneuron.tools.arm.bounds import check_near, refused_route
from roboneuron.tools.arm.doubt import check_seen_well, judged
from roboneuron.tools.arm.end_effector import EndEffectorMover
from roboneuron.tools.arm.grip_height import GripHeight
from roboneuron.tools.arm.options import HandOptions
from roboneuron.tools.arm.put_down import (
    Descent,
    HeldObject,
    PlaceTarget,
    Side,
    beside,
    descents_of,
    held_in_view,
    others_than,
    route_down,
    target_object,
)
from roboneuron.tools.arm.routes import Waypoint, rehearse


class PlaceArguments(Arguments):
    """Arguments of place."""

    arm: str = Field(default="", description="Arm that holds it.")
    dx_m: float = Field(default=0.0, ge=-0.5, le=0.5, description="Forwards from the hand [m].")
    dy_m: float = Field(default=0.0, ge=-0.5, le=0.5, description="To the left [m].")
    position_m: Annotated[list[float], Field(min_length=2, max_length=2)] | None = Field(
        default=None, description="Of the object, x and y in the base frame."
    )
    on: str = Field(default="", description="Name, or mark N.")
    beside: str = Field(default="", description="Likewise.")
    side: Side = Field(default="+y", description="Its face that points there most.")
    gap_m: float = Field(default=0.03, ge=0, le=0.3, description="To it.")
    yaw_deg: float | None = Field(default=None, description="Of the hand.")
    speed: float = Field(default=1.0, gt=0.02, le=1, description="Fraction of the fastest.")
    height_m: float | None = Field(
        default=None,
        ge=-1,
        le=2,
        description="TCP height at release; found when omitted [m].",
    )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PlacePlan:
    """A planned absolute place.

    Attributes:
        look: before it.
        held, descent, route: what, where and how.
        start: of the TCP.
        target: the object beside which it is put; None otherwise.
    """

    look: CellLook
    held: HeldObject
    descent: Descent
    route: tuple[Waypoint, ...]
    start: Pose
    target: LocatedObject | None = None


def plan_place(
    host: Host | None,
    mover: EndEffectorMover,
    grip: GripHeight,
    hand: HandOptions,
    arguments: PlaceArguments,
    who: str,
    start: Pose | None,
) -> PlacePlan | None:
    """Look, and plan an absolute place from `start`, the measured pose if None. None for one
    that is relative to the hand, of something that was not grasped by pick.

    Raises:
        InvalidInputError: the target makes no sense.
        RefusedError: it cannot be put there, with the rule and the distance.
        NotReadyError: nothing can be seen or measured.
    """
    given = arguments.given()
    absolute = [name for name in ("position_m", "on", "beside") if given.get(name)]
    shifts = [name for name in ("dx_m", "dy_m") if given.get(name)]
    if len(absolute) > 1 or (absolute and shifts):
        told = " and ".join([*absolute, *shifts])
        raise InvalidInputError(f"The call gives {told}; give one target.", path=absolute[0])
    if arguments.position_m is not None:
        check_near(np.array(arguments.position_m), "position_m")
    is_found = grip.held is not None and arguments.height_m is None
    if not absolute and not is_found:
        return None
    if host is None:
        raise NotReadyError("Nothing looks at the cell here.")
    looker = looker_of(host)
    pose = mover.pose() if start is None else start
    look = looker.look(who)
    held = grip.held or held_in_view(look, pose)
    if held is None:
        raise NotReadyError(
            "How the object lies in the hand is not known: it was not grasped by pick, and is "
            "not seen in the hand.",
            hint="Move the hand to where the cameras see it, or place it by dx_m and dy_m with "
            "height_m.",
        )
    yaw = yaw_of(matrix_from_quaternion(pose.quaternion_xyzw))
    target = _target(arguments, looker, who, held, pose, yaw)
    others = others_than(looker.last_look(who) or look, held, pose)
    width_m = grip.measured() * hand.gap_m
    found = judged(
        lambda seen: descents_of(target, held, seen, looker.table_m, yaw, hand, width_m), others
    )
    refusal: RoboNeuronError | None = None
    route: list[Waypoint] = []
    for descent in found:
        if arguments.height_m is not None:
            place = np.array([*descent.position_m[:2], arguments.height_m])
            descent = replace(descent, position_m=place)
        route = route_down(descent, held, pose, others, looker.table_m)
        try:
            rehearse(mover, route, arguments.speed)
        except RoboNeuronError as error:
            refusal = refusal or error
            continue
        return PlacePlan(
            look=look,
            held=held,
            descent=descent,
            route=tuple(route),
            start=pose,
            target=target.beside,
        )
    assert refusal is not None
    raise refused_route(host, "The place", route, refusal) from refusal


def _other(
    looker: Looker, who: str, name: str, path: str, held: HeldObject, pose: Pose
) -> LocatedObject:
    """The object that `on` or `beside` names, seen well.

    Raises:
        RefusedError: it is what the hand holds, or is not seen well.
        InvalidInputError, NotReadyError: as `target_object`.
    """
    itself = RefusedError(
        f"The hand holds {told_name(held.object)} itself: it cannot be put {path} itself.",
        hint="Name another object of look, or give dx_m and dy_m, or position_m.",
        rule="in_hand",
    )
    try:
        look, one = target_object(looker, who, name, path)
    except InvalidInputError:
        words = name.casefold().split()
        if words and set(words) <= set(name_of(held.object).casefold().split()):
            raise itself from None
        raise
    if one not in others_than(look, held, pose):
        raise itself
    check_seen_well(one)
    return one


def _target(
    arguments: PlaceArguments,
    looker: Looker,
    who: str,
    held: HeldObject,
    pose: Pose,
    yaw_rad: float,
) -> PlaceTarget:
    asked = None if arguments.yaw_deg is None else float(np.radians(arguments.yaw_deg))
    if arguments.on:
        one = _other(looker, who, arguments.on, "on", held, pose)
        target = PlaceTarget(middle=one.position_m[:2], yaw_rad=one.yaw_rad, on=one)
    elif arguments.beside:
        one = _other(looker, who, arguments.beside, "beside", held, pose)
        target = beside(one, held, arguments.side, arguments.gap_m, yaw_rad)
    elif arguments.position_m is not None:
        target = PlaceTarget(middle=np.array(arguments.position_m))
    else:
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        here = pose.position_m[:2] + np.array([[c, -s], [s, c]]) @ held.offset_m
        target = PlaceTarget(middle=here + np.array([arguments.dx_m, arguments.dy_m]))
    if asked is None:
        return target
    return replace(target, yaw_rad=asked, is_hand_yaw=True)

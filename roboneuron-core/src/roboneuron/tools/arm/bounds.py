"""Routes that are refused before anything moves, and which limit forbids a place, by its edge."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from roboneuron.contract.arrays import F64
from roboneuron.errors import InvalidInputError, RefusedError, RoboNeuronError
from roboneuron.server.host import Host
from roboneuron.tools.arm.end_effector import EndEffectorMover
from roboneuron.tools.arm.routes import Waypoint, rehearse
from roboneuron.tools.arm.several_arms import OfArm

__all__ = ["check_targets"]
"""Names that other distributions may use."""

_AXES = ("x", "y", "z")
_PLAY_M = 5e-4
_FAR_M = 10.0
"""Farther from the base than any arm reaches."""
LOOSEN = "A person can loosen them (loosen_limits, or: roboneuron robot limits --loosen)."


def check_near(place_m: F64, path: str) -> None:
    """Raise InvalidInputError for a place (2,) or (3,) that no arm reaches, or that is no number;
    `path` is the argument.
    """
    if not (np.abs(place_m) <= _FAR_M).all():
        raise InvalidInputError(
            f"{path} is {place_m.tolist()}, more than {_FAR_M:g} m from the base.",
            hint="Give a place within reach of the arm, in the base frame [m]: see look.",
            path=path,
        )


def check_route(
    host: Host, mover: EndEffectorMover, subject: str, route: Sequence[Waypoint], speed: float
) -> None:
    """Predict a route from where the arm is measured; arguments as of `refused_route`. Raises
    RefusedError unless the arm would get to its end, InvalidInputError as `check_near`.
    """
    for part in route:
        if part.position_m is not None:
            check_near(part.position_m, "position_m")
    try:
        rehearse(mover, route, speed)
    except RoboNeuronError as error:
        raise refused_route(host, subject, route, error) from error


def check_targets(
    host: Host, arm: str, targets: Sequence[F64], rotation: F64 | None, *, what: str, speed: float
) -> None:
    """Check straight motions of the TCP, one after the other from where it is measured; blocks, and
    moves nothing. Nothing is checked where move_ee is not the tool of this package.

    Args:
        host: of the feature.
        arm: name of one of several arms.
        targets: places (3,) in the base frame [m].
        rotation: (3, 3) at all of them; None keeps the present one.
        what: the target, for messages.
        speed: fraction of the fastest.

    Raises:
        RefusedError, InvalidInputError: as `check_route`.
    """
    tool = host.tools.get("move_ee")
    handler = None if tool is None else tool.handler
    mover = handler.of(arm) if isinstance(handler, OfArm) else handler
    if isinstance(mover, EndEffectorMover):
        route = [
            Waypoint(what=f"the target {what}", position_m=target, rotation=rotation)
            for target in targets
        ]
        check_route(host, mover, "The motion", route, speed)


def refused_route(
    host: Host, subject: str, route: Iterable[Waypoint], refusal: RoboNeuronError
) -> RefusedError:
    """The refusal of a route: by the limit that one of its places is outside of, else because the
    arm does not get there.

    Args:
        host: with the limits in force.
        subject: what is out of reach.
        route: that was predicted.
        refusal: of the prediction.
    """
    for part in route:
        told = None if part.position_m is None else outside(host, part.position_m)
        if told:
            is_tightened = host.modules.tightened is not None
            return RefusedError(
                f"{subject} is not allowed: {part.what} is at {told}.",
                hint=LOOSEN if is_tightened else "See get_status, or the configuration.",
                rule="workspace",
            )
    return RefusedError(
        f"{subject} is out of reach from this posture; nothing has moved. As simulated: "
        f"{refusal.message}",
        hint="Choose a place that this reason leaves free, or begin from another posture.",
        rule="out_of_reach",
    )


def outside(host: Host, place_m: F64) -> str:
    """By which limit the TCP must not be at a place (3,), with its edge; empty if it may."""
    limits = host.loop.limits
    edges = ((limits.workspace_lower_m, 1.0, ">="), (limits.workspace_upper_m, -1.0, "<="))
    for corner, sign, relation in edges:
        for axis, at_m, edge_m in zip(_AXES, place_m.tolist(), corner or (), strict=False):
            if sign * (at_m - edge_m) < -_PLAY_M:
                return f"{axis} = {at_m:.3f} m, and the TCP stays at {axis} {relation} {edge_m:g} m"
    for zone in limits.zones:
        if (np.array(zone.lower_m) < place_m).all() and (place_m < np.array(zone.upper_m)).all():
            box = f"{list(zone.lower_m)} to {list(zone.upper_m)}"
            return f"{np.round(place_m, 3).tolist()} m, in the box {box} that the TCP stays out of"
    return ""

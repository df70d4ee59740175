"""Motion limits and the reaction to each: from the configuration, never wider than the robot's
profile.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from roboneuron.config import LimitsConfig, Reaction
from roboneuron.contract import (
    F64,
    CollisionProfile,
    Controller,
    JointSample,
    Obstacle,
    Pose,
    Posture,
    PostureInspector,
    RobotProfile,
    SeveralArms,
    Workspace,
)
from roboneuron.errors import ConfigurationError

LIMITS = (
    "position",
    "velocity",
    "acceleration",
    "step",
    "speed",
    "workspace",
    "zone",
    "height",
    "singularity",
    "collision",
)
"""Names of the limits in the configuration (`on_<name>`), in counters and in reports."""

_TIGHTER = {
    "velocity_fraction": -1.0,
    "acceleration_fraction": -1.0,
    "max_step_m": -1.0,
    "max_step_rad": -1.0,
    "max_speed_m_s": -1.0,
    "max_turn_rad_s": -1.0,
    "workspace_lower_m": 1.0,
    "workspace_upper_m": -1.0,
    "min_height_m": 1.0,
    "min_singular_value": 1.0,
}
"""Numbers that may be tightened at run time: upwards (1) or downwards (-1)."""
FAR_M = 100.0
"""Farther than any arm reaches."""
_EVERYWHERE = Workspace(lower_m=np.full(3, -np.inf), upper_m=np.full(3, np.inf))


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class MotionRules:
    """Limits and reactions; infinite without a limit.

    Attributes:
        reactions: "hold", "scale" or "refuse" by limit.
        velocity_fraction, acceleration_fraction: fractions of the joints' limits in use.
        max_step_m, max_step_rad: largest displacement of one command from the measured TCP.
        max_speed_m_s, max_turn_rad_s: fastest motion of the TCP.
        lower_m, upper_m: workspace box of the TCP, float64 (3,), base frame.
        min_height_m: lowest z of the TCP, base frame.
        zones: boxes that the TCP must not enter.
        arm_zones: boxes that no moving link, and nothing held, must enter, each with the name of
            its limit.
        min_singular_value: smallest allowed distance from a singularity.
        collision: bodies that the arm must not touch; None if not checked.
    """

    reactions: Mapping[str, Reaction]
    velocity_fraction: float = 1.0
    acceleration_fraction: float = 1.0
    max_step_m: float = np.inf
    max_step_rad: float = np.inf
    max_speed_m_s: float = np.inf
    max_turn_rad_s: float = np.inf
    lower_m: F64 = field(default_factory=lambda: _EVERYWHERE.lower_m)
    upper_m: F64 = field(default_factory=lambda: _EVERYWHERE.upper_m)
    min_height_m: float = -np.inf
    zones: tuple[Obstacle, ...] = ()
    arm_zones: tuple[tuple[str, Obstacle], ...] = ()
    min_singular_value: float = 0.0
    collision: CollisionProfile | None = None


def motion_rules(config: LimitsConfig, profile: RobotProfile) -> MotionRules:
    """Compute the rules for one robot.

    Args:
        config: the limits of the configuration, or tighter ones.
        profile: its workspace bounds the configured one.

    Raises:
        ConfigurationError: a box is empty, a workspace is wider than the profile's, or see
            `collision_of`.
    """
    widest = profile.workspace or _EVERYWHERE
    lower, upper, least_m = config.workspace_lower_m, config.workspace_upper_m, config.min_height_m
    beyond_box: tuple[tuple[str, Obstacle], ...] = ()
    if config.applies_to == "arm":
        beyond_box = tuple(faces(lower, upper, least_m))
        lower = upper = least_m = None
    workspace = _box(
        "workspace",
        "the TCP's",
        widest.lower_m if lower is None else lower,
        widest.upper_m if upper is None else upper,
    )
    if (workspace.lower_m < widest.lower_m).any() or (workspace.upper_m > widest.upper_m).any():
        raise ConfigurationError(
            f"limits.workspace {workspace.lower_m.tolist()} .. {workspace.upper_m.tolist()} m is "
            f"wider than that of robot {profile.name!r}, {widest.lower_m.tolist()} .. "
            f"{widest.upper_m.tolist()} m; limits can only be tightened."
        )
    return MotionRules(
        reactions={name: getattr(config, f"on_{name}") for name in LIMITS},
        velocity_fraction=config.velocity_fraction,
        acceleration_fraction=config.acceleration_fraction,
        max_step_m=config.max_step_m,
        max_step_rad=config.max_step_rad,
        max_speed_m_s=config.max_speed_m_s,
        max_turn_rad_s=config.max_turn_rad_s,
        lower_m=workspace.lower_m,
        upper_m=workspace.upper_m,
        min_height_m=-np.inf if least_m is None else least_m,
        zones=tuple(
            _box("zones", zone.name, zone.lower_m, zone.upper_m)
            for zone in config.zones
            if zone.applies_to == "tcp"
        ),
        arm_zones=(
            *beyond_box,
            *(
                ("zone", _box("zones", zone.name, zone.lower_m, zone.upper_m))
                for zone in config.zones
                if zone.applies_to == "arm"
            ),
        ),
        min_singular_value=config.min_singular_value,
        collision=collision_of(config, profile),
    )


def check_tighter(limits: LimitsConfig, configured: LimitsConfig) -> None:
    """Refuse limits that allow anything which the configured ones do not.

    Every key is checked. One without an order, such as a reaction, must stay unchanged, and a newly
    added key is refused until its direction is declared in `_TIGHTER`.

    Args:
        limits: requested by a client.
        configured: set by the person responsible for the robot.

    Raises:
        ConfigurationError: names the first key that is wider.
    """
    for key, sign in _TIGHTER.items():
        value, bound = getattr(limits, key), getattr(configured, key)
        if bound is not None and (
            value is None or (np.asarray(value) * sign < np.asarray(bound) * sign).any()
        ):
            raise ConfigurationError(
                f"limits.{key} = {value} is wider than {bound}; limits can only be tightened."
            )
    if any(zone not in limits.zones for zone in configured.zones):
        raise ConfigurationError(
            "limits.zones lacks a configured zone; limits can only be tightened."
        )
    for key in LimitsConfig.model_fields:
        if (
            key not in _TIGHTER
            and key != "zones"
            and getattr(limits, key) != getattr(configured, key)
        ):
            raise ConfigurationError(f"limits.{key} cannot be changed while the robot runs.")


def collision_of(config: LimitsConfig, profile: RobotProfile) -> CollisionProfile | None:
    """Return the profile's collision bodies with the configured distance and obstacles; None if not
    checked.

    Raises:
        ConfigurationError: an obstacle is not a box, or the distance is shorter than the robot's.
    """
    given, least_m, obstacles = profile.collision, config.min_distance_m, config.obstacles
    if not config.collision or (given is None and least_m is None and obstacles is None):
        return None
    if given is not None and least_m is not None and least_m < given.min_distance_m:
        raise ConfigurationError(
            f"limits.min_distance_m = {least_m:g} is less than the {given.min_distance_m:g} m of "
            f"robot {profile.name!r}; limits can only be tightened."
        )
    made = given or CollisionProfile()
    if least_m is not None:
        made = replace(made, min_distance_m=least_m)
    if obstacles is not None:
        boxes = tuple(_box("obstacles", box.name, box.lower_m, box.upper_m) for box in obstacles)
        made = replace(made, obstacles=boxes)
    return made


def inspector_of(controller: Controller) -> Callable[[JointSample], Posture]:
    """Return the function that evaluates postures of a controller's arm, with at least the TCP
    pose.
    """
    if isinstance(controller, PostureInspector):
        return controller.inspect
    return lambda joints: Posture(pose=controller.forward(joints))


def poses_of(controller: Controller) -> Callable[[JointSample], tuple[Pose, ...]]:
    """Return the function that computes the TCP pose of each arm."""
    if isinstance(controller, SeveralArms):
        return controller.poses
    return lambda joints: (controller.forward(joints),)


def faces(
    lower_m: Iterable[float] | None, upper_m: Iterable[float] | None, least_m: float | None
) -> Iterator[tuple[str, Obstacle]]:
    """What lies beyond each face of a box, and below a height, with the name of the limit."""
    sides = [("workspace", lower_m, ">="), ("workspace", upper_m, "<=")]
    for limit, corner, relation in sides:
        for axis, edge_m in enumerate(() if corner is None else corner):
            if abs(edge_m) < FAR_M:
                yield limit, beyond(axis, relation, edge_m)
    if least_m is not None and abs(least_m) < FAR_M:
        yield "height", beyond(2, ">=", least_m)


def beyond(axis: int, relation: str, edge_m: float) -> Obstacle:
    """The space on the forbidden side of a plane.

    Args:
        axis: 0, 1 or 2.
        relation: ">=" or "<=": what is allowed.
        edge_m: coordinate of the plane.
    """
    lower, upper = np.full(3, -FAR_M), np.full(3, FAR_M)
    (upper if relation == ">=" else lower)[axis] = edge_m
    return Obstacle(name=f"{'xyz'[axis]} {relation} {edge_m:g} m", lower_m=lower, upper_m=upper)


def _box(key: str, name: str, lower_m: ArrayLike, upper_m: ArrayLike) -> Obstacle:
    """Create a box of `[limits]`.

    Args:
        key: its key in the configuration.
        name: its own name.
        lower_m, upper_m: opposite corners (3,) in the base frame.

    Raises:
        ConfigurationError: it is empty; interchanged corners would forbid nothing.
    """
    box = Obstacle(name=name, lower_m=np.array(lower_m), upper_m=np.array(upper_m))
    if not (box.lower_m < box.upper_m).all():
        ends = f"{box.lower_m.tolist()} to {box.upper_m.tolist()}"
        raise ConfigurationError(f"limits.{key}: {name!r} reaches from {ends} m, which is no box.")
    return box

"""A home posture: free of contact, away from limits and singularities, found by trying many."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from roboneuron import (
    F64,
    CollisionProfile,
    ConfigurationError,
    ControllerSpec,
    JointSample,
    Obstacle,
    Posture,
    PostureInspector,
    Proximity,
    RobotProfile,
    matrix_from_quaternion,
)
from roboneuron.command import discover
from roboneuron.feature import loading

CONTROLLER = "urdf"
"""The controller that tells distances; the written configuration names it too."""
FLOOR = Obstacle(
    name="floor", lower_m=np.array([-2.0, -2.0, -2.0]), upper_m=np.array([2.0, 2.0, -0.001])
)
"""What an arm is taken to stand on, in its base frame."""
FEWEST_FOR_POSE = 6
"""An arm with fewer joints follows places, and lets rotations go where they must."""
_POSTURES, _ROUNDS = 300, 4
_STEP_RAD = 0.2
_WIDEST = 2.2
"""Farthest from 0 that a joint stands at home [rad]: elbows fold, cables do not wind up."""
_MARGIN = 0.1
"""Share of its range that a joint keeps from either limit."""
SEEN_M = 0.1
"""Distances are known up to here."""
_CLEAR_M, _REGULAR = 0.05, 0.1
"""Distance and smallest singular value beyond which a posture is not better still."""

_Seen: TypeAlias = tuple[F64, Posture, set[tuple[str, str]]]
"""A posture that was tried, what the controller tells of it, and the pairs that touch."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Home:
    """A posture to start from.

    Attributes:
        position: by joint [rad or m], float64 (n,).
        nearest: pairs of bodies nearer than `SEEN_M`, the nearest first.
        overlapping: pairs of links that touch in every posture, so that nothing compares them.
        tcp_m: float64 (3,), where the TCP is, in the base frame.
        has_floor: a floor below the base is one of the bodies.
        unchecked: why distances are not compared; empty if they are.
    """

    position: F64
    nearest: tuple[Proximity, ...]
    overlapping: tuple[tuple[str, str], ...]
    tcp_m: F64
    has_floor: bool
    unchecked: str = ""

    @property
    def min_distance_m(self) -> float:
        """Least distance that the arm shall keep: 10 mm, or half of what it has at home."""
        here_m = self.nearest[0].distance_m if self.nearest else SEEN_M
        return min(CollisionProfile().min_distance_m, math.floor(500.0 * here_m) / 1000.0)


def find_home(profile: RobotProfile, given: Sequence[float] = ()) -> Home:
    """The best of many random postures of an arm, the same at each call.

    Args:
        profile: of the arm, with limits and without a home posture.
        given: a posture, by joint [rad or m], that is to be taken; empty: one is searched for.

    Raises:
        ConfigurationError: the controller is not installed or refuses the arm, no posture is free
            of contact, or the given one is not or is outside the limits; names the links.
    """
    wanted = _checked(profile, given) if given else None
    if not _has_shapes(profile):
        return _unchecked(profile, "its moving links have no collision shapes", wanted)
    seen = _look(_comparing(profile, FLOOR))
    if (home := _best_free(_comparing(profile, FLOOR), seen, wanted)) is not None:
        return home
    try:
        seen = _look(_comparing(profile))
    except ConfigurationError as error:  # the floor was all that its links could touch
        return _unchecked(profile, error.message, wanted)
    if (home := _best_free(_comparing(profile), seen, wanted)) is not None:
        return home
    if wanted is not None:
        touching = sorted(_seen(_load(_comparing(profile)), profile, wanted)[2])
        raise ConfigurationError(
            f"At the home {list(given)} of {profile.name!r} "
            f"{', '.join(f'{first} and {second}' for first, second in touching)} touch."
        )
    often = Counter(pair for _, _, touching in seen for pair in touching).most_common(3)
    raise ConfigurationError(
        f"None of {_POSTURES} postures of {profile.name!r} is free of contact; most often "
        f"{', '.join(f'{first} and {second}' for (first, second), _ in often)} touch.",
        hint="Correct the collision shapes of these links, or leave the shapes of one out.",
    )


def _checked(profile: RobotProfile, given: Sequence[float]) -> F64:
    """The given posture, float64 (n,). Raises ConfigurationError if it does not fit the joints."""
    limits = profile.limits
    assert limits is not None
    position = np.array(given, dtype=np.float64)
    if len(position) != len(profile.arm_joints):
        raise ConfigurationError(
            f"The home of {profile.name!r} has {len(position)} values; its joints are "
            f"{', '.join(profile.arm_joints)}."
        )
    is_outside = (position < limits.lower) | (position > limits.upper)
    outside = [name for name, out in zip(profile.arm_joints, is_outside, strict=True) if out]
    if outside:
        raise ConfigurationError(
            f"The home of {profile.name!r} is outside the limits of {', '.join(outside)}."
        )
    return position


def _comparing(profile: RobotProfile, *obstacles: Obstacle) -> RobotProfile:
    collision = CollisionProfile(min_distance_m=SEEN_M, obstacles=obstacles)
    return replace(profile, collision=collision)


def _has_shapes(profile: RobotProfile) -> bool:
    """Whether a link that a joint moves has a collision shape."""
    moved = {_child(joint) for joint in _elements(profile, "joint") if joint.get("type") != "fixed"}
    shaped = {
        link.get("name")
        for link in _elements(profile, "link")
        if link.find("collision") is not None
    }
    return bool(moved & shaped)


def _elements(profile: RobotProfile, name: str) -> list[ElementTree.Element]:
    return ElementTree.fromstring(profile.urdf).findall(name)


def _child(joint: ElementTree.Element) -> str | None:
    child = joint.find("child")
    return None if child is None else child.get("link")


def _unchecked(profile: RobotProfile, why: str, wanted: F64 | None) -> Home:
    profile = replace(profile, collision=None)
    return replace(_best(profile, _look(profile), set(), wanted), unchecked=why)


def _best_free(profile: RobotProfile, seen: list[_Seen], wanted: F64 | None) -> Home | None:
    """The best posture, or the wanted one, without contact, but for pairs of links that touch in
    all; None without one.
    """
    always = set.intersection(*(touching for _, _, touching in seen))
    obstacles = {body.name for body in profile.collision.obstacles} if profile.collision else set()
    free = [found for found in seen if found[2] <= always]
    if not free or any(obstacles & {*pair} for pair in always):
        return None
    home = _best(profile, free, always, wanted)
    return None if home.nearest and home.nearest[0].distance_m <= 0.0 else home


def _load(profile: RobotProfile) -> PostureInspector:
    spec = discover().get(ControllerSpec, CONTROLLER)
    is_short = len(profile.arm_joints) < FEWEST_FOR_POSE
    options = loading.load_options(spec, {"track": "position"} if is_short else {})
    target = loading.load_target(spec)
    assert callable(target), "a rule of controllers"
    controller = target(options, profile)
    controller.load()
    assert isinstance(controller, PostureInspector)
    return controller


def _look(profile: RobotProfile) -> list[_Seen]:
    """Random postures, and what touches there."""
    controller = _load(profile)
    rng = np.random.default_rng(0)
    choices = _choices(profile)
    found = []
    for _ in range(_POSTURES):
        position = np.array([rng.choice(values) for values in choices])
        found.append(_seen(controller, profile, position))
    return found


def _seen(controller: PostureInspector, profile: RobotProfile, position: F64) -> _Seen:
    names = profile.arm_joints
    full = position
    if profile.gripper is not None:
        names = (*names, profile.gripper.joint)
        full = np.append(position, profile.gripper.open_position)
    posture = controller.inspect(JointSample(names=names, position=full))
    near = posture.near or ()
    touching = {(pair.first, pair.second) for pair in near if pair.distance_m <= 0.0}
    return position, posture, touching


def _best(
    profile: RobotProfile, seen: list[_Seen], always: set[tuple[str, str]], wanted: F64 | None
) -> Home:
    """The best of some postures, improved by one joint at a time, or the wanted one."""
    controller = _load(profile)

    def near(posture: Posture) -> list[Proximity]:
        pairs = [pair for pair in posture.near or () if (pair.first, pair.second) not in always]
        return sorted(pairs, key=lambda pair: pair.distance_m)

    def worth(found: _Seen) -> float:
        position, posture, touching = found
        if not touching <= always:
            return -math.inf
        lacking = [1.0 - min(pair.distance_m, _CLEAR_M) / _CLEAR_M for pair in near(posture)]
        return _worth(position, posture) - 2.0 * sum(lacking)

    best = _seen(controller, profile, wanted) if wanted is not None else max(seen, key=worth)
    for _ in range(_ROUNDS if wanted is None else 0):
        before = best
        for joint, values in enumerate(_choices(profile)):
            for value in values:
                position = best[0].copy()
                position[joint] = value
                best = max(best, _seen(controller, profile, position), key=worth)
        if best is before:
            break
    position, posture, _ = best
    return Home(
        position=position,
        nearest=tuple(near(posture)),
        overlapping=tuple(sorted(always)),
        tcp_m=posture.pose.position_m,
        has_floor=bool(profile.collision and profile.collision.obstacles),
    )


def _choices(profile: RobotProfile) -> list[F64]:
    """Positions of each joint at which it may stand at home: steps from 0 away from its limits."""
    limits = profile.limits
    assert limits is not None
    found = []
    for joint, lower, upper in zip(
        profile.arm_joints, limits.lower.tolist(), limits.upper.tolist(), strict=True
    ):
        if joint in profile.kinds.prismatic:
            found.append(lower + (upper - lower) * np.linspace(_MARGIN, 1.0 - _MARGIN, 9))
            continue
        margin = _MARGIN * (upper - lower) if math.isfinite(upper - lower) else 0.0
        low, high = lower + margin, upper - margin
        if low < _WIDEST and high > -_WIDEST:
            low, high = max(low, -_WIDEST), min(high, _WIDEST)
        steps = _STEP_RAD * np.arange(math.ceil(low / _STEP_RAD), high // _STEP_RAD + 1)
        found.append(np.round(steps, 6) if len(steps) else np.array([(low + high) / 2.0]))
    return found


def _worth(position: F64, posture: Posture) -> float:
    """How good a posture is: regular, the tool forwards, above the base and pointing down, joints
    near 0, each in 0 .. 1.
    """
    pose = posture.pose
    x, z = float(pose.position_m[0]), float(pose.position_m[2])
    reach_m = max(float(np.linalg.norm(pose.position_m)), 1e-6)
    down = -float(matrix_from_quaternion(pose.quaternion_xyzw)[2, 2])
    near_zero = 1.0 - float(np.mean(np.minimum(np.abs(position), _WIDEST))) / _WIDEST
    forwards = (1.0 + x / reach_m) / 2.0
    above = 1.0 if z > 0.1 * reach_m else 0.0
    regular = min(posture.smallest_singular_value or 0.0, _REGULAR) / _REGULAR
    return 2.0 * regular + forwards + above + (1.0 + down) / 2.0 + near_zero

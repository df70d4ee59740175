"""Limits of the TCP (step, speed, workspace, zones, height) and of the posture (singularity,
collision).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from roboneuron.contract import F64, Obstacle, Pose, Posture
from roboneuron.errors import UnsafeError
from roboneuron.gate.motion.rules import MotionRules, faces


class PlaceViolation(NamedTuple):
    """A limit of place or posture that a path violates.

    Attributes:
        limit: its name, from `LIMITS`.
        reason: sentence with the numbers.
        depth: how far beyond the limit its end is [m; of "singularity": of the singular value]; 0
            if only the line to it is.
    """

    limit: str
    reason: str
    depth: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Motion:
    """Numeric properties of one command.

    Attributes:
        step_m, step_rad: distance from the measured TCP to the commanded one.
        speed_m_s, turn_rad_s: TCP speed from the posture commanded so far to the commanded one.
        joint_speed: velocity of the fastest joint [rad/s or m/s].
        smallest_singular_value: at the end of the step; None if the controller cannot compute it.
    """

    step_m: float
    step_rad: float
    speed_m_s: float
    turn_rad_s: float
    joint_speed: float
    smallest_singular_value: float | None = None


def largest(motions: Sequence[Motion]) -> Motion:
    """Combine the motions of several arms: the largest of each number, the smallest
    singular value.
    """
    if len(motions) == 1:
        return motions[0]
    values = [motion.smallest_singular_value for motion in motions]
    return Motion(
        step_m=max(motion.step_m for motion in motions),
        step_rad=max(motion.step_rad for motion in motions),
        speed_m_s=max(motion.speed_m_s for motion in motions),
        turn_rad_s=max(motion.turn_rad_s for motion in motions),
        joint_speed=max(motion.joint_speed for motion in motions),
        smallest_singular_value=min((v for v in values if v is not None), default=None),
    )


_PLAY_M = 1e-6
"""A link that stays as deep in a zone as it was, but for rounding, does not keep the others from
leading the arm out.
"""


@dataclass(frozen=True, slots=True, eq=False)
class TaskSpace:
    """Limits on the positions of the TCP and the links, for actions and joint motions;
    stateless.
    """

    _rules: MotionRules

    def motion(
        self, measured: Pose, start: Pose, end: Posture, duration_s: float, joint_speed: float
    ) -> Motion:
        """Return the properties of a command from the measured TCP, the TCP commanded so far, and
        the TCP at its end.

        Raises:
            UnsafeError: one of them is not finite.
        """
        motion = Motion(
            step_m=distance_m(measured, end.pose),
            step_rad=angle_rad(measured, end.pose),
            speed_m_s=distance_m(start, end.pose) / duration_s,
            turn_rad_s=angle_rad(start, end.pose) / duration_s,
            joint_speed=joint_speed,
            smallest_singular_value=end.smallest_singular_value,
        )
        sum_of_all = (
            motion.step_m
            + motion.step_rad
            + motion.speed_m_s
            + motion.turn_rad_s
            + motion.joint_speed
        )
        if not math.isfinite(sum_of_all + (motion.smallest_singular_value or 0.0)):
            raise UnsafeError(f"A command leads to numbers that are not finite: {motion}.")
        return motion

    def excess(self, motion: Motion) -> Iterator[tuple[str, float, str]]:
        """Limits of step and speed that `motion` violates: name, ratio of value to limit,
        reason.
        """
        rules = self._rules
        for name, value, most, unit in (
            ("step", motion.step_m, rules.max_step_m, "m"),
            ("step", motion.step_rad, rules.max_step_rad, "rad"),
            ("speed", motion.speed_m_s, rules.max_speed_m_s, "m/s"),
            ("speed", motion.turn_rad_s, rules.max_turn_rad_s, "rad/s"),
        ):
            if value > most:
                by = "at " if name == "speed" else ""
                yield (
                    name,
                    value / most,
                    f"The TCP would move {by}{value:.4g} {unit}, allowed is {most:g} {unit}.",
                )

    def places(
        self, start: Pose, end: Posture, evaluate_start: Callable[[], Posture]
    ) -> Iterator[PlaceViolation]:
        """Limits of place and posture that the path between two postures violates.

        Args:
            start: TCP at the start of the path.
            end: end of the path.
            evaluate_start: returns the posture at the start; called only if needed.

        Paths that lead out of a forbidden place are allowed.
        """
        rules = self._rules
        start_m, end_m = start.position_m, end.pose.position_m
        outside = _depth_outside_m(end_m, rules.lower_m, rules.upper_m)
        if _is_worse(outside, _depth_outside_m(start_m, rules.lower_m, rules.upper_m)):
            at = np.round(end_m, 4).tolist()
            edges = " and ".join(
                face.name
                for _, face in faces(rules.lower_m, rules.upper_m, None)
                if _depth_outside_m(end_m, face.lower_m, face.upper_m) < 0.0
            )
            where = f"outside the workspace, at {at} m; allowed is {edges or 'less'}."
            yield PlaceViolation("workspace", f"The TCP would be {outside:.4f} m {where}", outside)
        too_low_m = float(rules.min_height_m - end_m[2])
        if _is_worse(too_low_m, rules.min_height_m - start_m[2]):
            reason = f"a height of {end_m[2]:.4f} m, allowed is {rules.min_height_m:g} m."
            yield PlaceViolation("height", f"The TCP would be at {reason}", too_low_m)
        for zone in rules.zones:
            if _breaks_zone(zone, start_m, end_m):
                at = np.round(end_m, 4).tolist()
                depth_m = max(0.0, -_depth_outside_m(end_m, zone.lower_m, zone.upper_m))
                deep = f", {whole_mm(depth_m)} mm deep." if depth_m else "."
                reason = f"The TCP would enter {zone.name!r} on its way to {at} m{deep}"
                yield PlaceViolation("zone", reason, depth_m)
        least, singular = rules.min_singular_value, end.smallest_singular_value
        if singular is not None and singular < least:
            before = evaluate_start().smallest_singular_value or 0.0
            if _is_worse(least - singular, least - before):
                reason = (
                    f"The smallest singular value would be {singular:.4f}, allowed is {least:g}."
                )
                yield PlaceViolation("singularity", reason, least - singular)
        yield from self.links(end, evaluate_start)

    def links(
        self, end: Posture, evaluate_start: Callable[[], Posture]
    ) -> Iterator[PlaceViolation]:
        """Limits that the links violate in a posture; arguments as of `places`."""
        yield from self._collisions(end, evaluate_start)
        if not self._rules.arm_zones:
            return
        found = self.protrusions(end)
        if not found:
            return
        start = evaluate_start()
        before = {} if start is end else self.protrusions(start)
        for (link, name), (limit, depth_m) in found.items():
            if (link, name) in before and depth_m <= before[link, name][1] + _PLAY_M:
                continue
            is_face = " <= " in name or " >= " in name
            where = f"beyond {name}" if is_face else f"in {name!r}"
            reason = f"{link} would be {whole_mm(depth_m)} mm {where}."
            yield PlaceViolation(limit, reason, depth_m)

    def protrusions(self, posture: Posture) -> dict[tuple[str, str], tuple[str, float]]:
        """How deep [m] each link is in each zone of the whole arm, and the name of the limit, by
        link and zone.

        Raises:
            UnsafeError: the controller does not tell where the links are.
        """
        zones = self._rules.arm_zones
        if not zones:
            return {}
        if posture.extents is None:
            raise UnsafeError(
                "the controller does not tell where the links are; see applies_to in [limits]"
            )
        links = posture.extents()
        lower_m = np.stack([zone.lower_m for _, zone in zones])
        upper_m = np.stack([zone.upper_m for _, zone in zones])
        into_m = np.minimum(
            links.upper_m[:, np.newaxis] - lower_m, upper_m - links.lower_m[:, np.newaxis]
        ).min(axis=2)
        return {
            (links.names[link], zones[zone][1].name): (zones[zone][0], float(into_m[link, zone]))
            for link, zone in np.argwhere(into_m > 0.0).tolist()
        }

    @property
    def judges_links(self) -> bool:
        """True if limits hold for the whole arm."""
        return bool(self._rules.arm_zones)

    def _collisions(
        self, end: Posture, evaluate_start: Callable[[], Posture]
    ) -> Iterator[PlaceViolation]:
        """Pairs of bodies that are too close in a posture and not farther apart than at the start
        of the path; arguments as of `places`.
        """
        if not end.near:
            return
        start_distances_m = {
            (pair.first, pair.second): pair.distance_m for pair in evaluate_start().near or ()
        }
        for pair in end.near:
            if pair.distance_m <= start_distances_m.get((pair.first, pair.second), pair.least_m):
                reason = (
                    f"{pair.first} and {pair.second} would be {pair.distance_m * 1e3:.1f} mm "
                    f"apart, at least {pair.least_m * 1e3:g} mm are required."
                )
                yield PlaceViolation("collision", reason, pair.least_m - pair.distance_m)


def whole_mm(depth_m: float) -> int:
    """A depth [mm], rounded up but for a micrometre."""
    return math.ceil(round(depth_m * 1e3, 3))


def distance_m(start: Pose, end: Pose) -> float:
    """Distance of two TCP positions."""
    return math.dist(start.position_m.tolist(), end.position_m.tolist())


def angle_rad(start: Pose, end: Pose) -> float:
    """Angle of the rotation between two TCP orientations, 0 .. pi.

    cos(a/2) is the absolute value of the quaternions' product, because q and -q are one
    orientation.
    """
    cosine = abs(float(np.dot(start.quaternion_xyzw, end.quaternion_xyzw)))
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    return 2.0 * math.atan2(sine, cosine)


def _depth_outside_m(point_m: F64, lower_m: F64, upper_m: F64) -> float:
    """Distance of a point (3,) from a box along the worst axis; negative inside."""
    return float(np.maximum(lower_m - point_m, point_m - upper_m).max())


def _is_worse(end: float, start: float) -> bool:
    """Return True if a path ends inside a forbidden place (depth > 0) without leading out of it.

    Args:
        end, start: depths [m, or the unit of the limit]. A path that ends less deep is allowed;
            otherwise an arm in a forbidden place could never leave it.
    """
    return end > 0.0 and end >= start


def _breaks_zone(zone: Obstacle, start_m: F64, end_m: F64) -> bool:
    """Return True if the line between two points (3,) enters the box, or starts in it without
    leading out.
    """
    start_depth = -_depth_outside_m(start_m, zone.lower_m, zone.upper_m)
    if start_depth > 0.0:
        return -_depth_outside_m(end_m, zone.lower_m, zone.upper_m) >= start_depth
    # slab test: the range of the line within which it is inside the box along every axis
    enter, leave = 0.0, 1.0
    axes = zip(
        start_m.tolist(), end_m.tolist(), zone.lower_m.tolist(), zone.upper_m.tolist(), strict=True
    )
    for begin, end, low, high in axes:
        displacement = end - begin
        if displacement == 0.0:
            if not low < begin < high:
                return False
            continue
        near, far = sorted(((low - begin) / displacement, (high - begin) / displacement))
        enter, leave = max(enter, near), min(leave, far)
        if enter >= leave:
            return False
    return True

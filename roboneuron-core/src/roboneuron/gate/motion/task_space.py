"""Limits of the TCP: step, speed, workspace, zones, height; and of the posture: singularity, collision."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from roboneuron.contract import Pose, Posture
from roboneuron.errors import UnsafeError
from roboneuron.gate.motion.boxes import angle_rad, breaks_zone, depth_outside_m, distance_m, is_worse
from roboneuron.gate.motion.rules import MotionRules
from roboneuron.gate.motion.verdict import Motion

_RESERVE = 0.98
"""Share of a Cartesian step or speed aimed at when shortening: joint space bends the straight line a little."""


class TaskSpace:
    """Checks of where a command leads; stateless."""

    def __init__(self, rules: MotionRules) -> None:
        self._rules = rules

    def motion(self, measured: Pose, start: Pose, end: Posture, duration_s: float, joint_speed: float) -> Motion:
        """One command in numbers: measured TCP, TCP commanded so far, TCP at the end of the command.

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
        sum_of_all = motion.step_m + motion.step_rad + motion.speed_m_s + motion.turn_rad_s + motion.joint_speed
        if not np.isfinite(sum_of_all + (motion.smallest_singular_value or 0.0)):
            raise UnsafeError(f"A command leads to numbers that are not finite: {motion}.")
        return motion

    def pace(self, motion: Motion) -> Iterator[tuple[str, float, str]]:
        """Limits of step and speed that `motion` breaks: name, share of it that would be allowed, reason."""
        rules = self._rules
        for name, value, most, unit in (
            ("step", motion.step_m, rules.max_step_m, "m"),
            ("step", motion.step_rad, rules.max_step_rad, "rad"),
            ("speed", motion.speed_m_s, rules.max_speed_m_s, "m/s"),
            ("speed", motion.turn_rad_s, rules.max_turn_rad_s, "rad/s"),
        ):
            if value > most:
                yield (
                    name,
                    _RESERVE * most / value,
                    f"The TCP would move {value:.4g} {unit}, allowed is {most:g} {unit}.",
                )

    def places(self, here: Pose, there: Posture, look_here: Callable[[], Posture]) -> Iterator[tuple[str, str]]:
        """Limits of place and posture that the way from one posture to another breaks: name, reason.

        Args:
            here: TCP at the start of the way.
            there: end of the way.
            look_here: the posture at the start; asked for only when it matters.

        Ways out of where the arm must not be are allowed.
        """
        rules = self._rules
        start, end = here.position_m, there.pose.position_m
        outside = depth_outside_m(end, rules.lower_m, rules.upper_m)
        if is_worse(outside, depth_outside_m(start, rules.lower_m, rules.upper_m)):
            yield (
                "workspace",
                f"The TCP would be {outside:.4f} m outside the workspace, at {np.round(end, 4).tolist()} m.",
            )
        if is_worse(rules.min_height_m - end[2], rules.min_height_m - start[2]):
            yield "height", f"The TCP would be at a height of {end[2]:.4f} m, allowed is {rules.min_height_m:g} m."
        for zone in rules.zones:
            if breaks_zone(zone, start, end):
                yield "zone", f"The TCP would enter {zone.name!r} on its way to {np.round(end, 4).tolist()} m."
        least, singular = rules.min_singular_value, there.smallest_singular_value
        if singular is not None and singular < least:
            before = look_here().smallest_singular_value or 0.0
            if is_worse(least - singular, least - before):
                yield "singularity", f"The smallest singular value would be {singular:.4f}, allowed is {least:g}."
        for reason in self.collisions(there, look_here):
            yield "collision", reason

    def collisions(self, there: Posture, look_here: Callable[[], Posture]) -> Iterator[str]:
        """Pairs that are too near in a posture and no farther apart than at the start of the way."""
        if not there.near:
            return
        start_m = {(pair.first, pair.second): pair.distance_m for pair in look_here().near or ()}
        for pair in there.near:
            if pair.distance_m <= start_m.get((pair.first, pair.second), pair.least_m):
                yield (
                    f"{pair.first} and {pair.second} would be {pair.distance_m * 1e3:.1f} mm apart, at least "
                    f"{pair.least_m * 1e3:g} mm are required."
                )

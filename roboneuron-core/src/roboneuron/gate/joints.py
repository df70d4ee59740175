"""Joint limits for JointTrajectory and JointState commands: names, positions, velocities, times, the first step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from roboneuron.contract import JointSample, RobotProfile
from roboneuron.errors import RefusedError
from roboneuron.gate.motion.joint_space import braking_velocity

TOLERANCE = 1e-6
"""Relative; limits are printed and parsed as decimals on the way."""
MAX_POINTS = 2000
JOINT_TYPES = ("trajectory_msgs/msg/JointTrajectory", "sensor_msgs/msg/JointState")
"""Messages that can be checked."""


@dataclass(frozen=True, kw_only=True, slots=True)
class JointLimit:
    """Limits of one joint in rad or m, per s, per s^2, and Nm or N; infinite where the profile has none.

    Attributes:
        braking: offset and deceleration of a joint that is slower near a position limit; None for others.
    """

    lower: float
    upper: float
    velocity: float
    acceleration: float
    effort: float
    braking: tuple[float, float] | None = None

    def fastest(self, start: float, end: float) -> float:
        """Fastest velocity of a step from `start` to `end`, so that the joint can brake before its limit after it."""
        if self.braking is None:
            return self.velocity
        return min(
            self.velocity, braking_velocity(self.upper - end if end > start else end - self.lower, *self.braking)
        )


def joint_limits(profile: RobotProfile) -> dict[str, JointLimit]:
    """Limits by joint name: the arm's, and the gripper's travel."""
    found: dict[str, JointLimit] = {}
    if profile.limits is not None:
        arrays = profile.limits
        for i, name in enumerate(profile.arm_joints):
            found[name] = JointLimit(
                lower=float(arrays.lower[i]),
                upper=float(arrays.upper[i]),
                velocity=float(arrays.velocity[i]),
                acceleration=float(arrays.acceleration[i]),
                effort=float(arrays.effort[i]),
                braking=None
                if arrays.braking_offset is None or arrays.braking_deceleration is None
                else (float(arrays.braking_offset[i]), float(arrays.braking_deceleration[i])),
            )
    if profile.gripper is not None:
        ends = sorted((profile.gripper.closed_position, profile.gripper.open_position))
        free = float("inf")
        found[profile.gripper.joint] = JointLimit(
            lower=ends[0], upper=ends[1], velocity=free, acceleration=free, effort=free
        )
    return found


def check_joints(
    profile: RobotProfile, messages: Sequence[Any], joints: JointSample | None, durations_s: Sequence[float] = ()
) -> None:
    """Raise unless the arm can follow the commands, one after the other, within its limits.

    A trajectory must reach each point with the joints' own velocities. The first step begins where the joints are
    measured, that of each further command where the one before ends.

    Args:
        profile: the robot's.
        messages: JointTrajectory or JointState.
        joints: newest measured joints.
        durations_s: how long each command lasts [s]; without, JointState is not checked for how fast it is reached.

    Raises:
        RefusedError: says which joint, what was asked, what is allowed.
    """
    limits = joint_limits(profile)
    before = joints
    for index, message in enumerate(messages):
        lasts_s = durations_s[index] if durations_s else None
        try:
            if hasattr(message, "points"):
                _check_trajectory(limits, message, before)
                _check_time(message, lasts_s)
            else:
                _check_state(limits, message, before, lasts_s)
        except RefusedError as error:
            if len(messages) == 1:
                raise
            raise RefusedError(f"steps[{index}]: {error.message}", hint=error.hint) from error
        if index + 1 < len(messages):
            before = _after(message, before, lasts_s)


def _check_time(trajectory: Any, lasts_s: float | None) -> None:
    last = trajectory.points[-1].time_from_start
    needed_s = last.sec + last.nanosec * 1e-9
    if lasts_s is not None and lasts_s < needed_s * (1.0 - TOLERANCE):
        raise RefusedError(f"The trajectory takes {needed_s:g} s, its step only {lasts_s:g} s.")


def _check_state(
    limits: dict[str, JointLimit], message: Any, before: JointSample | None, lasts_s: float | None
) -> None:
    """A JointState: its values, and that positions can be reached or velocities be kept for as long as it lasts."""
    names = _check_names(limits, message.name)
    if not (len(message.position) or len(message.velocity)):
        raise RefusedError("The joint command holds neither positions nor velocities.")
    _check_arrays(limits, names, message.position, message.velocity, (), message.effort, "")
    if lasts_s is None:
        return
    for name, start, end in zip(names, _measured(names, before), _targets(message, before, lasts_s), strict=True):
        limit = limits[name]
        if not limit.lower - TOLERANCE <= end <= limit.upper + TOLERANCE:
            raise RefusedError(
                f"{name} would be at {end:.4g} after {lasts_s:g} s, allowed is {limit.lower:.4g} .. {limit.upper:.4g}."
            )
        _check_pace(limit, name, start, end, lasts_s, "")


def _targets(message: Any, before: JointSample | None, lasts_s: float) -> list[float]:
    """Where the joints of a JointState are when it has lasted that long."""
    if len(message.position):
        return [float(value) for value in message.position]
    starts = _measured(message.name, before)
    return [start + float(velocity) * lasts_s for start, velocity in zip(starts, message.velocity, strict=True)]


def _after(message: Any, before: JointSample | None, lasts_s: float | None) -> JointSample | None:
    """The joints when a command has ended; `before` holds those that it does not name."""
    if before is None:
        return None
    if hasattr(message, "points"):
        names, ends = list(message.joint_names), [float(value) for value in message.points[-1].positions]
    else:
        names, ends = list(message.name), _targets(message, before, lasts_s or 0.0)
    known = dict(zip(before.names, before.position.tolist(), strict=True)) | dict(zip(names, ends, strict=True))
    return JointSample(names=tuple(known), position=np.array(list(known.values())), stamp_ns=before.stamp_ns)


def _check_pace(limit: JointLimit, name: str, start: float, end: float, within_s: float, where: str) -> None:
    needed = abs(end - start) / within_s if within_s > 0.0 else 0.0
    allowed = limit.fastest(start, end)
    if needed > allowed * (1.0 + TOLERANCE):
        near = " so near to its limit" if allowed < limit.velocity else ""
        raise RefusedError(
            f"{where}{name} would move at {needed:.4g} per second, allowed is {allowed:.4g}{near}.",
            hint="Give the step more time." if allowed > 0.0 else "Stay farther from the limit.",
        )


def _check_names(limits: dict[str, JointLimit], names: Sequence[str]) -> Sequence[str]:
    if not names:
        raise RefusedError("The joint command names no joints.")
    unknown = [name for name in names if name not in limits]
    if unknown:
        raise RefusedError(f"Joint {unknown[0][:60]!r} is unknown, the robot has {', '.join(limits)}.")
    if len(set(names)) != len(names):
        raise RefusedError("The joint command names a joint twice.")
    return names


def _check_arrays(
    limits: dict[str, JointLimit], names: Sequence[str],
    position: Any, velocity: Any, acceleration: Any, effort: Any, where: str,
) -> None:  # fmt: skip
    for word, values in (
        ("position", position),
        ("velocity", velocity),
        ("acceleration", acceleration),
        ("effort", effort),
    ):
        if len(values) not in (0, len(names)):
            raise RefusedError(f"{where}{word} has {len(values)} values for {len(names)} joints.")
        for name, value in zip(names, values, strict=False):
            limit = limits[name]
            high = limit.upper if word == "position" else getattr(limit, word)
            low = limit.lower if word == "position" else -high
            slack = TOLERANCE * max(1.0, abs(low), abs(high)) if high < float("inf") else 0.0
            if not low - slack <= value <= high + slack:
                raise RefusedError(f"{where}{word} of {name} is {value:.4g}, allowed is {low:.4g} .. {high:.4g}.")


def _check_trajectory(limits: dict[str, JointLimit], message: Any, joints: JointSample | None) -> None:
    names = _check_names(limits, message.joint_names)
    if not 1 <= len(message.points) <= MAX_POINTS:
        raise RefusedError(f"The trajectory has {len(message.points)} points, allowed is 1 .. {MAX_POINTS}.")
    before, before_s = _measured(names, joints), 0.0
    for index, point in enumerate(message.points):
        where = f"points[{index}]: "
        if len(point.positions) != len(names):
            raise RefusedError(f"{where}{len(point.positions)} positions for {len(names)} joints.")
        _check_arrays(limits, names, point.positions, point.velocities, point.accelerations, point.effort, where)
        at_s = point.time_from_start.sec + point.time_from_start.nanosec * 1e-9
        if not (at_s > before_s or (index == 0 and at_s == 0.0 and _is_same(before, point.positions))):
            raise RefusedError(f"{where}time_from_start is {at_s:g} s, expected more than {before_s:g} s.")
        for name, start, end in zip(names, before, point.positions, strict=True):
            _check_pace(limits[name], name, start, end, at_s - before_s, where)
        before, before_s = list(point.positions), at_s


def _measured(names: Sequence[str], joints: JointSample | None) -> list[float]:
    if joints is None:
        raise RefusedError(
            "The joints were not measured yet, so that the first step cannot be checked.", hint="Start the robot first."
        )
    known = dict(zip(joints.names, joints.position, strict=True))
    missing = [name for name in names if name not in known]
    if missing:
        raise RefusedError(f"Joint {missing[0]!r} is not among the measured ones, so that the step cannot be checked.")
    return [float(known[name]) for name in names]


def _is_same(before: Sequence[float], positions: Sequence[float]) -> bool:
    """A first point at time 0 may only repeat where the joints are, within a milliradian or millimetre."""
    return all(abs(a - b) <= 1e-3 for a, b in zip(before, positions, strict=True))

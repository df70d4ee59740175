"""Joint limits for JointTrajectory and JointState commands: names, positions, velocities, accelerations, times."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from roboneuron.contract import JointSample
from roboneuron.errors import RefusedError
from roboneuron.gate.acceleration import Speeds, shortest_s
from roboneuron.gate.fields import is_message, type_name_of
from roboneuron.gate.joint_limits import JointLimit
from roboneuron.gate.motion.path import Leg

TOLERANCE = 1e-6
"""Relative; limits are printed and parsed as decimals on the way."""
MAX_POINTS = 2000
JOINT_TYPES = ("trajectory_msgs/msg/JointTrajectory", "sensor_msgs/msg/JointState")
"""Messages that can be checked."""


def joint_commands(message: Any) -> Iterator[Any]:
    """The joint commands in a message, goal or request: itself, or those that it holds at any depth."""
    if type_name_of(message) in JOINT_TYPES:
        yield message
        return
    for name in message.get_fields_and_field_types():
        value = getattr(message, name)
        for item in value if isinstance(value, list | tuple) else (value,):
            if is_message(item):
                yield from joint_commands(item)


def check_joints(
    limits: Mapping[str, JointLimit],
    messages: Sequence[Any],
    joints: JointSample | None,
    durations_s: Sequence[float] = (),
) -> list[Leg]:
    """Raise unless the joints can follow the commands, one after the other, within their limits; return their way.

    A trajectory must reach each point with the joints' own velocities and accelerations, and rest at the end of the
    last command. The first step begins where the joints are measured, as fast as they are measured; that of each
    further command where the one before ends.

    Args:
        limits: by joint.
        messages: JointTrajectory or JointState.
        joints: newest measured joints.
        durations_s: how long each command lasts [s]; without, JointState is not checked for how fast it is reached.

    Raises:
        RefusedError: says which joint, what was asked, what is allowed.
    """
    before = joints
    motion = _Motion(limits, joints)
    legs: list[Leg] = []
    for index, message in enumerate(messages):
        lasts_s = durations_s[index] if durations_s else None
        step = f"steps[{index}]: " if len(messages) > 1 else ""
        try:
            if hasattr(message, "points"):
                made = _check_trajectory(limits, message, before)
                _check_time(message, lasts_s)
            else:
                made = _check_state(limits, message, before, lasts_s)
            is_steady = _is_velocity(message)
            motion.go(made, before, is_steady=is_steady)
            is_last = index + 1 == len(messages)
            if not is_steady and (is_last or (lasts_s or 0.0) > sum(leg.duration_s or 0.0 for leg in made)):
                motion.end(made, before)
        except RefusedError as error:
            raise RefusedError(f"{step}{error.message}", hint=error.hint) from error
        legs += [replace(leg, where=f"{step}{leg.where}") for leg in made]
        if index + 1 < len(messages):
            before = _after(message, before, lasts_s)
    return legs


class _Motion:
    """Which velocities the joints can have after the commands so far: accelerations that these imply."""

    def __init__(self, limits: Mapping[str, JointLimit], joints: JointSample | None) -> None:
        self._limits = limits
        self._speeds: dict[str, Speeds] = {}
        if joints is not None and joints.velocity is not None:
            for name, velocity in zip(joints.names, joints.velocity.tolist(), strict=True):
                if np.isfinite(velocity):
                    self._speeds[name] = Speeds(velocity, velocity)

    def go(self, legs: Sequence[Leg], before: JointSample | None, *, is_steady: bool) -> None:
        """Follow a command's legs; raises RefusedError for a joint that cannot."""
        starts: dict[str, float] = {}
        for leg in legs:
            if not leg.duration_s:
                continue
            starts = starts or dict(zip(leg.names, _measured(leg.names, before), strict=True))
            for index, name in enumerate(leg.names):
                limit, end = self._limits[name], float(leg.position[index])
                old = self._speeds.get(name, Speeds(0.0, 0.0))
                distance = end - starts[name]
                starts[name] = end
                if is_steady:
                    mean = distance / leg.duration_s
                    room = limit.acceleration * leg.duration_s * (1.0 + TOLERANCE)
                    new = Speeds(mean, mean) if old.low - room <= mean <= old.high + room else None
                else:
                    new = old.after(distance, leg.duration_s, limit.acceleration, limit.velocity)
                    if new is not None and leg.velocity is not None:
                        new = new.at(float(leg.velocity[index]), TOLERANCE)
                if new is None:
                    raise _too_hard(leg.where, name, limit, distance)
                self._speeds[name] = new

    def end(self, legs: Sequence[Leg], before: JointSample | None) -> None:
        """The joints rest after the last leg, unless it states a velocity; raises as `go`."""
        if not legs or not legs[-1].duration_s or legs[-1].velocity is not None:
            return
        last = legs[-1]
        starts = _measured(last.names, before) if len(legs) == 1 else legs[-2].position.tolist()
        for index, name in enumerate(last.names):
            if self._speeds[name].at(0.0, TOLERANCE) is None:
                distance = float(last.position[index]) - starts[index]
                raise _too_hard(last.where, name, self._limits[name], distance, " and rest there")
            self._speeds[name] = Speeds(0.0, 0.0)


def _too_hard(where: str, name: str, limit: JointLimit, distance: float, end: str = "") -> RefusedError:
    return RefusedError(
        f"{where}{name} cannot go {abs(distance):.4g} in that time{end}: its acceleration is at most "
        f"{limit.acceleration:.4g} per second squared.",
        hint=f"From rest to rest it needs {shortest_s(distance, limit.acceleration):.2f} s.",
    )


def _is_velocity(message: Any) -> bool:
    """Whether this is a JointState of velocities only."""
    return not hasattr(message, "points") and not len(message.position)


def _check_time(trajectory: Any, lasts_s: float | None) -> None:
    last = trajectory.points[-1].time_from_start
    needed_s = last.sec + last.nanosec * 1e-9
    if lasts_s is not None and lasts_s < needed_s * (1.0 - TOLERANCE):
        raise RefusedError(f"The trajectory takes {needed_s:g} s, its step only {lasts_s:g} s.")


def _check_state(
    limits: Mapping[str, JointLimit], message: Any, before: JointSample | None, lasts_s: float | None
) -> list[Leg]:
    """A JointState: its values, and that positions can be reached or velocities be kept for as long as it lasts."""
    names = _check_names(limits, message.name)
    if not (len(message.position) or len(message.velocity)):
        raise RefusedError("The joint command holds neither positions nor velocities.")
    _check_arrays(limits, names, message.position, message.velocity, (), message.effort, "")
    if lasts_s is None and _is_velocity(message):
        raise RefusedError("It is not known how long the velocities last, so that they cannot be checked.")
    ends = _targets(message, before, lasts_s or 0.0)
    leg = Leg(names=tuple(names), position=np.array(ends), duration_s=lasts_s)
    if lasts_s is None:
        return [leg]
    for name, start, end in zip(names, _measured(names, before), ends, strict=True):
        limit = limits[name]
        if not limit.lower - TOLERANCE <= end <= limit.upper + TOLERANCE:
            raise RefusedError(
                f"{name} would be at {end:.4g} after {lasts_s:g} s, allowed is {limit.lower:.4g} .. {limit.upper:.4g}."
            )
        _check_pace(limit, name, start, end, lasts_s, "")
    return [leg]


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


def _check_names(limits: Mapping[str, JointLimit], names: Sequence[str]) -> Sequence[str]:
    if not names:
        raise RefusedError("The joint command names no joints.")
    unknown = [name for name in names if name not in limits]
    if unknown:
        raise RefusedError(f"Joint {unknown[0][:60]!r} is unknown, the robot has {', '.join(limits)}.")
    if len(set(names)) != len(names):
        raise RefusedError("The joint command names a joint twice.")
    return names


def _check_arrays(
    limits: Mapping[str, JointLimit], names: Sequence[str],
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


def _check_trajectory(limits: Mapping[str, JointLimit], message: Any, joints: JointSample | None) -> list[Leg]:
    names = _check_names(limits, message.joint_names)
    if not 1 <= len(message.points) <= MAX_POINTS:
        raise RefusedError(f"The trajectory has {len(message.points)} points, allowed is 1 .. {MAX_POINTS}.")
    before, before_s = _measured(names, joints), 0.0
    legs = []
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
        velocity = np.array(point.velocities) if len(point.velocities) else None
        legs.append(
            Leg(
                names=tuple(names),
                position=np.array(point.positions),
                duration_s=at_s - before_s,
                velocity=velocity,
                where=where if len(message.points) > 1 else "",
            )
        )
        before, before_s = list(point.positions), at_s
    return legs


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

"""Joint limits for JointTrajectory and JointState commands: names, positions, velocities,
accelerations, times.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from roboneuron.contract import JointSample
from roboneuron.errors import RefusedError
from roboneuron.gate.motion import joint_space
from roboneuron.gate.motion.acceleration import Speeds, shortest_s
from roboneuron.gate.motion.driver_limits import MOST_POINTS
from roboneuron.gate.motion.path_limits import Leg

_HALF_TURN = math.pi * (1.0 + 1e-6)
_SAME = 1e-3
"""Tolerance of a first point at time 0, which may only repeat the present position: a milliradian
or millimetre.
"""


def check_joints(
    limits: Mapping[str, joint_space.JointLimit],
    messages: Sequence[Any],
    joints: JointSample | None,
    durations_s: Sequence[float] = (),
) -> list[Leg]:
    """Check that the joints can follow the commands, one after the other, within their limits;
    return their path.

    A trajectory must reach each point within the joints' velocities and accelerations, and rest at
    the end of the last command. The first step begins at the measured positions and velocities;
    each further command begins at the end of the previous one.

    Args:
        limits: by joint.
        messages: JointTrajectory or JointState.
        joints: newest measured joints.
        durations_s: duration of each command [s]; without it, the velocity of a JointState is not
            checked.

    Raises:
        RefusedError: names the joint, the requested and the allowed value.
    """
    motion = _JointMotion(limits, joints)
    legs: list[Leg] = []
    for index, message in enumerate(messages):
        step = f"steps[{index}]: " if len(messages) > 1 else ""
        try:
            made = motion.follow(
                message,
                durations_s[index] if durations_s else None,
                is_last=index + 1 == len(messages),
            )
        except RefusedError as error:
            deepest = _farthest(limits, messages) if isinstance(error, _RangeError) else ""
            raise RefusedError(f"{step}{error.message}{deepest}", hint=error.hint) from error
        legs += [replace(leg, where=f"{step}{leg.where}") for leg in made]
    return legs


class _RangeError(RefusedError):
    """A position is out of the range of its joint."""


def _farthest(limits: Mapping[str, joint_space.JointLimit], messages: Sequence[Any]) -> str:
    """The position that is farthest out of its joint's range, as the end of a message about the
    first one; empty if it is that one.
    """
    found: list[tuple[float, str]] = []
    for index, message in enumerate(messages):
        step = f"steps[{index}]: " if len(messages) > 1 else ""
        if hasattr(message, "points"):
            rows = [(f"points[{n}]: ", one.positions) for n, one in enumerate(message.points)]
            names = message.joint_names
        else:
            rows, names = [("", message.position)], message.name
        for where, positions in rows:
            for name, value in zip(names, positions, strict=False):
                limit = limits.get(name)
                if limit is not None and not limit.allows("position", value):
                    beyond = max(limit.lower - value, value - limit.upper)
                    depth = math.inf if math.isnan(beyond) else beyond
                    found.append((depth, f"{step}{where}{name} at {value:.4g}"))
    depth, told = max(found, key=lambda one: one[0])
    return "" if told == found[0][1] else f" Deepest, by {depth:.4g}: {told}."


class _JointMotion:
    """Positions of the joints after the commands so far, and the velocities they can have there."""

    def __init__(
        self, limits: Mapping[str, joint_space.JointLimit], joints: JointSample | None
    ) -> None:
        self._limits = limits
        self._position: dict[str, float] = {}
        self._speeds: dict[str, Speeds] = {}
        self._distance: dict[str, float] = {}
        self._is_measured = joints is not None
        if joints is not None:
            found = zip(joints.names, joints.position.tolist(), strict=True)
            self._position.update({name: q for name, q in found if np.isfinite(q)})
            if joints.velocity is not None:
                measured = zip(joints.names, joints.velocity.tolist(), strict=True)
                self._speeds.update({name: Speeds(v, v) for name, v in measured if np.isfinite(v)})

    def follow(self, message: Any, lasts_s: float | None, *, is_last: bool) -> list[Leg]:
        """Return the legs of one command; raises RefusedError for the first violated limit."""
        is_trajectory = hasattr(message, "points")
        is_velocity = not is_trajectory and not len(message.position)
        legs = []
        for leg in (
            self._trajectory(message, lasts_s) if is_trajectory else self._state(message, lasts_s)
        ):
            if not is_velocity:
                self._check_turns(leg)
            if leg.duration_s is not None:
                self._commit(leg, is_velocity)
            self._position.update(zip(leg.names, leg.position.tolist(), strict=True))
            legs.append(leg)
        is_followed_at_once = not is_last and (lasts_s or 0.0) <= sum(
            leg.duration_s or 0.0 for leg in legs
        )
        if (
            legs[-1].duration_s
            and legs[-1].velocity is None
            and not (is_velocity or is_followed_at_once)
        ):
            self._rest(legs[-1])
        return legs

    def _trajectory(self, message: Any, lasts_s: float | None) -> Iterator[Leg]:
        names = self._names(message.joint_names)
        if not 1 <= len(message.points) <= MOST_POINTS:
            raise RefusedError(
                f"The trajectory has {len(message.points)} points, allowed is 1 .. {MOST_POINTS}."
            )
        before_s = 0.0
        for index, point in enumerate(message.points):
            where = f"points[{index}]: "
            if len(point.positions) != len(names):
                raise RefusedError(
                    f"{where}{len(point.positions)} positions for {len(names)} joints."
                )
            self._check(
                names, point.positions, point.velocities, point.accelerations, point.effort, where
            )
            at_s = point.time_from_start.sec + point.time_from_start.nanosec * 1e-9
            starts = self._starts(names)
            is_start = index == 0 and np.allclose(starts, point.positions, rtol=0.0, atol=_SAME)
            if not (at_s > before_s or (at_s == 0.0 and is_start)):
                raise RefusedError(
                    f"{where}time_from_start is {at_s:g} s, expected more than {before_s:g} s."
                )
            yield Leg(
                names=names,
                position=np.array(point.positions),
                duration_s=at_s - before_s,
                velocity=np.array(point.velocities) if len(point.velocities) else None,
                where=where if len(message.points) > 1 else "",
            )
            before_s = at_s
        if lasts_s is not None and lasts_s < before_s * (1.0 - joint_space.JointLimit.SLACK):
            raise RefusedError(f"The trajectory takes {before_s:g} s, its step only {lasts_s:g} s.")

    def _state(self, message: Any, lasts_s: float | None) -> Iterator[Leg]:
        """Handle a JointState: positions to be reached within the time, or velocities kept
        for it.
        """
        names = self._names(message.name)
        if not (len(message.position) or len(message.velocity)):
            raise RefusedError("The joint command holds neither positions nor velocities.")
        self._check(names, message.position, message.velocity, (), message.effort, "")
        ends = np.array(message.position)
        if not len(ends):
            if lasts_s is None:
                raise RefusedError(
                    "The duration of the velocities is not known, so they cannot be checked."
                )
            ends = np.array(self._starts(names)) + np.array(message.velocity) * lasts_s
            for name, end in zip(names, ends.tolist(), strict=True):
                limit = self._limits[name]
                if not limit.allows("position", end):
                    allowed = f"{limit.lower:.4g} .. {limit.upper:.4g}"
                    raise RefusedError(
                        f"{name} would be at {end:.4g} after {lasts_s:g} s, allowed is {allowed}."
                    )
        yield Leg(names=names, position=ends, duration_s=lasts_s)

    def _commit(self, leg: Leg, is_velocity: bool) -> None:
        """Check that the joints can follow a leg: their velocities, and the implied
        accelerations.
        """
        starts, duration_s = self._starts(leg.names), leg.duration_s
        if not duration_s:
            return
        for index, (name, start, end) in enumerate(
            zip(leg.names, starts, leg.position.tolist(), strict=True)
        ):
            limit, distance = self._limits[name], end - start
            self._distance[name] = distance
            mean, allowed = distance / duration_s, limit.fastest(end, end > start)
            if abs(mean) > allowed * (1.0 + joint_space.JointLimit.SLACK):
                near = " so near to its limit" if allowed < limit.velocity else ""
                raise RefusedError(
                    f"{leg.where}{name} would move at {abs(mean):.4g} per second, allowed is "
                    f"{allowed:.4g}{near}.",
                    hint="Give the step more time."
                    if allowed > 0.0
                    else "Stay farther from the limit.",
                )
            old = self._speeds.get(name, Speeds(0.0, 0.0))
            if is_velocity:
                room = limit.acceleration * duration_s * (1.0 + joint_space.JointLimit.SLACK)
                new = Speeds(mean, mean) if old.at(mean, room) else None
            else:
                new = old.after(distance, duration_s, limit.acceleration, limit.velocity)
                if new is not None and leg.velocity is not None:
                    new = new.at(float(leg.velocity[index]))
            if new is None:
                raise self._too_hard(leg, name, distance)
            self._speeds[name] = new

    def _check_turns(self, leg: Leg) -> None:
        """Check that continuous joints turn the same way whether their driver counts turns or takes
        the shorter way.
        """
        for name, end in zip(leg.names, leg.position.tolist(), strict=True):
            limit, start = self._limits[name], self._position.get(name)
            if start is None or not limit.is_continuous or abs(end - start) <= _HALF_TURN:
                continue
            near = limit.nearest(start, end)
            raise RefusedError(
                f"{leg.where}{name} is continuous and would turn by {abs(end - start):.4g} rad in "
                "one part, allowed is half a turn: beyond it robots differ in the way they take.",
                hint=f"Write {near:.6g}, which is the same posture."
                if abs(near - start) <= _HALF_TURN
                else f"Put a point at {(start + end) / 2.0:.6g} between.",
            )

    def _rest(self, leg: Leg) -> None:
        """Check that the joints can rest at the end of this leg."""
        for name in leg.names:
            if self._speeds[name].at(0.0) is None:
                raise self._too_hard(leg, name, self._distance[name], " and rest there")
            self._speeds[name] = Speeds(0.0, 0.0)

    def _too_hard(self, leg: Leg, name: str, distance: float, end: str = "") -> RefusedError:
        acceleration = self._limits[name].acceleration
        return RefusedError(
            f"{leg.where}{name} cannot go {abs(distance):.4g} in that time{end}: its acceleration "
            "is at most "
            f"{acceleration:.4g} per second squared.",
            hint=f"From rest to rest it needs {shortest_s(distance, acceleration):.2f} s.",
        )

    def _names(self, names: Sequence[str]) -> tuple[str, ...]:
        if not names:
            raise RefusedError("The joint command names no joints.")
        unknown = [name for name in names if name not in self._limits]
        if unknown:
            raise RefusedError(
                f"Joint {unknown[0][:60]!r} is unknown, the robot has {', '.join(self._limits)}."
            )
        if len(set(names)) != len(names):
            raise RefusedError("The joint command names a joint twice.")
        return tuple(names)

    def _check(
        self,
        names: Sequence[str],
        position: Sequence[float],
        velocity: Sequence[float],
        acceleration: Sequence[float],
        effort: Sequence[float],
        where: str,
    ) -> None:
        arrays = {
            "position": position,
            "velocity": velocity,
            "acceleration": acceleration,
            "effort": effort,
        }
        for quantity, values in arrays.items():
            if len(values) not in (0, len(names)):
                raise RefusedError(
                    f"{where}{quantity} has {len(values)} values for {len(names)} joints."
                )
            for name, value in zip(names, values, strict=False):
                limit = self._limits[name]
                if not limit.allows(quantity, value):
                    low, high = limit.range(quantity)
                    kind = _RangeError if quantity == "position" else RefusedError
                    raise kind(
                        f"{where}{quantity} of {name} is {value:.4g}, allowed is {low:.4g} .. "
                        f"{high:.4g}."
                    )

    def _starts(self, names: Sequence[str]) -> list[float]:
        if not self._is_measured:
            raise RefusedError(
                "The joints were not measured yet, so the first step cannot be checked.",
                hint="Start the robot first.",
            )
        missing = [name for name in names if name not in self._position]
        if missing:
            raise RefusedError(
                f"Joint {missing[0]!r} is not among the measured ones, so the step cannot be "
                "checked."
            )
        return [self._position[name] for name in names]
